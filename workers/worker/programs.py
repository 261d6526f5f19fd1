"""The programs of the kinds that octasplat brings; only a job's own process imports this."""

import json
import os
import shutil
from pathlib import Path
from typing import Any

from engine.config import read_config
from engine.events import StageProgress, broadcast
from engine.export.options import ExportOptions
from engine.export.registry import export_scene
from engine.files import write_json
from engine.gaussians.ply import read_gaussian_ply
from engine.pipeline import CACHE, CHECKPOINTS, CONFIG, EVENTS, SCENE
from engine.pipeline import evaluate as evaluate_run
from engine.pipeline import reconstruct as reconstruct_scene
from workers.kinds.options import ExportJobOptions, ReconstructOptions, RenderJobOptions
from workers.progress import staged, stopping
from workers.worker.preview import Previews
from workers.worker.task import Task


def reconstruct(task: Task) -> None:
    """Photographs to a scene, its meshes and measurements; goes on from what an earlier attempt left."""
    assert task.scene is not None
    config = ReconstructOptions.model_validate(task.options).config()
    previews = Previews(task.scene, task.run, config, task.listener)
    reconstruct_scene(
        task.scene,
        task.run,
        config,
        resume=True,
        threads=task.threads,
        listener=stopping(broadcast([task.listener, previews]), task.should_stop),
        should_stop=task.should_stop,
    )
    for path in sorted(task.run.rglob("*")):
        name = path.relative_to(task.run)
        hidden = any(part.startswith(".") for part in name.parts)
        if path.is_file() and not hidden and name.parts[0] not in (CHECKPOINTS, CACHE):
            _publish(task, path, name.as_posix())


def evaluate(task: Task) -> None:
    """The held-out views of a finished reconstruction, measured again."""
    evaluate_run(
        task.run,
        scene=task.scene,
        threads=task.threads,
        listener=stopping(task.listener, task.should_stop),
    )
    for name in ("metrics.json", "report.html"):
        _publish(task, task.run / name, name)
    for path in sorted((task.run / "renders").rglob("*.png")):
        _publish(task, path, path.relative_to(task.run).as_posix())


def export(task: Task) -> None:
    """The scene of a reconstruction in other formats."""
    options = ExportJobOptions.model_validate(task.options)
    gaussians, _ = read_gaussian_ply(task.run / SCENE)
    q = options.q if options.q is not None else read_config(task.run / CONFIG).train.trace.q
    settings = ExportOptions(q=q, min_opacity=options.min_opacity, sh_pad_degree=options.sh_pad_degree)
    tell = stopping(task.listener, task.should_stop)
    with staged("export", tell, len(options.files)):
        for done, name in enumerate(options.files, start=1):
            export_scene(gaussians, task.results / name, settings)
            tell(StageProgress("export", done, len(options.files)))


def render(task: Task) -> None:
    """New views of the scene of a reconstruction."""
    from workers.render_jobs import render_files

    options = RenderJobOptions.model_validate(task.options)
    target = task.results / "turntable.mp4" if options.format == "mp4" else task.results / "views"
    arguments: dict[str, Any] = {
        "source": task.run,
        "scene": task.scene,
        "output": target,
        "views": options.views if options.mode == "views" else None,
        "frames": options.frames,
        "seconds": None,
        "fps": options.fps,
        "width": options.width_px,
        "height": options.height_px,
        "fov": options.fov_y_degrees,
        "up": None,
        "exr": options.format == "exr",
        "background": options.background,
        "max_side": options.max_side,
        "threads": task.threads,
    }
    render_files(options.mode, arguments, stopping(task.listener, task.should_stop))


def _publish(task: Task, path: Path, name: str) -> None:
    """Put a file among the results, without a copy."""
    target = task.results / name
    target.parent.mkdir(parents=True, exist_ok=True)
    target.unlink(missing_ok=True)
    if name == CONFIG:  # where the photographs lay on this machine is nobody's business
        content = json.loads(path.read_text(encoding="utf-8"))
        write_json(target, {**content, "scene": task.title})
    elif name == EVENTS:
        shutil.copy2(path, target)
    else:
        os.link(path, target)

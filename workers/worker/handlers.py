"""Programs of the built-in job kinds; only a job's own process imports this."""

import json
import os
import shutil
from contextlib import nullcontext
from pathlib import Path

from octasplat.engine.core.compiling import report_compilation
from octasplat.engine.core.errors import CheckpointError, ConfigError
from octasplat.engine.core.events import (
    Event,
    Noted,
    PhaseFinished,
    PhaseProgress,
    Warned,
    broadcast,
)
from octasplat.engine.core.progress import counted_phase, stop_when_asked
from octasplat.engine.core.writing import write_json
from octasplat.engine.dataset import Dataset
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.pipeline import reconstruct as reconstruct_scene
from octasplat.engine.runs.config import ReconstructionConfig
from octasplat.engine.runs.run_folder import (
    CACHE,
    CHECKPOINTS,
    CONFIG,
    EVENTS,
    SCENE,
    found_model_folder,
)
from octasplat.engine.shading.protocol import ShadingModel
from octasplat.engine.trace.protocol import Tracer
from octasplat.workers.worker.job_kinds import get_job_kind
from octasplat.workers.worker.job_kinds.operation_kind import OperationKind
from octasplat.workers.worker.live_scene import LiveSceneWriter
from octasplat.workers.worker.path_redaction import PathRedactor
from octasplat.workers.worker.preview import PreviewRenderer
from octasplat.workers.worker.stored_frames import write_moved_results
from octasplat.workers.worker.task import INFO_FILE, Task

REPORT = "report.html"
_STAGES_OF_POSES = ("poses", "placing", "lenses", "load")


def reconstruct(task: Task) -> None:
    """Run a reconstruction, resumed from what an earlier attempt left.

    If that is of other settings, as another version may understand the same options, it begins anew.
    """
    # Read before the run begins, which writes this file itself.
    has_left = (task.run / CONFIG).exists()
    try:
        _run_reconstruction(task)
    except (CheckpointError, ConfigError) as error:
        if not has_left:
            raise
        message = _path_redactor(task).replace_job_paths(str(error))
        task.progress(Warned(f"What was there cannot be gone on with, so the job begins anew: {message}"))
        shutil.rmtree(task.run)
        shutil.rmtree(task.results)
        _run_reconstruction(task)


def _run_reconstruction(task: Task) -> None:
    assert task.scene is not None
    config = ReconstructionConfig.model_validate(task.options)

    preview = PreviewRenderer(task.run, config.evaluation_background, task.progress)
    live = LiveSceneWriter(task.run, task.progress)

    def show_step(
        iteration: int, dataset: Dataset, tracer: Tracer, shading: ShadingModel, gaussians: FlatGaussians
    ) -> None:
        preview(iteration, dataset, tracer, shading)
        live(iteration, dataset, gaussians)

    def show_points(event: Event) -> None:
        # As soon as poses are found, and again where they are mended; never in the place of a later state.
        if isinstance(event, PhaseFinished) and event.stage in _STAGES_OF_POSES:
            assert task.scene is not None
            if not any((task.run / CHECKPOINTS).glob("*.npz")):
                live.write_points(task.scene, found_model_folder(task.run), config.model)

    def publish_finished(event: Event) -> None:
        # Whatever becomes of the rest, even if this process is killed.
        if isinstance(event, PhaseFinished) or (isinstance(event, PhaseProgress) and event.stage == "export"):
            _publish_run(task)

    try:
        with report_compilation(task.progress):
            reconstruct_scene(
                task.scene,
                task.run,
                config,
                resume=True,
                threads=task.threads,
                progress=stop_when_asked(
                    broadcast([task.progress, publish_finished, show_points]), task.should_stop
                ),
                should_stop=task.should_stop,
                on_step=show_step,
            )
    finally:
        _publish_run(task)


def _publish_run(task: Task) -> None:
    """Publish what a run has finished as results; there are none before the scene."""
    if not (task.run / SCENE).exists():
        return
    for path in sorted(task.run.rglob("*")):
        name = path.relative_to(task.run)
        # Hidden files are previews and live scenes, which are stored on their own, or files being written.
        hidden = any(part.startswith(".") for part in name.parts)
        if path.is_file() and not hidden and name.parts[0] not in (CHECKPOINTS, CACHE):
            _publish_file(task, path, name.as_posix())


def run_operation(task: Task) -> None:
    """Run the operation of the job's kind and publish its files."""
    kind = get_job_kind(task.kind)
    assert isinstance(kind, OperationKind)
    options = kind.resolve(task.options)
    with kind.progress_callback(task) as report:
        phase_context = (
            nullcontext() if kind.reports_stages else counted_phase(kind.stages(options)[0], report, 0)
        )
        with phase_context:
            result = kind.operation.execute(
                kind.build_request(task), progress=report, should_stop=task.should_stop, threads=task.threads
            )
    moved: dict[str, str] = {}
    for path in result.files:
        if not path.is_relative_to(task.results):
            name = kind.result_name(path.relative_to(result.folder or task.run))
            try:
                _publish_file(task, path, name)
            except FileNotFoundError:  # stored and removed already
                moved[name] = path.relative_to(task.folder).as_posix()
    if moved:
        write_moved_results(task.folder, moved)
    for line in result.lines():
        task.progress(Noted(_path_redactor(task).replace_job_paths(line)))


def _path_redactor(task: Task) -> PathRedactor:
    return PathRedactor(task.folder, task.scene.parents[2] if task.scene is not None else task.folder)


def _publish_file(task: Task, path: Path, name: str) -> None:
    """Add a file to the results without a copy."""
    target = task.results / name
    target.parent.mkdir(parents=True, exist_ok=True)
    # os.link refuses an existing name, which an earlier call of the same attempt has left.
    target.unlink(missing_ok=True)
    if name == CONFIG:  # where the photographs lay on this machine is private
        content = json.loads(path.read_text(encoding="utf-8"))
        write_json(target, {**content, "scene": task.title})
    elif name in (EVENTS, REPORT, INFO_FILE):
        target.write_text(
            _path_redactor(task).replace_job_paths(path.read_text(encoding="utf-8")), encoding="utf-8"
        )
    else:
        os.link(path, target)

"""What ``octasplat render`` does once its options are understood."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import click
import numpy as np
from jaxtyping import Float64

from engine.config import read_config
from engine.errors import OutputError
from engine.events import Listener
from engine.gaussians.model import FlatGaussians
from engine.gaussians.ply import read_gaussian_ply, read_near_world
from engine.light.stage_file import read_stage
from engine.pipeline import CONFIG, SCENE, run_scene
from engine.render.cameras import RenderCamera
from engine.render.jobs import (
    DEFAULT_FOV_Y_DEGREES,
    Shot,
    camera_shots,
    gaussian_turntable,
    render_images,
    render_video,
    scene_fov_y_degrees,
    scene_turntable,
    turntable_cameras,
    view_shots,
)
from engine.render.path_file import read_camera_path
from engine.render.renderer import background_colour
from engine.scene import SceneModel, load_scene, scene_extent, split_views
from engine.trace.make import make_tracer
from engine.trace.protocol import TraceSettings
from workers.options import is_run
from workers.progress import show_progress, staged
from workers.scene_files import open_scene
from workers.stage_jobs import StagePlace, render_stage

DEFAULT_FPS = 30.0
DEFAULT_FRAMES = 120


@dataclass(frozen=True)
class _Source:
    """A scene to render; what only a run knows is None for a bare file of Gaussians."""

    gaussians: FlatGaussians
    settings: TraceSettings
    near_world: float = 0.0
    background: str = "black"
    photographs: SceneModel | None = None
    train_indices: np.ndarray | None = None
    test_indices: np.ndarray | None = None


def run_render(mode: str, options: dict[str, Any]) -> None:
    """Render as the options of the command say, with the progress shown; see :func:`render_files`."""
    with show_progress(quiet=options["quiet"]) as listener:
        files = render_files(mode, options, listener)
    if not options["quiet"]:
        click.echo(f"Wrote {files[0]}" + (f" and {len(files) - 1} more." if len(files) > 1 else "."))


def render_files(mode: str, options: dict[str, Any], listener: Listener) -> tuple[Path, ...]:
    """Render as the options of the command say.

    Args:
        mode: ``views``, ``turntable`` or ``camera_path``.
        options: the options of the command by parameter name.
        listener: hears the progress.

    Returns:
        The files written.

    Raises:
        OctasplatError: the source cannot be read or the output not written.
    """
    output: Path = options["output"]
    stage = read_stage(options["stage"]) if options.get("stage") else None
    cameras, fps = None, options["fps"] or DEFAULT_FPS
    if mode == "camera_path":
        path = read_camera_path(options["camera_path"])
        cameras, fps = path.cameras, options["fps"] or path.fps
    source = _read_run(options) if is_run(options["source"]) else _read_file(options)
    if mode == "turntable":
        cameras = _turntable(source, options, fps)
    if cameras is not None:
        cameras = tuple(replace(camera, near_world=source.near_world) for camera in cameras)
    background = background_colour(options["background"] or source.background)
    if stage is not None:
        shots = camera_shots(cameras) if cameras is not None else _views(source, options["views"])
        place = StagePlace(
            source.gaussians, source.settings, source.photographs, options["stage"].parent,
            lambda path: open_scene(path, quiet=options["quiet"]), background, options["threads"],
        )  # fmt: skip
        film = fps if output.suffix.lower() == ".mp4" else None
        names = None if options.get("preview") else _FileNames(output, options["exr"])
        return render_stage(stage, place, shots, output, names, film, listener)
    tracer = make_tracer(source.settings, threads=options["threads"], build_quality=2)
    tracer.build(source.gaussians)
    with staged("render", listener) as progress:
        if cameras is not None and output.suffix.lower() == ".mp4":
            render_video(tracer, cameras, output, fps, background, progress)
            return (output,)
        shots = camera_shots(cameras) if cameras is not None else _views(source, options["views"])
        return render_images(tracer, shots, _FileNames(output, options["exr"]), background, progress)


@dataclass(frozen=True)
class _FileNames:
    """The file of a shot: by number in a pattern, by name in a folder."""

    output: Path
    exr: bool

    def __call__(self, number: int, shot: Shot) -> Path:
        if self.output.suffix.lower() in (".png", ".exr"):
            return self.output.with_name(self.output.name % number)
        return self.output / f"{shot.name}{'.exr' if self.exr else '.png'}"


def _read_run(options: dict[str, Any]) -> _Source:
    run: Path = options["source"]
    config = read_config(run / CONFIG)
    if not (run / SCENE).exists():
        raise OutputError(f"{run} holds no {SCENE} yet; finish the run with octasplat reconstruct --resume.")
    photographs = load_scene(
        options["scene"] or run_scene(run), max_side=options["max_side"] or config.max_side
    )
    train, test = split_views([view.name for view in photographs.views], config.test_every, config.held_out)
    origins = np.stack([photographs.views[index].origin_world for index in train])
    extent = scene_extent(origins, photographs.points)
    return _Source(
        read_gaussian_ply(run / SCENE)[0],
        config.train.trace,
        config.train.near * extent,
        config.evaluate_background,
        photographs,
        train,
        test,
    )


def _read_file(options: dict[str, Any]) -> _Source:
    path: Path = options["source"]
    gaussians = open_scene(path, quiet=options["quiet"])
    return _Source(gaussians, TraceSettings(), read_near_world(path))


def stage_place(
    source: Path, scene: Path | None, up: str | None, *, quiet: bool
) -> tuple[StagePlace, Float64[np.ndarray, "3"] | None]:
    """The scene of a run or file in which a stage is to be set, and the direction that is named as up.

    Raises:
        OctasplatError: the source cannot be read.
    """
    options = {"source": source, "scene": scene, "max_side": None, "quiet": quiet}
    found = _read_run(options) if is_run(source) else _read_file(options)
    place = StagePlace(
        found.gaussians, found.settings, found.photographs, source.parent,
        lambda path: open_scene(path, quiet=quiet), background_colour(found.background), 0,
    )  # fmt: skip
    return place, None if up is None else _axis(up)


def _turntable(source: _Source, options: dict[str, Any], fps: float) -> tuple[RenderCamera, ...]:
    frames: int = options["frames"] or DEFAULT_FRAMES
    if options["seconds"]:
        frames = max(1, round(options["seconds"] * fps))
    fov: float | None = options["fov"]
    if source.photographs is not None:
        table = scene_turntable(source.photographs)
        fov = fov or scene_fov_y_degrees(source.photographs)
    else:
        fov = fov or DEFAULT_FOV_Y_DEGREES
        table = gaussian_turntable(source.gaussians, up_world=_axis(options["up"] or "-y"), fov_y_degrees=fov)
    return turntable_cameras(table, frames, options["width"], options["height"], fov)


def _axis(name: str) -> Float64[np.ndarray, "3"]:
    axis = np.eye(3)["xyz".index(name[-1])]
    return -axis if name.startswith("-") else axis


def _views(source: _Source, which: str | None) -> tuple[Shot, ...]:
    assert source.photographs is not None
    assert source.train_indices is not None and source.test_indices is not None
    every = np.arange(len(source.photographs.views))
    indices = {"train": source.train_indices, "all": every}.get(which or "held-out", source.test_indices)
    if len(indices) == 0:
        raise OutputError("The run held out no views; ask for --views train or all.")
    return view_shots(source.photographs, indices, source.near_world)

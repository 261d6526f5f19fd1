"""Images and films of a scene, as the options of ``octasplat render`` or of a job say."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from engine.config import read_config
from engine.errors import ConfigError, OutputError
from engine.events import Listener
from engine.files.gaussian_ply import read_gaussian_ply, read_near_world
from engine.gaussians.model import FlatGaussians
from engine.light.stage import Stage
from engine.light.stage_file import read_stage
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
from engine.run_folder import CONFIG, SCENE, is_run, run_viewpoints
from engine.scene.model import Viewpoints
from engine.scene.views_file import SplitViewpoints
from engine.stages import counted_stage
from engine.trace.make import make_tracer
from engine.trace.protocol import TraceSettings
from workers.rendering.stages import StagePlace, render_stage
from workers.telling.losses import open_scene

DEFAULT_FPS = 30.0
DEFAULT_FRAMES = 120
ANY_SIDE_PX = 1 << 30
"""A cap that no photograph reaches."""


@dataclass(frozen=True)
class _Source:
    """A scene to render; what only a run knows is None for a bare file of Gaussians."""

    gaussians: FlatGaussians
    settings: TraceSettings
    near_world: float = 0.0
    background: str = "black"
    viewpoints: SplitViewpoints | None = None


def render_files(
    mode: str, options: dict[str, Any], listener: Listener, say: Callable[[str], None]
) -> tuple[Path, ...]:
    """Render as the options of the command say.

    Args:
        mode: ``views``, ``turntable`` or ``camera_path``.
        options: the options of the command by parameter name.
        listener: hears the progress.
        say: told in a sentence what reading a scene has lost.

    Returns:
        The files written.

    Raises:
        OctasplatError: the source cannot be read or the output not written.
    """
    output: Path = options["output"]
    stage = _read_stage(options) if options.get("stage") else None
    cameras, fps = None, options["fps"] or DEFAULT_FPS
    if mode == "camera_path":
        path = read_camera_path(options["camera_path"])
        cameras, fps = path.cameras, options["fps"] or path.fps
    source = _read_run(options) if is_run(options["source"]) else _read_file(options, say)
    if mode == "turntable":
        cameras = _turntable(source, options, fps)
    if cameras is not None:
        cameras = tuple(replace(camera, near_world=source.near_world) for camera in cameras)
    background = background_colour(options["background"] or source.background)
    if stage is not None:
        shots = camera_shots(cameras) if cameras is not None else _views(source, options["views"])
        place = StagePlace(
            source.gaussians, source.settings, _full_size(options), options["stage"].parent,
            lambda path: open_scene(path, say), background, options["threads"], say,
        )  # fmt: skip
        film = fps if output.suffix.lower() == ".mp4" else None
        exr = options["exr"] or stage.integrator.layers
        names = None if options.get("preview") else _FileNames(output, exr)
        return render_stage(stage, place, shots, output, names, film, listener)
    tracer = make_tracer(source.settings, threads=options["threads"], build_quality=2)
    tracer.build(source.gaussians)
    background = background_colour(options["background"] or source.background)
    with counted_stage("render", listener) as progress:
        if cameras is not None and output.suffix.lower() == ".mp4":
            render_video(tracer, cameras, output, fps, background, progress)
            return (output,)
        shots = camera_shots(cameras) if cameras is not None else _views(source, options["views"])
        return render_images(tracer, shots, _FileNames(output, options["exr"]), background, progress)


def _read_stage(options: dict[str, Any]) -> Stage:
    """The stage, with what the options say of its integrator.

    Raises:
        ConfigError: it cannot be read, or asks for layers in files that have none.
    """
    stage = read_stage(options["stage"])
    asked = {key: True for key in ("layers", "denoise") if options.get(key)}
    stage = stage.model_copy(update={"integrator": stage.integrator.model_copy(update=asked)})
    if stage.integrator.layers and options["output"].suffix.lower() in (".png", ".mp4"):
        raise ConfigError(f"{options['output']}: holds no layers; name a folder, or .exr files.")
    return stage


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
    viewpoints = run_viewpoints(run, scene=options["scene"], max_side=options["max_side"])
    return _Source(
        read_gaussian_ply(run / SCENE)[0],
        config.train.trace,
        config.train.near * viewpoints.extent,
        config.evaluate_background,
        viewpoints,
    )


def _read_file(options: dict[str, Any], say: Callable[[str], None]) -> _Source:
    path: Path = options["source"]
    gaussians = open_scene(path, say)
    return _Source(gaussians, TraceSettings(), read_near_world(path))


def stage_place(
    source: Path, scene: Path | None, up: str | None, say: Callable[[str], None]
) -> tuple[StagePlace, Float64[np.ndarray, "3"] | None]:
    """The scene of a run or file in which a stage is to be set, and the direction that is named as up.

    Args:
        source: folder of a run, or file.
        scene: where the run's photographs are, if their cameras are to be read there.
        up: an axis by name.
        say: told in a sentence what reading a scene has lost.

    Raises:
        OctasplatError: the source cannot be read.
    """
    options = {"source": source, "scene": scene, "max_side": None}
    found = _read_run(options) if is_run(source) else _read_file(options, say)
    place = StagePlace(
        found.gaussians, found.settings, _full_size(options), source.parent,
        lambda path: open_scene(path, say), background_colour(found.background), 0,
    )  # fmt: skip
    return place, None if up is None else _axis(up)


def _full_size(options: dict[str, Any]) -> Viewpoints | None:
    """Where the photographs of a run were taken from, at their full size; None of a file."""
    if not is_run(options["source"]):
        return None
    return run_viewpoints(options["source"], scene=options["scene"], max_side=ANY_SIDE_PX)


def _turntable(source: _Source, options: dict[str, Any], fps: float) -> tuple[RenderCamera, ...]:
    frames: int = options["frames"] or DEFAULT_FRAMES
    if options["seconds"]:
        frames = max(1, round(options["seconds"] * fps))
    fov: float | None = options["fov"]
    if source.viewpoints is not None:
        table = scene_turntable(source.viewpoints)
        fov = fov or scene_fov_y_degrees(source.viewpoints)
    else:
        fov = fov or DEFAULT_FOV_Y_DEGREES
        table = gaussian_turntable(source.gaussians, up_world=_axis(options["up"] or "-y"), fov_y_degrees=fov)
    return turntable_cameras(table, frames, options["width"], options["height"], fov)


def _axis(name: str) -> Float64[np.ndarray, "3"]:
    axis = np.eye(3)["xyz".index(name[-1])]
    return -axis if name.startswith("-") else axis


def _views(source: _Source, which: str | None) -> tuple[Shot, ...]:
    viewpoints = source.viewpoints
    assert viewpoints is not None
    every = np.arange(len(viewpoints.views))
    chosen = {"train": viewpoints.train_indices, "all": every}
    indices = chosen.get(which or "held-out", viewpoints.test_indices)
    if len(indices) == 0:
        raise OutputError("The run held out no views; ask for --views train or all.")
    return view_shots(viewpoints, indices, source.near_world)

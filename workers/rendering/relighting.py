"""Scenes with materials in other light, as the options of ``octasplat relight`` say."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64

from engine.colour import srgb_to_linear
from engine.errors import ConfigError
from engine.events import Listener
from engine.gaussians.materials import require_materials
from engine.light.environment import EnvironmentMap, environment_frame, read_environment
from engine.light.relighting import PathRelighter, Relighter, surroundings
from engine.light.stage import Integrator
from engine.render.images import write_exr, write_png
from engine.render.jobs import Shot, camera_shots, view_shots
from engine.render.path_file import read_camera_path
from engine.render.renderer import background_colour
from engine.render.video import VideoWriter
from engine.run_folder import SCENE, is_run
from engine.scene import load_scene
from engine.stages import counted_stage
from workers.rendering.views import (
    DEFAULT_FPS,
    FileNames,
    Source,
    axis_named,
    read_source,
    run_shots,
    turntable_of,
)


@dataclass(frozen=True)
class _Frame:
    """A shot in the light of a map, turned."""

    shot: Shot
    environment: str
    rotation_degrees: float


def relight_files(
    mode: str, options: dict[str, Any], listener: Listener, say: Callable[[str], None]
) -> tuple[Path, ...]:
    """Relight as the options of the command say.

    Args:
        mode: ``views``, ``on``, ``turntable`` or ``camera_path``.
        options: the options of the command by parameter name.
        listener: hears the progress.
        say: told in a sentence what reading a scene has lost.

    Returns:
        The files written.

    Raises:
        ConfigError: the scene has no materials, or an environment cannot be used.
        OctasplatError: the source cannot be read or the output not written.
    """
    environments = _environments(options["environment"])
    source = read_source(options, say)
    is_of_run = is_run(options["source"])
    require_materials(source.gaussians, options["source"] / SCENE if is_of_run else options["source"])
    up = axis_named(options["up"] or "-y")
    shots, fps = _shots(mode, options, source)
    frames = [
        _Frame(shot, name, options["rotate"] + (360.0 * k / len(shots) if options["spin"] else 0.0))
        for name in environments
        for k, shot in enumerate(shots)
    ]
    relighter = _relighter(options, source)
    output: Path = options["output"]
    with counted_stage("render", listener) as progress:
        pictures = _pictures(relighter, frames, environments, up, options, source, progress)
        if output.suffix.lower() == ".mp4":
            first = shots[0].rays()
            with VideoWriter(output, fps, first.width_px, first.height_px) as video:
                for _, rgb, _ in pictures:
                    video.write(np.clip(rgb, 0, 1))
            return (output,)
        return _write(pictures, options, several=len(environments) > 1)


def _environments(paths: Sequence[Path]) -> dict[str, Float32[np.ndarray, "h w 3"]]:
    """The maps by the names of their files.

    Raises:
        ConfigError: one cannot be used, or two have one name.
    """
    found: dict[str, Float32[np.ndarray, "h w 3"]] = {}
    for path in paths:
        if path.stem in found:
            raise ConfigError(f"{path}: two environments are called {path.stem}; rename one.")
        found[path.stem] = read_environment(path)
    return found


def _shots(mode: str, options: dict[str, Any], source: Source) -> tuple[tuple[Shot, ...], float]:
    if mode == "on":
        others = load_scene(
            options["on"], max_side=options["max_side"] or source.max_side, least_views=1, for_training=False
        )
        return view_shots(others, np.arange(len(others.views)), source.near_world), DEFAULT_FPS
    if mode == "views":
        return run_shots(source, options["views"]), DEFAULT_FPS
    fps = options["fps"] or DEFAULT_FPS
    if mode == "camera_path":
        path = read_camera_path(options["camera_path"])
        cameras, fps = path.cameras, options["fps"] or path.fps
    else:
        cameras = turntable_of(source, options, fps)
    return camera_shots([replace(camera, near_world=source.near_world) for camera in cameras]), fps


def _relighter(options: dict[str, Any], source: Source) -> Relighter:
    integrator = Integrator(
        samples=options["samples"], max_depth=options["depth"], roulette_depth=options["depth"]
    )
    return PathRelighter(source.gaussians, source.settings, integrator, threads=options["threads"])


def _pictures(
    relighter: Relighter,
    frames: Sequence[_Frame],
    environments: dict[str, Float32[np.ndarray, "h w 3"]],
    up_world: Float64[np.ndarray, "3"],
    options: dict[str, Any],
    source: Source,
    progress: Callable[[int, int], None],
) -> Iterator[tuple[_Frame, Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "h w"]]]:
    """Each frame with its display values, not cut at 1, and its coverage."""
    plain = options["background"] or source.background
    light: tuple[str, float] | None = None
    for number, frame in enumerate(frames):
        if light != (frame.environment, frame.rotation_degrees):
            light = (frame.environment, frame.rotation_degrees)
            environment = EnvironmentMap(
                environments[frame.environment], environment_frame(up_world, frame.rotation_degrees)
            )
            relighter.put(environment)
        progress(number, len(frames))
        rays = frame.shot.rays()
        image = relighter.render(rays)
        behind = surroundings(environment, rays) if plain == "environment" else background_colour(plain)
        yield frame, image.over(behind), image.coverage
    progress(len(frames), len(frames))


def _write(
    pictures: Iterator[tuple[_Frame, Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "h w"]]],
    options: dict[str, Any],
    *,
    several: bool,
) -> tuple[Path, ...]:
    names = FileNames(options["output"], options["exr"])
    paths = []
    for number, (frame, rgb, coverage) in enumerate(pictures):
        shot = Shot(f"{frame.environment}/{frame.shot.name}", frame.shot.rays) if several else frame.shot
        path = names(number, shot)
        if path.suffix.lower() == ".exr":
            linear = srgb_to_linear(rgb)
            write_exr(path, {**{name: linear[..., k] for k, name in enumerate("RGB")}, "A": coverage})
        else:
            write_png(path, np.clip(rgb, 0, 1))
        paths.append(path)
    return tuple(paths)

"""Scenes with materials in other light, as the options of ``octasplat relight`` say."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64

from octasplat.engine.colour import linear_to_srgb, srgb_to_linear
from octasplat.engine.config import read_config
from octasplat.engine.errors import ConfigError
from octasplat.engine.events import Listener
from octasplat.engine.gaussians.materials import require_materials
from octasplat.engine.light.environment import EnvironmentMap, environment_frame
from octasplat.engine.light.relighting import PathRelighter, Relighter, surroundings
from octasplat.engine.light.split_sum_relighting import SplitSumRelighter
from octasplat.engine.light.stage import Integrator
from octasplat.engine.operations.axes import light_up
from octasplat.engine.render.environment_map import read_environment
from octasplat.engine.render.identity import identity_of
from octasplat.engine.render.images import write_exr, write_png
from octasplat.engine.render.jobs import Shot, camera_shots, view_shots
from octasplat.engine.render.path_file import read_camera_path
from octasplat.engine.render.renderer import background_colour
from octasplat.engine.run_folder import CONFIG, SCENE, is_run
from octasplat.engine.scene import load_scene
from octasplat.engine.shading.material_settings import MaterialSettings
from octasplat.workers.rendering.cameras import DEFAULT_FPS, cameras_of_options
from octasplat.workers.rendering.views import Keeping, Series, Source, check_one_file, read_source, run_shots

_FRESH = Keeping()
_OF_THE_PICTURES = (
    "by", "samples", "depth", "rotate", "spin", "views", "camera", "look_at", "distance", "elevation",
    "frames", "seconds", "fps", "width", "height", "fov", "up", "exr", "background", "max_side",
)  # fmt: skip
"""Options that decide what the pictures show."""


def relight_files(
    mode: str,
    options: dict[str, Any],
    listener: Listener,
    say: Callable[[str], None],
    keeping: Keeping = _FRESH,
) -> tuple[Path, ...]:
    """Relight as the options of the command say.

    Args:
        mode: ``views``, ``on``, ``turntable``, ``camera`` or ``camera_path``.
        options: the options of the command by parameter name.
        listener: hears the progress.
        say: told in a sentence what reading a scene has lost.
        keeping: how it goes on after a stop.

    Returns:
        The files written.

    Raises:
        ConfigError: the scene has no materials, or an environment cannot be used; or there are images of
            another render where this one is to go on.
        OctasplatError: the source cannot be read or the output not written.
    """
    environments = _environments(options["environment"], options["clamp"])
    source = read_source(options, say)
    ply = options["source"] / SCENE if is_run(options["source"]) else options["source"]
    require_materials(source.gaussians, ply)
    learnt = read_config(options["source"] / CONFIG).train.materials if is_run(options["source"]) else None
    up = light_up(options["source"], options["up"])
    shots, fps = _shots(mode, options, source)
    paint = _Paint(
        _relighter(options, source, learnt),
        environments,
        up,
        options["background"] or source.background,
        _frames(list(environments), shots, options),
    )
    check_one_file(options["output"], len(paint.frames))
    series = Series(options["output"], tuple(paint.frames), fps, options["exr"], keeping)
    # Where the cameras are is said by the rays of the first and last of them.
    ends = [shots[k].rays() for k in (0, -1)]
    kept = series.kept(
        identity_of(
            mode, source.gaussians, source.settings, list(environments), list(environments.values()), up,
            len(shots), [(e.origin_world, e.directions_world) for e in ends],
            {name: options.get(name) for name in _OF_THE_PICTURES},
        )
    )  # fmt: skip
    return series.render(paint, kept, listener)


def _environments(paths: Sequence[Path], most: float | None) -> dict[str, Float32[np.ndarray, "h w 3"]]:
    """The maps by the names of their files, nowhere brighter than ``most``.

    Raises:
        ConfigError: one cannot be used, or two have one name.
    """
    found: dict[str, Float32[np.ndarray, "h w 3"]] = {}
    for path in paths:
        if path.stem in found:
            raise ConfigError(f"{path}: two environments are called {path.stem}; rename one.")
        found[path.stem] = np.minimum(read_environment(path), np.float32(np.inf if most is None else most))
    return found


def _shots(mode: str, options: dict[str, Any], source: Source) -> tuple[tuple[Shot, ...], float]:
    if mode == "on":
        others = load_scene(
            options["on"], max_side=options["max_side"] or source.max_side, least_views=1, for_training=False
        )
        return view_shots(others, np.arange(len(others.views)), source.near_world), DEFAULT_FPS
    if mode == "views":
        return run_shots(source, options), DEFAULT_FPS
    fps = options["fps"] or DEFAULT_FPS
    if mode == "camera_path":
        path = read_camera_path(options["camera_path"])
        cameras, fps = path.cameras, options["fps"] or path.fps
    else:
        cameras = cameras_of_options(source.gaussians, source.viewpoints, options, fps)
    return camera_shots([replace(camera, near_world=source.near_world) for camera in cameras]), fps


def _relighter(options: dict[str, Any], source: Source, learnt: MaterialSettings | None) -> Relighter:
    if options["by"] == "split-sum":
        return SplitSumRelighter(
            source.gaussians, source.settings, learnt, extent_world=source.extent_world,
            side=1 if (options["samples"] or 4) < 4 else math.isqrt(options["samples"] or 4),
            threads=options["threads"],
        )  # fmt: skip
    integrator = Integrator(
        samples=options["samples"] or 64, max_depth=options["depth"], roulette_depth=options["depth"]
    )
    return PathRelighter(source.gaussians, source.settings, integrator, threads=options["threads"])


def _frames(
    environments: Sequence[str], shots: Sequence[Shot], options: dict[str, Any]
) -> dict[Shot, tuple[str, float]]:
    """All shots under all maps, each with its map and how far that is turned, degrees."""
    several = len(environments) > 1
    return {
        Shot(f"{name}/{shot.name}" if several else shot.name, shot.rays): (
            name,
            options["rotate"] + (360.0 * k / len(shots) if options["spin"] else 0.0),
        )
        for name in environments
        for k, shot in enumerate(shots)
    }


@dataclass
class _Paint:
    """Renders a shot in the light that is its, and writes it."""

    relighter: Relighter
    environments: dict[str, Float32[np.ndarray, "h w 3"]]
    up_world: Float64[np.ndarray, "3"]
    background: str
    frames: dict[Shot, tuple[str, float]]
    _put: tuple[str, float] | None = None
    _map: EnvironmentMap | None = field(default=None, repr=False)

    def __call__(self, shot: Shot, path: Path, part: Callable[[float], None]) -> None:
        """``.exr`` gets linear R, G, B and alpha A, anything else 8-bit display values."""
        environment = self._light(*self.frames[shot])
        rays = shot.rays()
        image = self.relighter.render(rays, part)
        if self.background == "transparent" and path.suffix.lower() != ".exr":
            write_png(path, np.clip(linear_to_srgb(image.linear), 0, 1), image.coverage)
            return
        is_map = self.background == "environment"
        plain = background_colour("white" if self.background == "white" else "black")
        rgb = image.over(surroundings(environment, rays) if is_map else plain)
        if path.suffix.lower() == ".exr":
            linear = srgb_to_linear(rgb)
            write_exr(path, {**{name: linear[..., k] for k, name in enumerate("RGB")}, "A": image.coverage})
        else:
            write_png(path, np.clip(rgb, 0, 1))

    def _light(self, name: str, rotation_degrees: float) -> EnvironmentMap:
        if self._map is None or self._put != (name, rotation_degrees):
            frame = environment_frame(self.up_world, rotation_degrees)
            self._map = EnvironmentMap(self.environments[name], frame)
            self._put = (name, rotation_degrees)
            self.relighter.put(self._map)
        return self._map

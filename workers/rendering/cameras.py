"""Cameras as the options of ``octasplat render`` or of a job say: a turntable, or a single one."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from octasplat.engine.config import read_config
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.render.cameras import RenderCamera, focal_from_fov
from octasplat.engine.render.jobs import (
    DEFAULT_FOV_Y_DEGREES,
    ELEVATION_DEGREES,
    gaussian_turntable,
    scene_fov_y_degrees,
    scene_turntable,
    turntable_cameras,
)
from octasplat.engine.render.paths import Turntable, look_at
from octasplat.engine.run_folder import CONFIG, is_run
from octasplat.engine.scene.model import Viewpoints

DEFAULT_FPS = 30.0
DEFAULT_FRAMES = 120


def cameras_of_options(
    gaussians: FlatGaussians, viewpoints: Viewpoints | None, options: dict[str, Any], fps: float
) -> tuple[RenderCamera, ...]:
    """A turntable, or the one camera of ``camera``.

    Args:
        gaussians: the scene.
        viewpoints: where its photographs were taken from; None for a bare file.
        options: ``width``, ``height`` and, all of them optional, ``camera``, ``look_at``, ``distance``,
            ``elevation``, ``fov``, ``up``, ``frames``, ``seconds``, ``ease``.
        fps: images per second.

    Raises:
        ConfigError: the camera would look along its up direction, or stand in its target.
    """
    fov = options["fov"] or (DEFAULT_FOV_Y_DEGREES if viewpoints is None else scene_fov_y_degrees(viewpoints))
    table = _table(gaussians, viewpoints, options, fov)
    if options.get("camera") is not None:
        pose = look_at(np.array(options["camera"]), table.centre_world, table.up_world)
        focal_px = focal_from_fov(fov, options["height"])
        return (RenderCamera.from_pose(pose, options["width"], options["height"], fy_px=focal_px),)
    frames: int = options["frames"] or DEFAULT_FRAMES
    if options["seconds"]:
        frames = max(1, round(options["seconds"] * fps))
    return turntable_cameras(table, frames, options["width"], options["height"], fov)


def _table(
    gaussians: FlatGaussians, viewpoints: Viewpoints | None, options: dict[str, Any], fov: float
) -> Turntable:
    """What the cameras go round, at the distance and height that the options ask for."""
    elevation = options.get("elevation")
    if viewpoints is None:
        table = gaussian_turntable(
            gaussians,
            up_world=axis_named(options["up"] or "-y"),
            fov_y_degrees=fov,
            aspect=options["width"] / options["height"],
            elevation_degrees=ELEVATION_DEGREES if elevation is None else elevation,
        )
    else:
        table = scene_turntable(viewpoints)
    if options.get("look_at") is not None:
        table = replace(table, centre_world=np.array(options["look_at"], dtype=np.float64))
    distance = options.get("distance") or float(np.hypot(table.radius, table.height))
    angle = np.arctan2(table.height, table.radius) if elevation is None else np.radians(elevation)
    return replace(table, radius=float(distance * np.cos(angle)), height=float(distance * np.sin(angle)))


def light_up(source: Path, name: str | None) -> Float64[np.ndarray, "3"]:
    """The direction in the world that is up for the light on a scene with materials.

    Args:
        source: folder of a run, or a file of Gaussians.
        name: the axis that the user says; None for that of the run, or -y.

    Raises:
        ConfigError: the run's settings cannot be read.
    """
    if name is None and is_run(source) and (source / CONFIG).exists():
        return np.array(read_config(source / CONFIG).train.materials.up_world, np.float64)
    return axis_named(name or "-y")


def axis_named(name: str) -> Float64[np.ndarray, "3"]:
    """The unit vector of ``x``, ``-x``, ``y`` and so on."""
    axis = np.eye(3)["xyz".index(name[-1])]
    return -axis if name.startswith("-") else axis

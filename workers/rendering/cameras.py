"""Cameras as the options of ``octasplat render`` or of a job say: a turntable, or a single one."""

from dataclasses import replace
from typing import Any

import numpy as np

from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.operations.axes import axis_named
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

"""Cameras on a circle around a scene, and single cameras that look at it."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from octasplat.engine.dataset.model import Viewpoints
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.render.pinhole_camera import PinholeCamera, focal_from_fov
from octasplat.engine.render.pose_paths import Turntable, look_at
from octasplat.engine.render.shots import (
    DEFAULT_FOV_Y_DEGREES,
    ELEVATION_DEGREES,
    fov_y_of_views,
    gaussian_turntable,
    turntable_cameras,
    turntable_of_views,
)


@dataclass(frozen=True)
class PinholeLens:
    """Image size and field of view of a pinhole camera.

    Attributes:
        width_px: image width.
        height_px: image height.
        fov_y_degrees: field of view from top to bottom.
    """

    width_px: int
    height_px: int
    fov_y_degrees: float


@dataclass(frozen=True)
class Orbit:
    """A circle of cameras around a scene, which look at its centre.

    Attributes:
        target_world: what is looked at; None for the middle of the scene.
        distance_world: from there to the cameras; None for one that fits.
        elevation_degrees: of the cameras above it; None for that of the photographs, or 20.
        up_world: up, for a scene of which no photographs are known.
    """

    up_world: Float64[np.ndarray, "3"]
    target_world: Float64[np.ndarray, "3"] | None = None
    distance_world: float | None = None
    elevation_degrees: float | None = None


def choose_fov_y_degrees(requested_degrees: float | None, viewpoints: Viewpoints | None) -> float:
    """Return the field of view that is asked for, else that of the photographs, else 50 degrees."""
    if requested_degrees is not None:
        return requested_degrees
    return DEFAULT_FOV_Y_DEGREES if viewpoints is None else fov_y_of_views(viewpoints)


def orbit_cameras(
    gaussians: FlatGaussians, viewpoints: Viewpoints | None, lens: PinholeLens, orbit: Orbit, frames: int
) -> tuple[PinholeCamera, ...]:
    """Return cameras in equal steps on one turn round a scene.

    Args:
        gaussians: the scene.
        viewpoints: where its photographs were taken from; None for a file.
        lens: of the cameras.
        orbit: the circle.
        frames: number of cameras.

    Raises:
        ConfigError: the cameras of the photographs share no up direction.
    """
    table = _turntable(gaussians, viewpoints, lens, orbit)
    return turntable_cameras(table, frames, lens.width_px, lens.height_px, lens.fov_y_degrees)


def single_camera(
    gaussians: FlatGaussians,
    viewpoints: Viewpoints | None,
    lens: PinholeLens,
    orbit: Orbit,
    position_world: Float64[np.ndarray, "3"],
) -> PinholeCamera:
    """Return the camera at a position, upright as the orbit and looking at its middle.

    Raises:
        ConfigError: it would look along its up direction, or stands in what it looks at.
    """
    table = _turntable(gaussians, viewpoints, lens, orbit)
    pose = look_at(position_world, table.centre_world, table.up_world)
    focal_px = focal_from_fov(lens.fov_y_degrees, lens.height_px)
    return PinholeCamera.from_pose(pose, lens.width_px, lens.height_px, fy_px=focal_px)


def _turntable(
    gaussians: FlatGaussians, viewpoints: Viewpoints | None, lens: PinholeLens, orbit: Orbit
) -> Turntable:
    elevation = orbit.elevation_degrees
    if viewpoints is None:
        table = gaussian_turntable(
            gaussians,
            up_world=orbit.up_world,
            fov_y_degrees=lens.fov_y_degrees,
            aspect=lens.width_px / lens.height_px,
            elevation_degrees=ELEVATION_DEGREES if elevation is None else elevation,
        )
    else:
        table = turntable_of_views(viewpoints, gaussians)
    if orbit.target_world is not None:
        table = replace(table, centre_world=orbit.target_world)
    # of the photographs or the fitted circle, measured from the middle
    distance = orbit.distance_world or float(np.hypot(table.radius, table.height))
    angle = np.arctan2(table.height, table.radius) if elevation is None else np.radians(elevation)
    return replace(table, radius=float(distance * np.cos(angle)), height=float(distance * np.sin(angle)))

"""Pinhole cameras for new views, and the rays through their pixels."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from jaxtyping import Float, Float64
from numpy.typing import ArrayLike

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.core.rays import ImageRays

_POSE_ERROR = 1e-2
"""Most by which rotation times its transpose may differ from the identity."""


@dataclass(frozen=True, eq=False)
class PinholeCamera:
    """A pinhole camera: looks along +z, x right, y down; pixel centres at +0.5.

    Cameras are equal where all their numbers are.

    Attributes:
        width_px: Image width.
        height_px: Image height.
        fx_px: Focal length across.
        fy_px: Focal length down.
        cx_px: Principal point from the left edge.
        cy_px: Principal point from the top edge.
        rotation_cam_from_world: Takes world directions to camera directions.
        translation_cam_from_world: The world origin in the camera frame.
        near_world: Distance from which on anything is seen.
    """

    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    rotation_cam_from_world: Float64[np.ndarray, "3 3"]
    translation_cam_from_world: Float64[np.ndarray, "3"]
    near_world: float = 0.0

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, PinholeCamera):
            return NotImplemented
        return self._values() == other._values()

    def __hash__(self) -> int:
        return hash(self._values())

    def _values(self) -> tuple[object, ...]:
        """Return all numbers, those of arrays in a row."""
        return tuple(tuple(np.ravel(getattr(self, field.name)).tolist()) for field in fields(self))

    @classmethod
    def from_pose(
        cls,
        world_from_cam: ArrayLike,
        width_px: int,
        height_px: int,
        *,
        fy_px: float,
        fx_px: float | None = None,
        cx_px: float | None = None,
        cy_px: float | None = None,
    ) -> "PinholeCamera":
        """Return a camera at a pose.

        Args:
            world_from_cam: camera-to-world matrix; its lowest row may be left out.
            width_px: image width.
            height_px: image height.
            fy_px: focal length down.
            fx_px: focal length across; by default ``fy_px``.
            cx_px: principal point from the left edge; by default the middle.
            cy_px: principal point from the top edge; by default the middle.

        Raises:
            ConfigError: the pose is no rotation with a place, the image has no pixels, or a focal length is
                not above 0.

        >>> pose = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, -4]]
        >>> PinholeCamera.from_pose(pose, 96, 64, fy_px=80).centre_world
        array([ 0.,  0., -4.])
        """
        pose = _checked_pose(world_from_cam)
        _check_size(width_px, height_px)
        if not (fy_px > 0 and (fx_px is None or fx_px > 0)):
            raise ConfigError("A focal length must be above 0 px.")
        rotation = pose[:3, :3].T
        return cls(
            width_px=int(width_px),
            height_px=int(height_px),
            fx_px=fy_px if fx_px is None else fx_px,
            fy_px=fy_px,
            cx_px=width_px / 2 if cx_px is None else cx_px,
            cy_px=height_px / 2 if cy_px is None else cy_px,
            rotation_cam_from_world=np.ascontiguousarray(rotation),
            translation_cam_from_world=-rotation @ pose[:3, 3],
        )

    @classmethod
    def looking_at(
        cls,
        position_world: Sequence[float],
        target_world: Sequence[float],
        width_px: int = 640,
        height_px: int = 480,
        *,
        fov_y_degrees: float = 50.0,
        up_world: Sequence[float] = (0.0, -1.0, 0.0),
    ) -> "PinholeCamera":
        """Return a camera that looks at a point and holds ``up_world`` upright in its image.

        Raises:
            ConfigError: it stands in its target, looks along the up direction, or is no camera by its size or
                its field of view; or a point is none.

        >>> PinholeCamera.looking_at((0, 0, -4), (0, 0, 0), 96, 64).centre_world
        array([ 0.,  0., -4.])
        """
        from octasplat.engine.render.pose_paths import look_at

        check_lens(width_px, height_px, fov_y_degrees)
        position, target, up = (
            np.array(vector, np.float64) for vector in (position_world, target_world, up_world)
        )
        if not all(point.shape == (3,) and np.isfinite(point).all() for point in (position, target, up)):
            raise ConfigError("A position, a target and an up direction each have three finite numbers.")
        focal_px = focal_from_fov(fov_y_degrees, height_px)
        return cls.from_pose(look_at(position, target, up), width_px, height_px, fy_px=focal_px)

    @property
    def centre_world(self) -> Float64[np.ndarray, "3"]:
        """Return the camera's centre, world frame."""
        return np.asarray(-self.rotation_cam_from_world.T @ self.translation_cam_from_world)

    @property
    def world_from_cam(self) -> Float64[np.ndarray, "4 4"]:
        """Return the camera-to-world matrix."""
        pose = np.eye(4)
        pose[:3, :3] = self.rotation_cam_from_world.T
        pose[:3, 3] = self.centre_world
        return pose

    def rays(self) -> ImageRays:
        """Return the unit rays through the pixels' centres."""
        x = (np.arange(self.width_px) + 0.5 - self.cx_px) / self.fx_px
        y = (np.arange(self.height_px) + 0.5 - self.cy_px) / self.fy_px
        directions_cam = np.empty((self.height_px, self.width_px, 3))
        directions_cam[..., 0] = x
        directions_cam[..., 1] = y[:, None]
        directions_cam[..., 2] = 1.0
        directions_cam /= np.linalg.norm(directions_cam, axis=-1, keepdims=True)
        directions_world = directions_cam @ self.rotation_cam_from_world
        axis_world = self.rotation_cam_from_world[2]
        return ImageRays.from_directions(self.centre_world, directions_world, self.near_world, axis_world)

    def project(self, points_world: Float[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 2"]:
        """Return the pixel coordinates of points; NaN for those not in front of the camera."""
        points_cam = points_world @ self.rotation_cam_from_world.T + self.translation_cam_from_world
        # not-a-number propagates to both coordinates
        depth = np.where(points_cam[:, 2] > 0, points_cam[:, 2], np.nan)
        across = self.fx_px * points_cam[:, 0] / depth + self.cx_px
        return np.stack([across, self.fy_px * points_cam[:, 1] / depth + self.cy_px], axis=-1)


def _checked_pose(world_from_cam: ArrayLike) -> Float64[np.ndarray, "r 4"]:
    """Return a pose as float64; refuses what is no rotation with a place."""
    try:
        pose = np.array(world_from_cam, np.float64)
    except (TypeError, ValueError):
        pose = np.zeros(0)
    if pose.shape not in ((4, 4), (3, 4)):
        raise ConfigError("world_from_cam: must be a 4 x 4 or 3 x 4 matrix of numbers.")
    rotation = pose[:3, :3]
    # Poses in float32 and rounded ones pass.
    is_rotation = np.isfinite(pose).all() and np.abs(rotation @ rotation.T - np.eye(3)).max() < _POSE_ERROR
    if not is_rotation or np.linalg.det(rotation) < 0:
        raise ConfigError(
            "world_from_cam: must hold a rotation without scale or mirroring and the camera's place, from "
            "the camera to the world, where x points right, y down and z forward."
        )
    return pose


def _check_size(width_px: Any, height_px: Any) -> None:
    """Refuse what is no size of an image, whatever it is."""
    for name, side in (("width_px", width_px), ("height_px", height_px)):
        if not isinstance(side, int | np.integer):
            raise ConfigError(f"{name}: must be a whole number of pixels (it is {side!r}).")
    if min(width_px, height_px) < 1:
        raise ConfigError(f"An image of {width_px} x {height_px} pixels has none; both must be at least 1.")


def check_lens(width_px: Any, height_px: Any, fov_y_degrees: float) -> None:
    """Refuse what is no size of an image or no field of view of a pinhole.

    Raises:
        ConfigError: the image has no pixels or parts of them, or the angle is not between 0 and 180 degrees.
    """
    _check_size(width_px, height_px)
    if not 0 < fov_y_degrees < 180:
        raise ConfigError(f"A field of view lies between 0 and 180 degrees; it was given {fov_y_degrees:g}.")


def focal_from_fov(fov_degrees: float, side_px: int) -> float:
    """Return the focal length in pixels at which ``side_px`` pixels span ``fov_degrees``."""
    return side_px / (2 * math.tan(math.radians(fov_degrees) / 2))

"""Camera paths: around an object, or smoothly through given poses.

Poses are camera-to-world matrices in float64; cameras look along +z, x right, y down.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from octasplat.engine.core.errors import ConfigError

_WRAPPED_KEYS = 3
"""How many keys of a closed path are repeated before and after it, so that its ends join smoothly."""


@dataclass(frozen=True)
class Turntable:
    """A circle around an axis from which a camera looks at a point.

    Attributes:
        centre_world: The point looked at.
        up_world: Unit direction of the axis.
        radius: Of the circle, in scene units.
        height: Of the circle above the centre along the axis, in scene units.
        start_world: Direction from the axis towards the first camera; ``None`` for any.
    """

    centre_world: Float64[np.ndarray, "3"]
    up_world: Float64[np.ndarray, "3"]
    radius: float
    height: float
    start_world: Float64[np.ndarray, "3"] | None = None

    def poses(self, frames: int) -> Float64[np.ndarray, "frames 4 4"]:
        """Return one turn in equal steps; see :func:`turntable`."""
        return turntable(
            self.centre_world, self.up_world, self.radius, self.height, frames, start_world=self.start_world
        )


def look_at(
    position_world: Float64[np.ndarray, "3"],
    target_world: Float64[np.ndarray, "3"],
    up_world: Float64[np.ndarray, "3"],
) -> Float64[np.ndarray, "4 4"]:
    """Return the pose of a camera that looks at a target and holds ``up_world`` upright in its image.

    Raises:
        ConfigError: The camera stands in its target, or looks along the up direction.
    """
    forward = target_world - position_world
    right = np.cross(forward, up_world)
    if not np.linalg.norm(right) > 1e-9 * np.linalg.norm(forward) * np.linalg.norm(up_world):
        raise ConfigError(
            "A camera cannot look along its up direction or stand in its own target; move it aside."
        )
    forward = forward / np.linalg.norm(forward)
    right = right / np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=-1)
    pose[:3, 3] = position_world
    return pose


def turntable(
    centre_world: Float64[np.ndarray, "3"],
    up_world: Float64[np.ndarray, "3"],
    radius: float,
    height: float,
    frames: int,
    *,
    start_world: Float64[np.ndarray, "3"] | None = None,
    turns: float = 1.0,
) -> Float64[np.ndarray, "frames 4 4"]:
    """Return poses on a circle, all looking at its axis' ``centre_world``; the last step closes the circle.

    Args:
        centre_world: The point looked at.
        up_world: Direction of the axis, of any length.
        radius: Distance from the axis; more than 0.
        height: Of the circle above the centre, along the axis.
        frames: How many poses; at least 1.
        start_world: Direction from the axis to the first camera; any by default.
        turns: Counter-clockwise seen from above; negative for clockwise.

    Raises:
        ConfigError: The radius, the axis or the number of frames makes no circle.
    """
    if not radius > 0 or frames < 1 or not np.linalg.norm(up_world) > 0:
        raise ConfigError(
            f"A turntable needs a radius above 0, an up direction and at least one frame; it was given "
            f"radius {radius}, up {up_world.tolist()} and {frames} frames."
        )
    up = up_world / np.linalg.norm(up_world)
    first = np.zeros(3) if start_world is None else start_world - up * (up @ start_world)
    if np.linalg.norm(first) < 1e-9:  # parallel to the axis, or not given
        helper = np.eye(3)[np.argmin(np.abs(up))]
        first = helper - up * (up @ helper)  # any direction across the axis, the same each time
    first = first / np.linalg.norm(first)
    second = np.cross(up, first)
    angles = 2 * np.pi * turns * np.arange(frames) / frames
    positions = (
        centre_world
        + radius * (np.cos(angles)[:, None] * first + np.sin(angles)[:, None] * second)
        + height * up
    )
    return np.stack([look_at(position, centre_world, up) for position in positions])


def fit_turntable(
    camera_centres: Float64[np.ndarray, "n 3"],
    camera_forwards: Float64[np.ndarray, "n 3"],
    camera_ups: Float64[np.ndarray, "n 3"],
    *,
    centre_if_parallel: Callable[[], Float64[np.ndarray, "3"]] | None = None,
) -> Turntable:
    """Return the circle around what the cameras look at, at their typical distance and height.

    The centre is the point nearest to all viewing axes, by least squares with weights that fall with the
    distance, so that a few cameras that look elsewhere do not move it. Up is the mean of the cameras' up
    directions (their -y axes); radius and height are medians over the cameras.

    Args:
        camera_centres: In the world.
        camera_forwards: Viewing directions.
        camera_ups: Up directions.
        centre_if_parallel: Gives the centre where all cameras look the same way; None refuses these.

    Raises:
        ConfigError: There is no such point or direction: too few cameras, or all look the same way.
    """
    forwards = camera_forwards / np.linalg.norm(camera_forwards, axis=-1, keepdims=True)
    up = camera_ups.sum(axis=0)
    if len(forwards) < 2 or not np.linalg.norm(up) > 1e-3 * len(forwards):
        raise ConfigError("These cameras share no up direction; give the turntable's centre and up yourself.")
    up = up / np.linalg.norm(up)
    centre = _nearest_to_axes(camera_centres, forwards)
    if centre is None and centre_if_parallel is not None:
        centre = centre_if_parallel()
    if centre is None:
        raise ConfigError(
            "The cameras all look the same way, so that they have no common centre; "
            "give the turntable's centre yourself."
        )
    offsets = camera_centres - centre
    heights = offsets @ up
    across = offsets - heights[:, None] * up
    radius = float(np.median(np.linalg.norm(across, axis=-1)))
    if not radius > 0:
        raise ConfigError("The cameras stand above what they look at; give the turntable's radius yourself.")
    return Turntable(centre, up, radius, float(np.median(heights)), start_world=across[0])


@dataclass(frozen=True)
class PosePath:
    """A smooth path through key poses.

    Positions follow a Catmull-Rom spline, orientations a spline without jumps in angular velocity. The time
    between two keys grows with the square root of their distance ("centripetal"), which keeps the path from
    overshooting where keys lie close together.

    Attributes:
        poses: The key poses.
        closed: Whether the path returns from the last key to the first.
    """

    poses: Float64[np.ndarray, "n 4 4"]
    closed: bool = False

    def __post_init__(self) -> None:
        kind, least = ("closed", 3) if self.closed else ("open", 2)
        if len(self.poses) < least:
            raise ConfigError(f"A camera path that is {kind} needs at least {least} poses.")

    @property
    def key_times(self) -> Float64[np.ndarray, "m"]:
        """Return the times of the keys, from 0 to 1; a closed path passes the first key again at 1."""
        positions = self.poses[:, :3, 3]
        if self.closed:
            positions = np.concatenate([positions, positions[:1]])
        spans = np.sqrt(np.linalg.norm(np.diff(positions, axis=0), axis=-1))
        # Keys in one place, which only turn the camera, still take some time.
        spans = np.maximum(spans, 0.2 * spans.mean()) if spans.any() else np.ones(len(spans))
        times = np.concatenate([[0.0], np.cumsum(spans)])
        return np.asarray(times / times[-1])

    def poses_at(self, times: Float64[np.ndarray, "k"]) -> Float64[np.ndarray, "k 4 4"]:
        """Return the poses at times from 0 to 1."""
        # here, as most commands that import this module follow no path
        from scipy.interpolate import CubicHermiteSpline
        from scipy.spatial.transform import Rotation, RotationSpline

        key_times, order = self.key_times, np.arange(len(self.poses))
        if self.closed:
            # A few keys from the other end make the joint as smooth as the rest.
            wrapped = min(_WRAPPED_KEYS, len(self.poses))
            order = np.concatenate([order[-wrapped:], order, order[:1], np.roll(order, -1)[:wrapped]])
            key_times = np.concatenate(
                [key_times[-1 - wrapped : -1] - 1, key_times, key_times[1 : 1 + wrapped] + 1]
            )
        positions = self.poses[order, :3, 3]
        rotations = Rotation.from_matrix(self.poses[order, :3, :3])
        path = np.tile(np.eye(4), (len(times), 1, 1))
        path[:, :3, 3] = CubicHermiteSpline(
            key_times, positions, _catmull_rom_velocities(key_times, positions)
        )(times)
        path[:, :3, :3] = RotationSpline(key_times, rotations)(times).as_matrix()
        return path


def interpolate(
    poses: Float64[np.ndarray, "n 4 4"], frames: int, *, closed: bool = False
) -> Float64[np.ndarray, "frames 4 4"]:
    """Return poses in equal time steps along a smooth path through key poses.

    An open path starts at the first key and ends at the last; a closed one leads back to the first, which is
    not repeated at the end.

    Raises:
        ConfigError: Fewer than two poses (three for a closed path), or fewer than two frames.
    """
    if frames < 2:
        raise ConfigError("A camera path needs at least two frames.")
    return PosePath(poses, closed).poses_at(np.linspace(0.0, 1.0, frames, endpoint=not closed))


def _catmull_rom_velocities(
    times: Float64[np.ndarray, "n"], positions: Float64[np.ndarray, "n 3"]
) -> Float64[np.ndarray, "n 3"]:
    """Return Catmull-Rom velocities at uneven times: of the parabola through each key and its neighbours."""
    spans = np.diff(times)[:, None]
    slopes = np.diff(positions, axis=0) / spans
    if len(slopes) == 1:
        return np.concatenate([slopes, slopes])
    # derivative of the parabola through three keys, at the middle one
    inner = (slopes[:-1] * spans[1:] + slopes[1:] * spans[:-1]) / (spans[:-1] + spans[1:])
    # at the ends the derivative of the outer parabola
    return np.concatenate([2 * slopes[:1] - inner[:1], inner, 2 * slopes[-1:] - inner[-1:]])


def _nearest_to_axes(
    centres: Float64[np.ndarray, "n 3"], forwards: Float64[np.ndarray, "n 3"]
) -> Float64[np.ndarray, "3"] | None:
    """Return the point with the least sum of distances to lines, by reweighted least squares.

    None where all lines are parallel.
    """
    # I - d d^T: distance vectors to the line
    across = np.eye(3) - forwards[:, :, None] * forwards[:, None, :]
    projected = np.einsum("nij,nj->ni", across, centres)
    extent = float(np.linalg.norm(np.ptp(centres, axis=0)))
    weights = np.ones(len(centres))
    point = np.zeros(3)
    for _ in range(30):
        matrix = np.einsum("n,nij->ij", weights, across) / weights.sum()
        if np.linalg.eigvalsh(matrix)[0] < 1e-5:  # all axes parallel: the smallest eigenvalue vanishes
            return None
        before = point
        point = np.linalg.solve(matrix, (weights @ projected) / weights.sum())
        if np.linalg.norm(point - before) < 1e-9 * max(extent, 1e-12):
            break
        distances = np.linalg.norm(np.einsum("nij,nj->ni", across, point - centres), axis=-1)
        # weights 1 / distance: the sum of distances instead of squares
        weights = 1.0 / np.maximum(distances, max(1e-3 * extent, 1e-12))
    return point

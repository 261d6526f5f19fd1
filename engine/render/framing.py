"""Visible bounds of a scene, and the camera distance at which they fit into an image."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float64

from octasplat.engine.gaussians.model import FlatGaussians

MARGIN = 1.08
"""Images are this much wider than what they frame."""
_MIN_OPACITY = 0.1
"""Fainter Gaussians are haze."""
_REACH = 3.5
"""What lies further from the middle than this many times three quarters of the scene is its surroundings."""
_TAIL_QUANTILE = 0.002
"""Share of the opacity at either end of an extent that may be strays."""
_RING = 64


@dataclass(frozen=True)
class VisibleBounds:
    """An upright bounding cylinder of the visible part of a scene.

    Attributes:
        centre_world: its middle.
        up_world: its axis, of unit length.
        radius: world units.
        half_height: world units.
    """

    centre_world: Float64[np.ndarray, "3"]
    up_world: Float64[np.ndarray, "3"]
    radius: float
    half_height: float


def visible_bounds(gaussians: FlatGaussians, up_world: Float64[np.ndarray, "3"]) -> VisibleBounds:
    """Return a robust cylinder around the opaque Gaussians; distant surroundings and outliers do not count.

    Args:
        gaussians: at least one.
        up_world: direction of the axis, of any length.
    """
    up = up_world / np.linalg.norm(up_world)
    solid = core_gaussians(gaussians)
    points = gaussians.means_world[solid].astype(np.float64)
    reach = np.exp(gaussians.log_scales[solid].astype(np.float64)).max(axis=1)
    weights = gaussians.opacities[solid].astype(np.float64)
    heights = points @ up
    low, high = _robust_range(heights, reach, weights)
    across = points - heights[:, None] * up
    first = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    first /= np.linalg.norm(first)
    second = np.cross(up, first)
    middle = np.zeros(3)
    for axis in (first, second):
        left, right = _robust_range(across @ axis, reach, weights)
        middle += 0.5 * (left + right) * axis
    outwards = np.linalg.norm(across - middle, axis=1)
    radius = max(_robust_range(outwards, reach, weights)[1], 0.0)
    half_height = 0.5 * (high - low)
    smallest = 1e-6 * max(radius, half_height, float(reach.max()))  # a point or a line has a size as well
    return VisibleBounds(
        middle + 0.5 * (low + high) * up, up, max(radius, smallest), max(half_height, smallest)
    )


def core_gaussians(gaussians: FlatGaussians) -> Bool[np.ndarray, " n"]:
    """Return the Gaussians that are neither faint nor far outside of most others; at least one."""
    opacities = gaussians.opacities
    # a scene of haze alone is framed by its densest half
    solid = opacities >= min(_MIN_OPACITY, 0.5 * float(opacities.max()))
    points = gaussians.means_world.astype(np.float64)
    centre = np.median(points[solid], axis=0)
    distances = np.linalg.norm(points - centre, axis=1)
    most = float(np.quantile(distances[solid], 0.75))
    return np.asarray(solid & (distances <= _REACH * most)) if most > 0 else np.asarray(solid)


def fitting_distance(
    bounds: VisibleBounds, elevation_degrees: float, fov_y_degrees: float, aspect: float
) -> float:
    """Return the camera's distance at which the cylinder fits into its image, with a margin.

    Args:
        bounds: the cylinder.
        elevation_degrees: of the camera above the middle.
        fov_y_degrees: angle from the top of the image to its bottom.
        aspect: width over height of the image.
    """
    elevation, angles = np.radians(elevation_degrees), np.linspace(0, 2 * np.pi, _RING, endpoint=False)
    slope_y = np.tan(np.radians(fov_y_degrees) / 2) / MARGIN
    slope_x = slope_y * aspect
    along, across = bounds.radius * np.cos(angles), bounds.radius * np.sin(angles)
    needed = 0.0
    for height in (-bounds.half_height, bounds.half_height):
        # seen from the camera: how much nearer, and how far up, each rim point lies
        nearer = along * np.cos(elevation) + height * np.sin(elevation)
        upwards = height * np.cos(elevation) - along * np.sin(elevation)
        reach = np.maximum(np.abs(across) / slope_x, np.abs(upwards) / slope_y)
        needed = max(needed, float((nearer + reach).max()))
    return needed


def _robust_range(
    values: Float64[np.ndarray, " n"], reach: Float64[np.ndarray, " n"], weights: Float64[np.ndarray, " n"]
) -> tuple[float, float]:
    """Return the range of all values but the tails, each value extended by a standard deviation."""
    low = _end_of_tail(values - reach, weights, "left")
    # the largest value of all that have no more than the tail above them
    return low, -_end_of_tail(-values - reach, weights, "right")


def _end_of_tail(
    values: Float64[np.ndarray, " n"], weights: Float64[np.ndarray, " n"], side: Literal["left", "right"]
) -> float:
    """Return the value up to which the weights come to those of a tail."""
    tail, least = _TAIL_QUANTILE * float(weights.sum()), float(weights.min())
    # no more can be part of it, so that no others are sorted
    count = int(min(tail / least + 2, len(values))) if least > 0 else len(values)
    some = np.argpartition(values, count - 1)[:count]
    order = some[np.argsort(values[some])]
    sums = np.cumsum(weights[order])
    return float(values[order[min(int(np.searchsorted(sums, tail, side)), count - 1)]])

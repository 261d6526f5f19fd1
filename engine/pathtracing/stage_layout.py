"""Layout of the first stage of a scene: its floor, its size and the main light's direction."""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float32, Float64

from octasplat.engine.core.rays import RayBatch
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.pathtracing.stage.stage_template import BALL_RADIUS_FRACTION, StageLayout
from octasplat.engine.trace.protocol import Tracer

LEVEL_COSINE = 0.9
MAX_FLOOR_SPOTS = 256
MIN_OPACITY = 0.3
MIN_LEVEL_FRACTION = 0.08
"""Share of the surface at the floor's height that looks up; of a scene without a floor it is some 0.05, as if
surfaces looked anywhere, of a crumpled blanket 0.11, of a table with things on it one half."""
ALONE_FRACTION = 0.9
"""Share of the surface about what the cameras look at, in a scene of a thing that stands alone."""
LEGS_FRACTION, LEGS_DEPTH = 0.01, 0.15
"""Share of the surface that is enough to stand on, as thin legs are, where it is so far below, in sizes."""
LOWEST_QUANTILE, LOWEST_OF_LEGS = 0.005, 0.1
"""Share of the surface of a thing, and of what is below its level part, that may lie below its foot, as stray
Gaussians do."""
BESIDE_SPOTS = 32
HANGING_FRACTIONS = (0.2, 0.3, 0.4, 0.5, 0.6)
"""Where a ball hangs free, on the way from what the cameras look at to the middle of them."""


def estimate_stage_layout(
    gaussians: FlatGaussians,
    tracer: Tracer,
    up_world: Float64[np.ndarray, "3"],
    centre_world: Float64[np.ndarray, "3"],
    size: float,
    cameras_world: Float64[np.ndarray, "c 3"],
) -> StageLayout:
    """Return the layout of a first stage: up, floor, size and light.

    Args:
        gaussians: of the scene.
        tracer: of the same Gaussians.
        up_world: up.
        centre_world: of what the cameras look at.
        size: about as large as that, world units.
        cameras_world: where some of the cameras are, that of a preview first.
    """
    up = up_world / np.linalg.norm(up_world)
    near = np.linalg.norm(gaussians.means_world - centre_world, axis=1) < 1.5 * size
    some = gaussians.select(near & (gaussians.opacities > MIN_OPACITY))
    if len(some) < 10:
        return _stage_layout(up, centre_world, size, -up)
    normals = some.rotations[:, :, 0].astype(np.float64)
    towards = cameras_world.mean(axis=0) - some.means_world
    # either side is outside: that which faces the cameras counts
    normals *= np.where((normals * towards).sum(axis=1) < 0, -1.0, 1.0)[:, None]
    area = (some.opacities * np.exp(some.log_scales.sum(axis=1))).astype(np.float64)
    spots, standing = _find_floor(some.means_world.astype(np.float64), normals @ up, area, up, size)
    above = 0.05 * size * up  # the surface itself is not in the way of what is somewhat above it
    visibility = _visibility(tracer, cameras_world, spots + above)
    free = np.full(len(spots), 0.3 * size)
    if len(standing):
        from scipy.spatial import cKDTree  # here, as every render imports this module

        free = np.minimum(cKDTree(standing).query(spots)[0], free)
    away = np.linalg.norm(spots - centre_world, axis=1)
    floor = spots[np.argmax(size * visibility + free - 0.7 * away)]
    light = -_estimate_light_direction(some.base_rgb_srgb, normals, area, up)
    heights, cosines = some.means_world.astype(np.float64) @ up, normals @ up
    height = float(spots[0] @ up)
    if level_fraction(heights, cosines, area, height, size) >= MIN_LEVEL_FRACTION:
        # the thing's own level surface is no floor if much of it lies lower
        if not (_stands_alone(gaussians, near) and _is_within(heights, cosines, area, height, size)):
            return _stage_layout(up, floor, size, light)
        spots = _spots_beside(some.means_world.astype(np.float64), area, up, size, height)
        visibility = _visibility(tracer, cameras_world, spots + above)
        # a preview shows what the first camera sees
        is_seen = _visibility(tracer, cameras_world[:1], spots + above) > 0.9
        nearness = (spots - centre_world) @ (cameras_world[0] - centre_world)
        # equally visible spots: the one towards that camera
        best = np.lexsort((nearness, np.round(visibility, 2), is_seen))[-1]
        return replace(_stage_layout(up, spots[best], size, light), is_beside=True)
    places = centre_world + np.array(HANGING_FRACTIONS)[:, None] * (cameras_world.mean(axis=0) - centre_world)
    visibility = _visibility(tracer, cameras_world, places)
    hanging = places[np.argmax(visibility > 0.9 * visibility.max())]
    return replace(
        _stage_layout(up, hanging - BALL_RADIUS_FRACTION * size * up, size, light), has_floor=False
    )


def _visibility(
    tracer: Tracer, cameras_world: Float64[np.ndarray, "c 3"], places_world: Float64[np.ndarray, "s 3"]
) -> Float32[np.ndarray, " s"]:
    """Return the mean transmittance from the cameras to each place."""
    ways = [RayBatch.between(camera[None], places_world) for camera in cameras_world]
    return np.asarray(np.mean([tracer.transmittance(way) for way in ways], axis=0))


def _stands_alone(gaussians: FlatGaussians, near: Bool[np.ndarray, " n"]) -> bool:
    """Return whether next to nothing of the scene lies elsewhere than what the cameras look at."""
    area = gaussians.opacities * np.exp(gaussians.log_scales.sum(axis=1))
    return bool(area[near].sum() > ALONE_FRACTION * area.sum())


def _is_within(
    heights: Float64[np.ndarray, " n"],
    cosines: Float64[np.ndarray, " n"],
    area: Float64[np.ndarray, " n"],
    height: float,
    size: float,
) -> bool:
    """Return whether more of the surface lies below a height than is level there, or legs reach far below."""
    level = (np.abs(heights - height) < 0.05 * size) & (cosines > LEVEL_COSINE)
    has_legs = area[heights < height - LEGS_DEPTH * size].sum() > LEGS_FRACTION * area.sum()
    return bool(has_legs or area[heights < height - 0.06 * size].sum() > area[level].sum())


def _spots_beside(
    points: Float64[np.ndarray, "n 3"],
    area: Float64[np.ndarray, " n"],
    up: Float64[np.ndarray, "3"],
    size: float,
    level_height: float,
) -> Float64[np.ndarray, "s 3"]:
    """Return places around a thing, on a level with its lowest point, below its level part at a height."""
    heights = points @ up
    order = np.argsort(heights)
    shares = np.cumsum(area[order]) / area.sum()
    of_legs = LOWEST_OF_LEGS * area[heights < level_height - 0.06 * size].sum() / area.sum()
    foot = heights[order[np.searchsorted(shares, min(LOWEST_QUANTILE, of_legs))]]
    level = points - heights[:, None] * up
    middle = (level * area[:, None]).sum(axis=0) / area.sum()
    across = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    across /= np.linalg.norm(across)
    angles = 2 * np.pi * np.arange(BESIDE_SPOTS) / BESIDE_SPOTS
    ways = np.cos(angles)[:, None] * across + np.sin(angles)[:, None] * np.cross(up, across)
    reach = np.quantile((level - middle) @ ways.T, 0.99, axis=0) + 1.5 * BALL_RADIUS_FRACTION * size
    return np.asarray(middle + reach[:, None] * ways + foot * up)


def level_fraction(
    heights: Float64[np.ndarray, " n"],
    cosines: Float64[np.ndarray, " n"],
    area: Float64[np.ndarray, " n"],
    height: float,
    size: float,
) -> float:
    """Return the fraction of the surface about a height whose normals point up."""
    near = np.abs(heights - height) < 0.05 * size
    return float(area[near & (cosines > LEVEL_COSINE)].sum() / max(area[near].sum(), 1e-30))


def _find_floor(
    points: Float64[np.ndarray, "n 3"],
    cosines: Float64[np.ndarray, " n"],
    area: Float64[np.ndarray, " n"],
    up: Float64[np.ndarray, "3"],
    size: float,
) -> tuple[Float64[np.ndarray, "s 3"], Float64[np.ndarray, "k 3"]]:
    """Return points at the height of most level surface, and the points that rest on it."""
    heights = points @ up
    level = cosines > LEVEL_COSINE
    if not level.any():
        level = np.ones(len(points), bool)
    bins = np.linspace(heights.min(), heights.max() + 1e-9, 65)
    counts = np.histogram(heights[level], bins, weights=area[level])[0]
    # smoothed over neighboring bins, as a floor may straddle two
    peak = int(np.argmax(np.convolve(counts, [0.5, 1.0, 0.5], mode="same")))
    height = (bins[peak] + bins[peak + 1]) / 2
    on_floor = np.flatnonzero(level & (np.abs(heights - height) < 0.05 * size))
    if len(on_floor) == 0:
        on_floor = np.flatnonzero(level)
    spots = points[on_floor[:: max(1, len(on_floor) // MAX_FLOOR_SPOTS)]]
    spots = spots + (height - spots @ up)[:, None] * up
    return spots, points[heights > height + 0.06 * size]


def _estimate_light_direction(
    rgb_srgb: Float32[np.ndarray, "n 3"],
    normals: Float64[np.ndarray, "n 3"],
    area: Float64[np.ndarray, " n"],
    up: Float64[np.ndarray, "3"],
) -> Float64[np.ndarray, "3"]:
    """Return the mean normal of bright surfaces, at least 30 degrees above the horizon."""
    bright = rgb_srgb.astype(np.float64).mean(axis=1)
    matrix = np.concatenate([np.ones((len(bright), 1)), normals], axis=1)
    weights = np.sqrt(np.minimum(area, np.quantile(area, 0.95)))  # large Gaussians must not decide alone
    towards = np.linalg.lstsq(matrix * weights[:, None], bright * weights, rcond=None)[0][1:]
    level = towards - (towards @ up) * up
    height = max(towards @ up, 0.6 * float(np.linalg.norm(level)), 1e-9)
    towards = level + height * up
    return np.asarray(towards / np.linalg.norm(towards))


def _stage_layout(
    up: Float64[np.ndarray, "3"],
    floor: Float64[np.ndarray, "3"],
    size: float,
    light: Float64[np.ndarray, "3"],
) -> StageLayout:
    def three(values: Float64[np.ndarray, "3"]) -> tuple[float, float, float]:
        return float(values[0]), float(values[1]), float(values[2])

    return StageLayout(three(up), three(floor), size, three(light))

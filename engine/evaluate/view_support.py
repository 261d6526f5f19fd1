"""What training views say of a held-out view: how many see each place, and whether its depth is right."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64
from scipy.ndimage import uniform_filter

from octasplat.engine.core.rays import ImageRays, RayBatch
from octasplat.engine.dataset import Dataset
from octasplat.engine.dataset.view_frusta import cam_from_world, is_in_image
from octasplat.engine.evaluate.gallery import magma
from octasplat.engine.trace.protocol import Tracer

MAX_ANGLE_DEG = 15.0
"""A training view that sees a place from farther round says little of how it looks from here."""
REACHED = 0.97
"""A place is seen where half of the light comes this share of the way to it."""
COUNT_EDGES = (0, 1, 2, 3, 5, 9, 17)
"""Where the groups of pixels by number of views begin."""
GROUP_NAMES = ("0", "1", "2", "3 to 4", "5 to 8", "9 to 16", "more")
FEW_VIEWS = 3
"""A place that fewer training views see is badly covered: the first groups, one for each number."""
DEPTH_TOLERANCE = 0.03
"""Share of its distance by which the depth of a sparse point is wrong."""
AROUND_PX = 5
MAX_POINTS = 3000
"""Pixels of a view that are asked."""
DARK_FROM = 9
"""Training views from which on a place counts as well covered on a map."""
UNKNOWN_GRAY = 0.25


@dataclass(frozen=True)
class Support:
    """Pixels of a view on a grid.

    Attributes:
        pixels: their numbers, row by row over the whole view.
        counts: training views that see the place which each pixel shows, within :data:`MAX_ANGLE_DEG`; -1
            where it shows none.
        errors: the pixels' squared errors, means over the channels.
    """

    pixels: Int64[np.ndarray, " p"]
    counts: Int64[np.ndarray, " p"]
    errors: Float64[np.ndarray, " p"]

    @property
    def few_fraction(self) -> float:
        """Return the share of the pixels that show something which fewer than three training views see."""
        few = (self.counts >= 0) & (self.counts < FEW_VIEWS)
        return float(few.mean()) if len(few) else 0.0


@dataclass(frozen=True)
class PointDepths:
    """Sparse points of a view.

    Attributes:
        relative: traced depth over the points' distance, less 1; -1 where nothing was met.
        errors: squared error around each point.
    """

    relative: Float64[np.ndarray, " k"]
    errors: Float64[np.ndarray, " k"]

    @property
    def wrong(self) -> Bool[np.ndarray, " k"]:
        """Return which points have another depth than the sparse model says."""
        return np.asarray(np.abs(self.relative) > DEPTH_TOLERANCE)


def measure_support(
    dataset: Dataset,
    tracer: Tracer,
    image: ImageRays,
    depth_median: Float32[np.ndarray, "h w"],
    squared_error: Float64[np.ndarray, "h w"],
    weight: Float32[np.ndarray, "h w"],
    stride: int,
) -> Support:
    """Return how many training views see what every ``stride``-th pixel shows, each way.

    Args:
        dataset: whose training views they are.
        tracer: built around the scene, which hides places from views.
        image: the view's rays.
        depth_median: what they found.
        squared_error: of the view's pixels.
        weight: of its pixels; those without are left out.
        stride: pixels between two that are asked.
    """
    grid = np.zeros(depth_median.shape, np.bool_)
    grid[stride // 2 :: stride, stride // 2 :: stride] = True
    rows = np.flatnonzero((grid & (weight > 0)).reshape(-1))
    depth = depth_median.reshape(-1)[rows].astype(np.float64)
    ways = image.directions_world.reshape(-1, 3)[rows].astype(np.float64)
    points = image.origin_world.astype(np.float64) + depth[:, None] * ways
    counts = np.where(depth > 0, 0, -1)
    for index in dataset.train_indices.tolist():
        view = dataset.views[index]
        away = points - view.origin_world
        length = np.maximum(np.linalg.norm(away, axis=1), 1e-12)
        near = (away * ways).sum(axis=1) / length > np.cos(np.radians(MAX_ANGLE_DEG))
        asked = np.flatnonzero((depth > 0) & near)
        inside = is_in_image(cam_from_world(points[asked], view), dataset.cameras[view.camera_index])
        asked = asked[inside]
        if len(asked):
            counts[asked] += sees(tracer, view.origin_world, points[asked])
    return Support(rows, counts, squared_error.reshape(-1)[rows])


def grid_stride(height_px: int, width_px: int) -> int:
    """Return the pixels between two that are asked, so that a view has about :data:`MAX_POINTS` of them."""
    return max(1, math.ceil(math.sqrt(width_px * height_px / MAX_POINTS)))


def coverage_picture(
    support: Support, width_px: int, height_px: int, stride: int
) -> Float32[np.ndarray, "h w 3"]:
    """Return a map of the counts: bright where no training view sees a place, dark from nine on.

    Gray where the view shows nothing, or was not asked.
    """
    rows, columns = np.divmod(support.pixels, width_px)
    few = 1.0 - np.clip(support.counts, 0, DARK_FROM) / DARK_FROM
    shape = (-(-height_px // stride), -(-width_px // stride))
    grid = np.full((*shape, 3), UNKNOWN_GRAY, np.float32)
    shown = support.counts >= 0
    grid[rows[shown] // stride, columns[shown] // stride] = magma(few[shown].astype(np.float32))
    return np.repeat(np.repeat(grid, stride, axis=0), stride, axis=1)[:height_px, :width_px]


def sees(
    tracer: Tracer, viewer_world: Float64[np.ndarray, "3"], points_world: Float64[np.ndarray, "n 3"]
) -> Bool[np.ndarray, " n"]:
    """Return to which points at least half of the light of a viewer comes."""
    rays = RayBatch.between(viewer_world[None], points_world)
    # As whole traces, whose kernels are compiled already.
    found = tracer.trace(rays.with_t_max(np.float32(REACHED) * rays.t_max))
    return np.asarray(found.transmittance > 0.5)


def measure_points(
    dataset: Dataset,
    index: int,
    depth_median: Float32[np.ndarray, "h w"],
    squared_error: Float64[np.ndarray, "h w"],
) -> PointDepths:
    """Return the depths at the sparse points that a view shows, and that training views alone determine."""
    seen = np.flatnonzero(dataset.observations.view == index)
    if len(seen) == 0 or len(dataset.points) == 0:
        return PointDepths(np.zeros(0), np.zeros(0))
    row, known = dataset.points.rows_of(dataset.observations.point[seen])
    seen, row = seen[known], row[known]
    height, width = depth_median.shape
    x, y = dataset.observations.xy_px[seen].astype(np.int64).T
    x, y = np.clip(x, 0, width - 1), np.clip(y, 0, height - 1)
    away = dataset.points.xyz_world[row] - dataset.views[index].origin_world
    distance = np.linalg.norm(away, axis=1)
    around = uniform_filter(squared_error, AROUND_PX, mode="nearest")
    return PointDepths(depth_median[y, x] / np.maximum(distance, 1e-12) - 1, around[y, x])


def group_errors(parts: list[Support]) -> dict[str, dict[str, float]]:
    """Return the shares of the pixels and of the squared error, and the PSNR, of each group by its name."""
    counts = np.concatenate([part.counts for part in parts])
    errors = np.concatenate([part.errors for part in parts])
    group = np.searchsorted(COUNT_EDGES, counts, side="right") - 1
    found = {}
    for number, name in enumerate(("nothing met", *GROUP_NAMES), start=-1):
        chosen = errors[group == number]
        if len(chosen):
            found[name] = {
                "pixels": len(chosen) / len(errors),
                "error": float(chosen.sum() / max(errors.sum(), 1e-30)),
                "psnr": psnr_of(float(chosen.mean())),
            }
    return found


def gain_if_covered(groups: dict[str, dict[str, float]]) -> float | None:
    """Return by how many dB the error would fall, were places that few views see as good as the others.

    Pixels that meet nothing stay as they are.

    Args:
        groups: of :func:`group_errors`.

    Returns:
        None where all places are alike.
    """
    mean = {name: 10 ** (-group["psnr"] / 10) for name, group in groups.items()}
    few = [name for name in GROUP_NAMES[:FEW_VIEWS] if name in groups]
    others = [name for name in GROUP_NAMES[FEW_VIEWS:] if name in groups]
    if not few or not others:
        return None
    share = sum(groups[name]["pixels"] for name in others)
    good = sum(groups[name]["pixels"] * mean[name] for name in others) / share
    before = sum(groups[name]["pixels"] * mean[name] for name in groups)
    after = before - sum(groups[name]["pixels"] * (mean[name] - good) for name in few)
    return float(10 * np.log10(before / after))


def psnr_of(squared_error: float) -> float:
    """Return the PSNR in dB of a mean squared error of display values."""
    return float(-10 * np.log10(max(squared_error, 1e-12)))

"""Patches of pixels, and how well they match other photographs at a depth."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from octasplat.engine.dataset import Dataset
from octasplat.engine.train.kernels.patch_costs import patch_differences

STEP_PX = 2
OFFSETS_PX = STEP_PX * np.array([[x, y] for x in (0, 1, -1) for y in (0, 1, -1)], np.int64)
LEVEL_WEIGHT = 0.3
"""Weight of a difference in brightness against one in texture."""
POINTS_PER_BLOCK = 1 << 15
"""Points of patches at depths that are projected at a time."""


@dataclass(frozen=True)
class ExposedPhotographs:
    """The photographs at equal exposure, by a gain for each view."""

    dataset: Dataset
    gains: Float32[np.ndarray, " v"] | None

    def pixels(
        self, view: Int64[np.ndarray, " r"], y: Int64[np.ndarray, " r"], x: Int64[np.ndarray, " r"]
    ) -> tuple[Float32[np.ndarray, "r 3"], Float32[np.ndarray, " r"], Float32[np.ndarray, " r"]]:
        """Return straight display color, alpha and weight of pixels."""
        rgb, alpha, weight = self.dataset.pixels(view, y, x)
        if self.gains is not None:
            rgb = np.clip(rgb * self.gains[view][:, None], 0, 1)
        return rgb, alpha, weight


@dataclass(frozen=True)
class PixelPatches:
    """``n`` pixels of one view, each with ``o`` pixels around it, itself first.

    Attributes:
        origin_world: the view's camera.
        directions_world: unit vectors through the pixels.
        depth_factors: distance along each ray of a point at depth 1 along the camera's axis.
        rgb_srgb: colors of the pixels.
        y: rows of the pixels in the middle.
        x: columns of the pixels in the middle.
    """

    origin_world: Float64[np.ndarray, "3"]
    directions_world: Float64[np.ndarray, "n o 3"]
    depth_factors: Float64[np.ndarray, "n o"]
    rgb_srgb: Float32[np.ndarray, "n o 3"]
    y: Int64[np.ndarray, " n"]
    x: Int64[np.ndarray, " n"]

    def __getitem__(self, ids: Int64[np.ndarray, " k"]) -> "PixelPatches":
        origin, *rows = vars(self).values()
        return PixelPatches(origin, *(row[ids] for row in rows))


def draw_patches(
    photographs: ExposedPhotographs, index: int, samples: int, rng: np.random.Generator
) -> PixelPatches:
    """Draw random pixels that count, away from the border, with those around them."""
    dataset = photographs.dataset
    view = dataset.views[index]
    y = rng.integers(STEP_PX, max(STEP_PX + 1, view.height_px - STEP_PX), samples)
    x = rng.integers(STEP_PX, max(STEP_PX + 1, view.width_px - STEP_PX), samples)
    all_y = np.clip(y[:, None] + OFFSETS_PX[:, 1], 0, view.height_px - 1)
    all_x = np.clip(x[:, None] + OFFSETS_PX[:, 0], 0, view.width_px - 1)
    view_ids = np.full(all_y.size, index)
    rays = dataset.rays(view_ids, all_y.reshape(-1), all_x.reshape(-1))
    origins, directions = rays.origins_world, rays.directions_world
    rgb, alpha, weight = photographs.pixels(view_ids, all_y.reshape(-1), all_x.reshape(-1))
    # a patch across the edge of a mask would match that edge
    is_valid = ((weight > 0) & (alpha > 0.5)).reshape(all_y.shape).all(axis=1)
    directions = directions.astype(np.float64).reshape(*all_y.shape, 3)
    # Distance along a ray of a point at depth 1 along the camera's axis.
    factors = 1.0 / np.maximum(directions @ view.rotation_cam_from_world[2], 1e-3)
    return PixelPatches(
        origin_world=origins[0].astype(np.float64),
        directions_world=directions[is_valid],
        depth_factors=factors[is_valid],
        rgb_srgb=rgb.reshape(*all_y.shape, 3)[is_valid],
        y=y[is_valid],
        x=x[is_valid],
    )


def patch_costs(
    photographs: ExposedPhotographs,
    patches: PixelPatches,
    depths: Float64[np.ndarray, "n g"],
    neighbours: list[int],
) -> Float64[np.ndarray, "n g"]:
    """Return how much each patch, moved to each of its depths, differs from what neighbouring views show."""
    costs = np.empty(depths.shape)
    # many patches at a time, as calls take time, and few enough for the cache
    step = max(1, POINTS_PER_BLOCK // max(1, depths.shape[1] * len(OFFSETS_PX)))
    for first in range(0, len(depths), step):
        block = np.arange(first, min(first + step, len(depths)))
        costs[block] = _block_costs(photographs, patches[block], depths[block], neighbours)
    return costs


def _block_costs(
    photographs: ExposedPhotographs,
    patches: PixelPatches,
    depths: Float64[np.ndarray, "n g"],
    neighbours: list[int],
) -> Float64[np.ndarray, "n g"]:
    dataset = photographs.dataset
    distances = depths[:, :, None] * patches.depth_factors[:, None]
    points = patches.origin_world + distances[..., None] * patches.directions_world[:, None]
    count, guesses, offsets = distances.shape
    # infinite where the other view does not show the whole patch
    costs = np.full((len(neighbours), count * guesses), np.inf)
    for k, other in enumerate(neighbours):
        image_px, depth = project(dataset, other, points.reshape(-1, 3))
        is_visible = (is_inside(dataset, other, image_px) & (depth > 0)).reshape(-1, offsets)
        inside = np.flatnonzero(is_visible.all(axis=1))
        if not len(inside):
            continue
        chosen = np.floor(image_px.reshape(-1, offsets, 2)[inside]).astype(np.int64).reshape(-1, 2)
        rgb, _, _ = photographs.pixels(np.full(len(chosen), other), chosen[:, 1], chosen[:, 0])
        differences = np.empty(len(inside))
        rows = inside // guesses
        patch_differences(patches.rgb_srgb, rgb.reshape(-1, offsets, 3), rows, LEVEL_WEIGHT, differences)
        costs[k, inside] = differences
    costs.sort(axis=0)  # the better half counts: in the others the patch may be hidden
    used = costs[: max(1, (len(neighbours) + 1) // 2)]
    return np.asarray(used.mean(axis=0)).reshape(count, guesses)


def project(
    dataset: Dataset, index: int, points: Float64[np.ndarray, "n 3"]
) -> tuple[Float64[np.ndarray, "n 2"], Float64[np.ndarray, " n"]]:
    """Return image points, pixels, and depths along the axis of one view."""
    view = dataset.views[index]
    points_cam = points @ view.rotation_cam_from_world.T + view.translation_cam_from_world
    return dataset.cameras[view.camera_index].project(points_cam), points_cam[:, 2]


def is_inside(dataset: Dataset, index: int, image_px: Float64[np.ndarray, "n 2"]) -> Bool[np.ndarray, " n"]:
    """Return whether image points lie in a view."""
    view = dataset.views[index]
    x, y = image_px[:, 0], image_px[:, 1]  # what is not-a-number lies nowhere
    with np.errstate(invalid="ignore"):
        return np.asarray((x >= 0) & (y >= 0) & (x < view.width_px) & (y < view.height_px))

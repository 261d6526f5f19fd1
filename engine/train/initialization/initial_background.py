"""What a learnt background begins with: what photographs show in each direction where nothing is near.

A direction is the same piece of sky in every photograph that looks there, from wherever it was taken. Where
no sparse points project around, the median of what the photographs show is taken for what is far away;
elsewhere the median of all, so that gaps in the scene are about as bright as what is beside them.
"""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64
from scipy.ndimage import distance_transform_edt, gaussian_filter
from scipy.spatial import cKDTree

from octasplat.engine.dataset import Camera
from octasplat.engine.dataset.model import SparsePoints
from octasplat.engine.dataset.view_frusta import cam_from_world, is_in_image
from octasplat.engine.shading.background import LearnedBackground
from octasplat.engine.train.sampling.pixel_sampler import TrainingData

ROWS = 64
"""Of the first map; finer ones are interpolated."""
MIN_EMPTY_FRACTION = 0.05
"""A pixel farther than this share of the picture's longer side from all points is one of nothing near."""
MIN_VIEWS = 2
"""So many photographs must show nothing near in a direction."""
MAX_POINTS = 50_000
"""Of more points, evenly spaced ones are looked at."""
MAX_VIEWS = 96
"""Of more photographs, evenly spaced ones are looked at."""
BLUR_TEXELS = (2.0, 6.0)
"""How softly what no photograph shows goes on from what is known, down and across."""


@runtime_checkable
class MappedPhotographs(TrainingData, Protocol):
    """Photographs with their sparse model (see :class:`octasplat.engine.dataset.Dataset`)."""

    cameras: tuple[Camera, ...]
    points: SparsePoints


@dataclass(frozen=True, eq=False)
class InitialBackground:
    """A map to begin from.

    Attributes:
        map: of ``ROWS`` rows.
        up_world: about which way is up, of any length.
    """

    map: LearnedBackground
    up_world: Float64[np.ndarray, "3"]

    def is_above_horizon(self, directions_world: Float64[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Return whether directions are above the horizon, where what is far away is."""
        return np.asarray(_axis_products(directions_world, self.up_world) > 0)

    def resize(self, height: int) -> Float32[np.ndarray, "h w 3"]:
        """Return the map with ``height`` rows."""
        directions = _texel_directions(LearnedBackground(height))
        return self.map.lookup(directions.astype(np.float32)).reshape(height, 2 * height, 3)


def estimate_background(dataset: MappedPhotographs) -> InitialBackground:
    """Return the first map of the photographs that are trained on."""
    background = LearnedBackground(ROWS)
    directions = _texel_directions(background)
    train = dataset.train_indices
    chosen = train[np.unique(np.linspace(0, len(train) - 1, MAX_VIEWS).astype(np.int64))]
    step = max(1, -(-len(dataset.points) // MAX_POINTS))
    points = dataset.points.xyz_world[::step].astype(np.float64)
    seen = [_visible_texels(dataset, index, directions, points) for index in chosen.tolist()]
    texel, rgb, empty = (np.concatenate(parts) for parts in zip(*seen, strict=True))
    count = 2 * ROWS * ROWS
    shown, shown_by = _texel_medians(texel, rgb, count)
    far, far_by = _texel_medians(texel[empty], rgb[empty], count)
    # Floors have no points either, close to the camera.
    found = InitialBackground(background, _up_world(dataset))
    is_far = (far_by >= MIN_VIEWS) & found.is_above_horizon(directions)
    known = is_far | (shown_by > 0)
    colors = np.where(is_far[:, None], far, shown).reshape(ROWS, 2 * ROWS, 3)
    background.set_map(_fill_unknown(colors, known.reshape(ROWS, 2 * ROWS)))
    return found


def _texel_directions(background: LearnedBackground) -> Float64[np.ndarray, "t 3"]:
    """Return the middle of each texel as a world direction."""
    height, width = background.rgb_srgb.shape[:2]
    polar = np.pi * (np.arange(height)[:, None] + 0.5) / height
    azimuth = 2 * np.pi * ((np.arange(width) + 0.5) / width - 0.5)
    # 0 * azimuth gives it the shape of the grid
    parts = np.sin(polar) * np.sin(azimuth), np.cos(polar) + 0 * azimuth, np.sin(polar) * np.cos(azimuth)
    return np.asarray(
        sum(part.reshape(-1, 1) * axis for part, axis in zip(parts, background.frame, strict=True))
    )


def _up_world(dataset: MappedPhotographs) -> Float64[np.ndarray, "3"]:
    """Return roughly which way is up: the mean of the views' upper edges."""
    return -np.mean([dataset.views[i].rotation_cam_from_world[1] for i in dataset.train_indices], axis=0)


def _axis_products(
    directions: Float64[np.ndarray, "n 3"], axis: Float64[np.ndarray, "3"]
) -> Float64[np.ndarray, " n"]:
    """Return products with an axis, added up column by column: the same bits on any number of threads."""
    return np.asarray(sum(directions[:, k] * axis[k] for k in range(3)))


def _visible_texels(
    dataset: MappedPhotographs,
    index: int,
    directions: Float64[np.ndarray, "t 3"],
    points: Float64[np.ndarray, "n 3"],
) -> tuple[Int64[np.ndarray, " k"], Float32[np.ndarray, "k 3"], Bool[np.ndarray, " k"]]:
    """Return the texels that a view shows, their colors there, and whether nothing near is beside."""
    view = dataset.views[index]
    camera = dataset.cameras[view.camera_index]
    in_cam = np.stack([_axis_products(directions, axis) for axis in view.rotation_cam_from_world], axis=1)
    texel = np.flatnonzero(is_in_image(in_cam, camera))
    pixels_px = camera.project(in_cam[texel]).reshape(-1, 2)
    x = np.clip(pixels_px[:, 0].astype(np.int64), 0, view.width_px - 1)
    y = np.clip(pixels_px[:, 1].astype(np.int64), 0, view.height_px - 1)
    rgb, _, weight = dataset.pixels(np.full(len(texel), index), y, x)
    points_cam = cam_from_world(points, view)
    points_px = camera.project(points_cam[is_in_image(points_cam, camera)]).reshape(-1, 2)
    empty = np.ones(len(texel), np.bool_)
    if len(points_px):
        reach = MIN_EMPTY_FRACTION * max(view.width_px, view.height_px)
        empty = cKDTree(points_px).query(pixels_px, distance_upper_bound=reach)[0] > reach
    valid = weight > 0
    return texel[valid], rgb[valid], empty[valid]


def _texel_medians(
    texel: Int64[np.ndarray, " k"], rgb: Float32[np.ndarray, "k 3"], count: int
) -> tuple[Float32[np.ndarray, "t 3"], Int64[np.ndarray, " t"]]:
    """Return the lower median of each channel of each texel's colors, and how many there are."""
    found = np.bincount(texel, minlength=count)
    medians = np.zeros((count, 3), np.float32)
    # first of the texel, plus the lower middle of its count
    middle = np.cumsum(found) - found + np.maximum(found - 1, 0) // 2
    for channel in range(3):
        values = rgb[np.lexsort((rgb[:, channel], texel)), channel]
        medians[found > 0, channel] = values[middle[found > 0]]
    return medians, found


def _fill_unknown(
    colors: Float32[np.ndarray, "h w 3"], known: Bool[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w 3"]:
    """Return the map with unknown texels blurred from the nearest known ones; its sides meet."""
    if not known.any():
        return np.full_like(colors, 0.5)
    width = colors.shape[1]
    around = np.tile(known, (1, 3))  # three maps side by side, so that distances go around
    row, column = distance_transform_edt(~around, return_distances=False, return_indices=True)
    nearest = colors[row, column % width][:, width : 2 * width]
    soft = gaussian_filter(nearest, (*BLUR_TEXELS, 0), mode=("nearest", "wrap", "nearest"))
    return np.where(known[..., None], nearest, soft)

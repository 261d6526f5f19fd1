"""Blocks planned from the sparse points alone, in seconds and before anything is trained."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from octasplat.engine.blocks.partition import Box, cut_into_boxes, weighted_spread
from octasplat.engine.blocks.piece_settings import MARGIN
from octasplat.engine.core.errors import ConfigError
from octasplat.engine.dataset.model import DatasetModel
from octasplat.engine.dataset.view_tiles import ViewTiles


@dataclass(frozen=True, eq=False)
class SparseBlock:
    """A block as the sparse points suggest it.

    Attributes:
        core: its box.
        share: of what is seen, in the core and its margin.
        view_count: training views that show some of it.
        pixel_count: pixels of them in tiles that show some of it.
        drawn_pixel_count: the same, those of each tile counted by how much of it shows the block.
    """

    core: Box
    share: float
    view_count: int
    pixel_count: int
    drawn_pixel_count: int


def plan_from_points(
    model: DatasetModel, train_indices: Int64[np.ndarray, " t"], count: int, margin: float = MARGIN
) -> tuple[SparseBlock, ...]:
    """Cut the sparse points of a scene into blocks that about as many observations fall to.

    Args:
        model: views, points and observations.
        train_indices: views to train on.
        count: number of blocks.
        margin: around each core, of the distance over which what is seen of it spreads.

    Raises:
        ConfigError: there are too few points that were observed.
    """
    rows, is_there = model.points.rows_of(model.observations.point)
    counted = np.isin(model.observations.view, train_indices) & is_there
    rows, view = rows[counted], model.observations.view[counted]
    xy_px = model.observations.xy_px[counted]
    if len(model.points) == 0 or len(rows) == 0:
        raise ConfigError(
            f"The model in {model.model_folder} has no points that photographs show, by which blocks are "
            "planned; reconstruct cuts by its coarse scene."
        )
    # Sorted once, so that the observations of a view are one slice.
    order = np.argsort(view, kind="stable")
    rows, xy_px = rows[order], xy_px[order]
    starts = np.searchsorted(view[order], np.arange(len(model.views) + 1))
    slices = [(index, slice(starts[index], starts[index + 1])) for index in train_indices.tolist()]
    points = model.points.xyz_world.astype(np.float64)
    weights = np.bincount(rows, minlength=len(points)).astype(np.float64)
    found = []
    for box in cut_into_boxes(points, weights, count):
        inside = box.contains(points) & (weights > 0)
        margin_world = margin * weighted_spread(points[inside], weights[inside])
        member = box.grown(margin_world).contains(points)
        pixels = [_pixels_of_view(model, index, xy_px[of], member[rows[of]]) for index, of in slices]
        shown, drawn = np.array(pixels).sum(axis=0)
        view_count = int(np.count_nonzero([shown_px for shown_px, _ in pixels]))
        share = float(weights[member].sum() / weights.sum())
        found.append(SparseBlock(box, share, view_count, round(shown), round(drawn)))
    return tuple(found)


def _pixels_of_view(
    model: DatasetModel, index: int, xy_px: Float64[np.ndarray, "k 2"], member: Bool[np.ndarray, " k"]
) -> tuple[float, float]:
    """Return the pixels of a view in tiles that show members, and these by how much of a tile's points are.

    Tiles without any point count in proportion.
    """
    view = model.views[index]
    tiles = ViewTiles.of_view(index, view.width_px, view.height_px)
    down, across = tiles.shape
    row = np.clip(np.searchsorted(tiles.rows_px, xy_px[:, 1], side="right") - 1, 0, down - 1)
    column = np.clip(np.searchsorted(tiles.columns_px, xy_px[:, 0], side="right") - 1, 0, across - 1)
    place = row * across + column
    counts = np.bincount(place, minlength=down * across)
    shares = np.bincount(place[member], minlength=down * across) / np.maximum(counts, 1)
    pixels_per_tile = view.width_px * view.height_px / max(int(np.count_nonzero(counts)), 1)
    return pixels_per_tile * int(np.count_nonzero(shares)), pixels_per_tile * float(shares.sum())

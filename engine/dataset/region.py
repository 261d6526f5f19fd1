"""Pixels that train a region of a scene: often those whose rays pass its box, seldom the others."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float32, Int64

from octasplat.engine.core.errors import DatasetError
from octasplat.engine.core.local_origin import Origin
from octasplat.engine.core.rays import RayBatch
from octasplat.engine.dataset.view_tiles import FULL_FREQUENCY, RAYS_ACROSS_TILE, Rectangles, ViewTiles

OUTSIDE_FREQUENCY = 1
"""How often pixels are drawn that do not see the region: what lies around it stays coarse."""

RaysOfPixels = Callable[[Int64[np.ndarray, " r"], Int64[np.ndarray, " r"], Int64[np.ndarray, " r"]], RayBatch]


@dataclass(frozen=True)
class Region:
    """A box of a scene that is to be trained in detail.

    Attributes:
        corners_world: smallest x, y, z and then the largest ones.
        min_tile_px: least side of a tile of pixels, as far as views have it.
    """

    corners_world: tuple[float, float, float, float, float, float]
    min_tile_px: int = 1

    def with_origin(self, origin_world: Origin) -> "Region":
        """Return the same box in coordinates that have their origin there."""
        corners = np.array(self.corners_world) - np.tile(np.array(origin_world), 2)
        x0, y0, z0, x1, y1, z1 = corners.tolist()
        return replace(self, corners_world=(x0, y0, z0, x1, y1, z1))

    def contains(self, points_world: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Return which points lie in the box, its faces included."""
        low, high = np.array(self.corners_world).reshape(2, 3)
        return np.asarray(((points_world >= low) & (points_world <= high)).all(axis=1))

    def preference(self, points_world: Float[np.ndarray, "n 3"]) -> Float32[np.ndarray, " n"]:
        """Return by how much points are preferred: 1 in the box, elsewhere as seldom as pixels are drawn."""
        outside = np.float32(OUTSIDE_FREQUENCY / FULL_FREQUENCY)
        return np.where(self.contains(points_world), np.float32(1), outside)


def region_pixels(
    sizes_px: Int64[np.ndarray, "v 2"],
    train_indices: Int64[np.ndarray, " t"],
    rays_of_pixels: RaysOfPixels,
    region: Region,
) -> Rectangles:
    """Return all pixels of the views, those in tiles that see the region drawn at full frequency.

    A tile sees the region if one of its rays, as thick as the space between them, passes the box; what
    stands before it is not asked for. Views that are not trained on are drawn evenly.

    Args:
        sizes_px: width and height of every view.
        train_indices: views to train on.
        rays_of_pixels: gives the rays of pixels (view, y, x).
        region: the box, in the coordinates of the rays.

    Raises:
        DatasetError: no training view sees the region.
    """
    corners = np.array(region.corners_world, np.float64).reshape(2, 3)
    found: list[Rectangles] = []
    seeing_views = 0
    is_trained = np.isin(np.arange(len(sizes_px)), train_indices)
    for view, (width, height) in enumerate(sizes_px.tolist()):
        tiles = ViewTiles.of_view(view, width, height, region.min_tile_px)
        frequency = np.full(tiles.shape, FULL_FREQUENCY, np.int64)
        if is_trained[view]:
            is_seeing = _tiles_that_see(tiles, rays_of_pixels(*tiles.pixels()), corners)
            seeing_views += bool(is_seeing.any())
            frequency[~is_seeing] = OUTSIDE_FREQUENCY
        found.append(tiles.rectangles(frequency))
    if seeing_views == 0:
        raise DatasetError(
            "No training photograph sees the region. It is given in the coordinates of the COLMAP model; "
            "octasplat view of a run shows where things lie."
        )
    return Rectangles.joined(found)


def _tiles_that_see(
    tiles: ViewTiles, rays: RayBatch, corners_world: Float[np.ndarray, "2 3"]
) -> Bool[np.ndarray, "a b"]:
    down, across = tiles.shape
    shape = (down * RAYS_ACROSS_TILE, across * RAYS_ACROSS_TILE, 3)
    directions = rays.directions_world.astype(np.float64)
    gaps = np.linalg.norm(np.diff(directions.reshape(shape), axis=1), axis=2)
    is_passing = passes_box(
        rays.origins_world.astype(np.float64), directions, corners_world,
        half_angle_rad=float(np.median(gaps)) / np.sqrt(2),
    )  # fmt: skip
    grouped = is_passing.reshape(down, RAYS_ACROSS_TILE, across, RAYS_ACROSS_TILE)
    return np.asarray(grouped.any(axis=(1, 3)))


def passes_box(
    origins_world: Float[np.ndarray, "r 3"],
    directions_world: Float[np.ndarray, "r 3"],
    corners_world: Float[np.ndarray, "2 3"],
    *,
    half_angle_rad: float = 0.0,
) -> Bool[np.ndarray, " r"]:
    """Return which rays, cones of a half angle, pass a box along the axes; those that begin in it do.

    The box is enlarged by the radius of the cone beside its centre (slab test; Ericson, "Real-Time Collision
    Detection", section 5.3.3).

    Example:
        >>> ahead, aside = np.array([[0.0, 0, 1]]), np.array([[0.0, 1, 0]])
        >>> box = np.array([[-1.0, -1, 4], [1, 1, 5]])
        >>> passes_box(np.zeros((2, 3)), np.concatenate([ahead, aside]), box).tolist()
        [True, False]
    """
    along = ((corners_world.mean(axis=0) - origins_world) * directions_world).sum(axis=1)
    radius = half_angle_rad * np.maximum(along, 0.0)[:, None]
    low, high = corners_world[0] - radius, corners_world[1] + radius
    with np.errstate(divide="ignore", invalid="ignore"):
        at = np.stack([(low - origins_world) / directions_world, (high - origins_world) / directions_world])
    # a ray along a face gives 0 / 0, which says nothing of that axis
    first = np.fmax.reduce(np.fmin(at[0], at[1]), axis=1)
    last = np.fmin.reduce(np.fmax(at[0], at[1]), axis=1)
    result: np.ndarray = (first <= last) & (last >= 0)
    return result

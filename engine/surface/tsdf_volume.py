"""A sparse volume of signed distances: blocks of 8^3 voxels along the surface, 8 bytes a voxel."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int32

from octasplat.engine.core.compilation import run_ranges
from octasplat.engine.core.errors import ConfigError
from octasplat.engine.core.threads import threads_in_use
from octasplat.engine.surface.depth_maps import DepthMaps, Progress
from octasplat.engine.surface.kernels.tsdf import (
    NO_BLOCK,
    TILE,
    VOXELS_PER_BLOCK,
    DepthMap,
    DepthView,
    VoxelGrid,
    fuse_view,
    mark_blocks,
    tile_ranges,
)
from octasplat.engine.surface.options import ExtractionOptions
from octasplat.engine.surface.region import NO_SURFACE_MESSAGE, Region

ROWS_PER_THREAD, BLOCKS_PER_THREAD = 16, 16
"""Rows of a depth map, and blocks of voxels, that are worth a thread."""
BYTES_PER_BLOCK = VOXELS_PER_BLOCK * (4 + 4 + 4 + 1)
"""Distance and weight, and what marching cubes adds: the first vertex of each voxel and its crossed edges."""


@dataclass(frozen=True)
class TsdfVolume:
    """Signed distances, fused from all depth maps, in units of the truncation.

    Attributes:
        region: the grid.
        table: for every block of the grid, its row in the arrays below, or -1.
        blocks: place of each block in the grid.
        values: mean signed distance of each voxel, in [-1, 1], positive in front of the surface.
        weights: summed weights; 0 where no view says anything.
    """

    region: Region
    table: Int32[np.ndarray, "bx by bz"]
    blocks: Int32[np.ndarray, "b 3"]
    values: Float32[np.ndarray, "b 512"]
    weights: Float32[np.ndarray, "b 512"]


def fuse_depth_maps(
    maps: DepthMaps,
    region: Region,
    options: ExtractionOptions,
    progress: Progress = lambda _done, _total: None,
) -> TsdfVolume:
    """Fuse depth maps into a volume (Curless and Levoy 1996).

    First the blocks that any depth map comes near to are found, then every map goes into all of them, so
    that what one view takes for a surface is cleared by those that see through it, in whatever order they
    come.

    Args:
        maps: the depth maps.
        region: where.
        options: the limit of memory.
        progress: called with (steps done, total), two steps a map.

    Raises:
        ConfigError: no depth lies in the region, or the volume takes too much memory.
    """
    total = 2 * len(maps.cameras)
    marks = np.zeros(region.blocks, np.uint8)
    grid = VoxelGrid(
        low=region.low,
        voxel=region.voxel,
        contracted=region.contracted,
        middle=region.centre_world,
        radius=region.radius,
        truncation=region.truncation,
    )
    threads = threads_in_use()
    progress(0, total)
    for number, (view, distances) in enumerate(zip(_depth_views(maps), maps.distances, strict=True)):
        run_ranges(
            mark_blocks,
            threads,
            len(distances),
            np.asarray(distances),
            view,
            grid,
            marks,
            grain=ROWS_PER_THREAD,
        )
        progress(number + 1, total)
    blocks = np.argwhere(marks).astype(np.int32)
    _check_size(len(blocks), options)  # before the memory is taken
    table = np.full(region.blocks, NO_BLOCK, np.int32)
    table[tuple(blocks.T)] = np.arange(len(blocks), dtype=np.int32)
    values = np.zeros((len(blocks), VOXELS_PER_BLOCK), np.float32)
    weights = np.zeros((len(blocks), VOXELS_PER_BLOCK), np.float32)
    for number, (view, distances, cosines) in enumerate(
        zip(_depth_views(maps), maps.distances, maps.cosines, strict=True)
    ):
        tiles = (-(-distances.shape[0] // TILE), -(-distances.shape[1] // TILE))
        nearest, farthest = np.empty(tiles, np.float32), np.empty(tiles, np.float32)
        tile_ranges(np.asarray(distances), nearest, farthest)
        depths = DepthMap(np.asarray(distances), np.asarray(cosines), nearest, farthest)
        run_ranges(
            fuse_view, threads, len(blocks), depths, view, grid, blocks, values, weights,
            grain=BLOCKS_PER_THREAD,
        )  # fmt: skip
        progress(len(maps.cameras) + number + 1, total)
    return TsdfVolume(region, table, blocks, values, weights)


def fill_unseen(volume: TsdfVolume, min_weight: float) -> None:
    """Set voxels of less weight than ``min_weight`` to the inside of the surface, in place."""
    unseen = volume.weights < min_weight
    volume.values[unseen] = -1.0  # inside: the surface closes where nobody has looked
    volume.weights[unseen] = min_weight


def _depth_views(maps: DepthMaps) -> list[DepthView]:
    return [
        DepthView(
            fx=c.fx_px,
            fy=c.fy_px,
            cx=c.cx_px,
            cy=c.cy_px,
            rotation=c.rotation_cam_from_world,
            centre=c.centre_world,
        )
        for c in maps.cameras
    ]


def _check_size(count: int, options: ExtractionOptions) -> None:
    if count == 0:
        raise ConfigError(NO_SURFACE_MESSAGE)
    need_gb = count * BYTES_PER_BLOCK / 1e9
    if need_gb > options.max_memory_gb:
        raise ConfigError(
            f"The volume would take {need_gb:.1f} GB, and {options.max_memory_gb:g} are allowed; choose "
            "larger voxels, a smaller region or more memory."
        )

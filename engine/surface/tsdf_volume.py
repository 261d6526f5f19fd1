"""A sparse volume of signed distances: blocks of 8^3 voxels along the surface, 8 bytes a voxel."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int32

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.surface.depth_maps import DepthMaps, Progress
from octasplat.engine.surface.kernels.tsdf import (
    NO_BLOCK,
    TILE,
    VOXELS_PER_BLOCK,
    fuse_view,
    mark_blocks,
    tile_ranges,
)
from octasplat.engine.surface.options import ExtractionOptions
from octasplat.engine.surface.region import NO_SURFACE_MESSAGE, Region

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
        progress: told (steps done, steps in all), two steps a map.

    Raises:
        ConfigError: no depth lies in the region, or the volume takes too much memory.
    """
    total = 2 * len(maps.cameras)
    marks = np.zeros(region.blocks, np.uint8)
    space = (region.low, region.voxel, region.contracted, region.centre_world, region.radius)
    progress(0, total)
    for number, (lens, distances) in enumerate(zip(_intrinsics(maps), maps.distances, strict=True)):
        mark_blocks(np.asarray(distances), *lens, *space, region.truncation, marks)
        progress(number + 1, total)
    blocks = np.argwhere(marks).astype(np.int32)
    _check_size(len(blocks), options)
    table = np.full(region.blocks, NO_BLOCK, np.int32)
    table[tuple(blocks.T)] = np.arange(len(blocks), dtype=np.int32)
    values = np.zeros((len(blocks), VOXELS_PER_BLOCK), np.float32)
    weights = np.zeros((len(blocks), VOXELS_PER_BLOCK), np.float32)
    for number, (lens, distances, cosines) in enumerate(
        zip(_intrinsics(maps), maps.distances, maps.cosines, strict=True)
    ):
        tiles = (-(-distances.shape[0] // TILE), -(-distances.shape[1] // TILE))
        nearest, farthest = np.empty(tiles, np.float32), np.empty(tiles, np.float32)
        tile_ranges(np.asarray(distances), nearest, farthest)
        fuse_view(
            np.asarray(distances), np.asarray(cosines), nearest, farthest, *lens, *space,
            region.truncation, blocks, values, weights,
        )  # fmt: skip
        progress(len(maps.cameras) + number + 1, total)
    return TsdfVolume(region, table, blocks, values, weights)


def fill_unseen(volume: TsdfVolume, min_weight: float) -> None:
    """Take voxels that collected less than ``min_weight`` for the inside of things, in place."""
    unseen = volume.weights < min_weight
    volume.values[unseen] = -1.0
    volume.weights[unseen] = min_weight


def _intrinsics(maps: DepthMaps) -> list[tuple[float, float, float, float, np.ndarray, np.ndarray]]:
    return [
        (c.fx_px, c.fy_px, c.cx_px, c.cy_px, c.rotation_cam_from_world, c.centre_world) for c in maps.cameras
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

"""Batches of paths from the camera, and the buffers of the threads that trace them."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int64

from octasplat.engine.core.rays import ImageRays
from octasplat.engine.pathtracing.kernels.path_args import (
    BLOCK_SIZE,
    CameraRays,
    MeshHits,
    PathBlock,
    PathStart,
    allocate_media,
    allocate_paths,
    allocate_shadow_rays,
)

PATHS_PER_THREAD = 1 << 14
"""Least number of paths that a thread follows by itself among meshes alone, but for what is left."""
MOST_TOGETHER, BATCHES_PER_THREAD = 8, 4
"""How many times as many it follows at most, as each call has its price; and how many batches each thread is
left with at least, so that none waits long for the others."""


class Batch(NamedTuple):
    """Paths traced together: ``paths_per_pixel`` for each pixel from ``first_pixel`` of their order on."""

    first_pixel: int
    pixels: Int64[np.ndarray, " n"]
    paths_per_pixel: int
    first_sample: int


@dataclass(frozen=True)
class ImageBatches:
    """The paths of an image, batch by batch.

    Attributes:
        camera_rays: rays through the centres of the pixels.
        order: of the pixels.
        t_min: the camera sees nothing nearer.
        batches: in the order in which they are traced.
    """

    camera_rays: CameraRays
    order: Int64[np.ndarray, " n"]
    t_min: Float32[np.ndarray, "1"]
    batches: list[Batch]

    def start(self, batch: Batch) -> PathStart:
        """Return the kernels' description of the paths to start."""
        return PathStart(
            self.camera_rays, self.order, batch.first_pixel, batch.paths_per_pixel, batch.first_sample
        )


def pixels_per_batch(count: int, paths_per_pixel: int, threads: int) -> int:
    """Return how many of ``count`` pixels are traced in a batch among meshes alone.

    A batch is cut at the same blocks of paths for any number of threads.
    """
    least = PATHS_PER_THREAD // BLOCK_SIZE * (BLOCK_SIZE // paths_per_pixel)
    return least * min(max(count // (least * threads * BATCHES_PER_THREAD), 1), MOST_TOGETHER)


def allocate_path_block() -> PathBlock:
    """Return memory for a block of paths of one thread."""
    hits = MeshHits(
        np.empty(BLOCK_SIZE, np.float32), np.empty(BLOCK_SIZE, np.int32),
        np.empty((BLOCK_SIZE, 2), np.float32), allocate_media(BLOCK_SIZE),
    )  # fmt: skip
    return PathBlock(
        allocate_paths(BLOCK_SIZE), np.empty(BLOCK_SIZE, np.int32), hits, allocate_shadow_rays(BLOCK_SIZE),
        np.empty((BLOCK_SIZE, 3), np.float32),
    )  # fmt: skip


def optical_axis(image: ImageRays) -> Float64[np.ndarray, "3"]:
    """Return the axis of an image's camera; where that is not known the direction through its centre."""
    if image.axis_world is not None:
        return image.axis_world / np.linalg.norm(image.axis_world)
    directions_world = image.directions_world
    height, width = directions_world.shape[:2]
    # the middle pixel, or the two or four around it
    middle = directions_world[(height - 1) // 2 : height // 2 + 1, (width - 1) // 2 : width // 2 + 1]
    axis = middle.reshape(-1, 3).mean(axis=0, dtype=np.float64)
    return np.asarray(axis / np.linalg.norm(axis))

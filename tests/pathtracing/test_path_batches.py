"""Batches of pixels that a thread traces among meshes alone."""

import pytest

from octasplat.engine.pathtracing.kernels.path_args import BLOCK_SIZE
from octasplat.engine.pathtracing.path_batches import (
    BATCHES_PER_THREAD,
    MOST_TOGETHER,
    PATHS_PER_THREAD,
    pixels_per_batch,
)


@pytest.mark.parametrize("each", [1, 3, 16, 256])
@pytest.mark.parametrize("threads", [1, 2, 7, 64])
def test_batches_are_cut_at_the_same_blocks_for_any_number_of_threads(each: int, threads: int) -> None:
    for count in (1, 5_000, 130_000, 2_000_000):
        pixels = pixels_per_batch(count, each, threads)
        assert pixels % (BLOCK_SIZE // each) == 0
        assert pixels * each <= MOST_TOGETHER * PATHS_PER_THREAD


def test_no_thread_is_left_without_work() -> None:
    least = pixels_per_batch(1, 16, 1)
    assert least * 16 == PATHS_PER_THREAD
    for threads in (1, 2, 8):
        pixels = pixels_per_batch(480 * 270, 16, threads)
        assert pixels == least or 480 * 270 // pixels >= threads * BATCHES_PER_THREAD
    assert pixels_per_batch(480 * 270, 16, 1) > least

"""The numbers of the path tracer: Sobol's, spread evenly for every pixel."""

import numba
import numpy as np
from scipy.stats import qmc

from octasplat.engine.pathtracing.kernels.sampler import (
    fill_pairs,
    fill_uniform,
    pixel_key,
    reverse_bits,
    sobol_reversed_bits,
)


@numba.njit
def digits(index):
    first, second = sobol_reversed_bits(index)
    return reverse_bits(first), reverse_bits(second)


@numba.njit
def keys_of(seed, pixels):
    return np.array([pixel_key(seed, pixel) for pixel in pixels], np.uint32)


@numba.njit
def fill_eight_at_a_time(keys, samples, count, first, out):
    fill_pairs(keys, samples, count, first, out)


def numbers(pixel: int, samples: int, pair: int = 0, seed: int = 1) -> np.ndarray:
    out = np.empty((samples, 2))
    fill_uniform(seed, np.full(samples, pixel), np.arange(samples), pair, out)
    return out


def test_sequence_equals_sobol() -> None:
    known = qmc.Sobol(2, scramble=False).random(256)
    ours = np.array([digits(np.uint32(k)) for k in range(256)]) / 2.0**32
    # The reference walks in Gray-code order; blocks of 2^k hold the same points.
    for block in (16, 256):
        assert {tuple(p) for p in ours[:block]} == {tuple(p) for p in known[:block]}


def test_sample_blocks_are_digital_nets() -> None:
    for pixel in range(8):
        for pair in (0, 3):
            some = numbers(pixel, 64, pair)
            for first in range(0, 64, 16):
                part = some[first : first + 16]
                for across in (1, 2, 4, 8, 16):
                    cells = (part * [across, 16 // across]).astype(int)
                    assert len({tuple(cell) for cell in cells}) == 16


def test_pixels_pairs_and_seeds_are_unlike() -> None:
    some = np.concatenate(
        [numbers(p, 1, pair, seed) for p in range(40) for pair in range(5) for seed in (0, 1)]
    )
    assert len(np.unique(some[:, 0])) == len(some)
    assert abs(np.corrcoef(some.T)[0, 1]) < 0.15 and abs(some.mean() - 0.5) < 0.05
    assert (some >= 0).all() and (some < 1).all()


def test_eight_paths_at_a_time_have_the_numbers_of_each() -> None:
    pixels, samples = np.arange(19) * 7919, np.arange(19) * 3449
    out = np.empty((3, 2, 24))
    room = np.zeros(24, np.uint32)
    room[:19] = keys_of(5, pixels)
    fill_eight_at_a_time(room, np.concatenate([samples, np.zeros(5)]).astype(np.int32), 19, 2, out)
    for pair in range(3):
        alone = np.empty((19, 2))
        fill_uniform(5, pixels, samples, 2 + pair, alone)
        np.testing.assert_array_equal(out[pair, :, :19].T, alone)

"""The numbers of the path tracer: Sobol's, spread evenly for every pixel."""

import numba
import numpy as np
from scipy.stats import qmc

from octasplat.engine.pathtracing.kernels.sampler import fill_uniform, reverse_bits, sobol_reversed_bits


@numba.njit
def digits(index):
    first, second = sobol_reversed_bits(index)
    return reverse_bits(first), reverse_bits(second)


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

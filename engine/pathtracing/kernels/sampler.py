"""Numbers that look random and are a pure function of (seed, pixel, sample, dimension).

Each pair of dimensions is a Sobol sequence over the samples of a pixel, its order and its digits scrambled
by hashes: "Practical Hash-based Owen Scrambling" (Burley 2020, https://jcgt.org/published/0009/04/01/). So a
pixel's samples are spread evenly, no two pixels alike, and the number of threads or the order of the work
cannot matter.
"""

import numpy as np
from jaxtyping import Float64, Int32, Int64, UInt32

from octasplat.engine.core.compilation import kernel
from octasplat.engine.pathtracing.kernels.sampler_vectors import LANES, write_uniform_pairs8
from octasplat.engine.trace.kernels.native import njit_no_refcount

UINT32_TO_UNIT = 2.0**-32
ONE_MINUS_EPSILON = 1.0 - 2.0**-24  # the largest float32 below 1: numbers stay below 1 in either precision


@njit_no_refcount(inline="always")
def hash_uint32(x: np.uint32) -> np.uint32:
    """Return 32 well mixed bits of a uint32."""
    x = np.uint32(x)
    # lowbias32 (C. Wellons, https://nullprogram.com/blog/2018/07/31/)
    x = np.uint32((x ^ (x >> np.uint32(16))) * np.uint32(0x7FEB352D))
    x = np.uint32((x ^ (x >> np.uint32(15))) * np.uint32(0x846CA68B))
    return np.uint32(x ^ (x >> np.uint32(16)))


@njit_no_refcount()
def reverse_bits(x: np.uint32) -> np.uint32:
    """Return the bits of a uint32 in the opposite order."""
    x = np.uint32(x)
    x = np.uint32((x << np.uint32(16)) | (x >> np.uint32(16)))
    x = np.uint32(
        ((x & np.uint32(0x00FF00FF)) << np.uint32(8)) | ((x & np.uint32(0xFF00FF00)) >> np.uint32(8))
    )
    x = np.uint32(
        ((x & np.uint32(0x0F0F0F0F)) << np.uint32(4)) | ((x & np.uint32(0xF0F0F0F0)) >> np.uint32(4))
    )
    x = np.uint32(
        ((x & np.uint32(0x33333333)) << np.uint32(2)) | ((x & np.uint32(0xCCCCCCCC)) >> np.uint32(2))
    )
    return np.uint32(
        ((x & np.uint32(0x55555555)) << np.uint32(1)) | ((x & np.uint32(0xAAAAAAAA)) >> np.uint32(1))
    )


@njit_no_refcount()
def _laine_karras_permutation(x: np.uint32, seed: np.uint32) -> np.uint32:
    """Permute bits: each is changed by a hash of the bits below it (Laine and Karras)."""
    x = np.uint32(x + seed)
    # even multipliers: a product changes only bits above those it comes from
    x = np.uint32(x ^ np.uint32(x * np.uint32(0x6C50B47C)))
    x = np.uint32(x ^ np.uint32(x * np.uint32(0xB82F1E52)))
    x = np.uint32(x ^ np.uint32(x * np.uint32(0xC7AFE638)))
    return np.uint32(x ^ np.uint32(x * np.uint32(0x8D22F6E6)))


@njit_no_refcount()
def sobol_reversed_bits(index: np.uint32) -> tuple[np.uint32, np.uint32]:
    """Return two dimensions of Sobol's sequence as 32 binary digits behind the point, the last one first.

    So they are what is to be scrambled next. The first is the index itself, the second Pascal's triangle
    modulo 2 on it, as a product of sparse matrices; the index is below 65,536.
    """
    second = np.uint32(index ^ ((index & np.uint32(0xFF00FF00)) >> np.uint32(8)))
    second = np.uint32(second ^ ((second & np.uint32(0xF0F0F0F0)) >> np.uint32(4)))
    second = np.uint32(second ^ ((second & np.uint32(0xCCCCCCCC)) >> np.uint32(2)))
    second = np.uint32(second ^ ((second & np.uint32(0xAAAAAAAA)) >> np.uint32(1)))
    return index, second


@njit_no_refcount()
def pixel_key(seed: int, pixel: int) -> np.uint32:
    """Return what the numbers of a pixel begin from."""
    # 2^32 over the golden ratio: neighbors get unlike keys
    return hash_uint32(np.uint32(hash_uint32(np.uint32(seed)) + np.uint32(0x9E3779B9) * np.uint32(pixel)))


@njit_no_refcount()
def uniform_pair(key: np.uint32, sample: int, pair: int) -> tuple[float, float]:
    """Return two numbers in [0, 1) for sample ``sample`` (below 65,536) in the dimensions ``pair``."""
    seed = hash_uint32(np.uint32(key + np.uint32(0x85EBCA6B) * np.uint32(pair + 1)))
    # The order is scrambled within its 16 bits, so that the first 2^k samples stay a whole block.
    order = _laine_karras_permutation(reverse_bits(np.uint32(sample) << np.uint32(16)), seed)
    first, second = sobol_reversed_bits(reverse_bits(order) >> np.uint32(16))
    first = reverse_bits(
        _laine_karras_permutation(first, hash_uint32(np.uint32(seed ^ np.uint32(0x68E31DA4))))
    )
    second = reverse_bits(
        _laine_karras_permutation(second, hash_uint32(np.uint32(seed ^ np.uint32(0xB5297A4D))))
    )
    return min(first * UINT32_TO_UNIT, ONE_MINUS_EPSILON), min(second * UINT32_TO_UNIT, ONE_MINUS_EPSILON)


@kernel()
def fill_uniform(
    seed: int,
    pixels: Int64[np.ndarray, " n"],
    samples: Int64[np.ndarray, " n"],
    pair: int,
    out: Float64[np.ndarray, "n 2"],
) -> None:
    """Write the numbers of many (pixel, sample), for tests and for what draws them outside of the kernels."""
    for i in range(len(pixels)):
        out[i, 0], out[i, 1] = uniform_pair(pixel_key(seed, pixels[i]), samples[i], pair)


@njit_no_refcount()
def fill_pairs(
    keys: UInt32[np.ndarray, " p"],
    samples: Int32[np.ndarray, " p"],
    count: int,
    first: int,
    out: Float64[np.ndarray, "d 2 p"],
) -> None:
    """Write :func:`uniform_pair` of ``count`` paths in the pairs of dimensions from ``first`` on.

    Eight paths at a time: the rows have room for a multiple of eight, and hold anything behind ``count``.
    """
    for pair in range(len(out)):
        fill_pair(keys, samples, count, first + pair, out[pair])


@njit_no_refcount()
def fill_pair(
    keys: UInt32[np.ndarray, " p"],
    samples: Int32[np.ndarray, " p"],
    count: int,
    pair: int,
    out: Float64[np.ndarray, "2 p"],
) -> None:
    """Write :func:`uniform_pair` of ``count`` paths in one pair of dimensions; see :func:`fill_pairs`."""
    for k in range(0, count, LANES):
        write_uniform_pairs8(
            keys.ctypes.data + 4 * k, samples.ctypes.data + 4 * k, np.uint32(pair + 1),
            out.ctypes.data + 8 * k, out.ctypes.data + 8 * (out.shape[1] + k),
        )  # fmt: skip

"""Bit spreading for Z-order codes, for arrays and, compiled, for single numbers."""

import numpy as np
from jaxtyping import UInt64


def spread_bits(bits: UInt64[np.ndarray, " n"]) -> UInt64[np.ndarray, " n"]:
    """Put two zero bits between each of the low 21 bits; numba compiles this for single numbers."""
    x = bits
    # Each step moves the upper half of every group of bits up, which halves the groups.
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        x = (x | (x << np.uint64(shift))) & np.uint64(mask)
    return x

"""Pseudorandom numbers by hashing their keys, without a generator's state."""

import numpy as np
from jaxtyping import Float64, UInt64


def hashed_uniforms(*keys: UInt64[np.ndarray, " n"]) -> Float64[np.ndarray, "2 n"]:
    """Return two uniform numbers in [0, 1) for each row of keys.

    >>> hashed_uniforms(np.arange(2, dtype=np.uint64)).round(3)
    array([[0.883, 0.567],
           [0.652, 0.368]])
    """
    state = splitmix64(keys[0])
    for key in keys[1:]:
        state = splitmix64(state + key)
    # The upper 53 bits: as many as a double holds exactly
    return np.stack([(x >> np.uint64(11)) * 2.0**-53 for x in (state, splitmix64(state))])


def splitmix64(x: UInt64[np.ndarray, " n"]) -> UInt64[np.ndarray, " n"]:
    """Apply one step of SplitMix64, "Fast Splittable Pseudorandom Number Generators" (Steele et al. 2014)."""
    x = x + np.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))

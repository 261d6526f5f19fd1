"""The pixels' loss and its gradient in one pass, and the rays' errors."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64

from octasplat.engine.core.compilation import kernel
from octasplat.engine.trace.kernels.native import njit_no_refcount

CHUNKS = 64
"""Parts whose sums are added up one after the other: the same on any number of threads."""


class PixelTerms(NamedTuple):
    """What the loss of the pixels is computed from, and the ``gradient`` that is written.

    ``l1`` and ``l2`` are the factors of the sign and of the difference in the gradient.
    """

    render: Float32[np.ndarray, "r 3"]
    target: Float32[np.ndarray, "r 3"]
    weight: Float32[np.ndarray, " r"]
    l1: np.float32
    l2: np.float32
    gradient: Float32[np.ndarray, "r 3"]


@njit_no_refcount()
def _part(first: int, last: int, terms: PixelTerms, sums: Float64[np.ndarray, "2"]) -> None:
    render, target, weight, l1, l2, gradient = terms
    absolute = squared = 0.0
    for r in range(first, last):
        for channel in range(3):
            difference = render[r, channel] - target[r, channel]
            absolute += abs(difference) * weight[r]
            squared += difference * difference * weight[r]
            # d |d| / d render is the sign, 0 at 0
            slope = l2 * difference
            if difference > np.float32(0.0):
                slope += l1
            elif difference < np.float32(0.0):
                slope -= l1
            gradient[r, channel] = slope * weight[r]
    sums[0], sums[1] = absolute, squared


@kernel(error_model="numpy")
def pixel_terms(first: int, last: int, terms: PixelTerms, sums: Float64[np.ndarray, "chunks 2"]) -> None:
    """Write ``gradient`` = (l1 sign(d) + l2 d) weight, d = render - target, and ``sums`` of |d| and d^2."""
    count, chunks = len(terms.render), len(sums)
    for c in range(first, last):
        _part(c * count // chunks, (c + 1) * count // chunks, terms, sums[c])


@kernel(error_model="numpy")
def mean_errors(
    render: Float32[np.ndarray, "r 3"],
    target: Float32[np.ndarray, "r 3"],
    weight: Float32[np.ndarray, " r"],
    errors: Float32[np.ndarray, " r"],
) -> None:
    """Write each ray's mean absolute error over the channels, times its weight."""
    for r in range(len(weight)):
        total = np.float32(0.0)
        for channel in range(3):
            total += abs(render[r, channel] - target[r, channel]) * weight[r]
        errors[r] = total / np.float32(3.0)

"""Sparse least squares with smooth solutions."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float32, Int
from scipy.sparse import coo_matrix, csr_matrix, diags


def interpolation_matrix(
    shares: Float32[np.ndarray, "r k"], numbers: Int[np.ndarray, "r k"], count: int
) -> csr_matrix:
    """Return the matrix that maps values of ``count`` points to weighted means of ``k`` of them."""
    starts = np.arange(len(shares) + 1, dtype=np.int64) * shares.shape[1]
    return csr_matrix((shares.reshape(-1), numbers.reshape(-1), starts), (len(shares), count))


def difference_matrix(pairs: Int[np.ndarray, "e 2"], count: int) -> csr_matrix:
    """Return the matrix D for which x D x is the sum of squared differences between neighbours."""
    ones = np.ones(len(pairs), np.float32)
    beside = coo_matrix((ones, tuple(pairs.T)), (count, count)).tocsr()
    beside = beside + beside.T
    return (diags(np.asarray(beside.sum(axis=1)).reshape(-1)) - beside).tocsr().astype(np.float32)


def conjugate_gradients(
    apply_matrix: Callable[[Float32[np.ndarray, "n c"]], Float32[np.ndarray, "n c"]],
    diagonal: Float32[np.ndarray, "n #c"],
    right_side: Float32[np.ndarray, "n c"],
    iterations: int,
    *,
    coupled: bool = False,
) -> Float32[np.ndarray, "n c"]:
    """Solve a positive definite linear system approximately by conjugate gradients, from x = 0.

    SciPy's takes one column at a time, and its products are added up in an order that depends on the threads.

    Args:
        apply_matrix: a positive definite linear map.
        diagonal: of the map, by which steps are scaled.
        right_side: the right side.
        iterations: how many steps.
        coupled: whether columns depend on each other; else each goes at its own pace.
    """
    axis = None if coupled else 0
    x, rest = np.zeros_like(right_side), right_side
    step = rest / diagonal
    before = (rest * step).sum(axis=axis, dtype=np.float64)
    for _ in range(iterations):
        image = apply_matrix(step)
        # a direction without curvature takes no step
        bent = np.maximum((step * image).sum(axis=axis, dtype=np.float64), 1e-30)
        length = (before / bent).astype(np.float32)
        x, rest = x + length * step, rest - length * image
        scaled = rest / diagonal
        after = (rest * scaled).sum(axis=axis, dtype=np.float64)
        step = scaled + (after / np.maximum(before, 1e-30)).astype(np.float32) * step
        before = after
    return x

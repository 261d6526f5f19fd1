"""A mean of arrays, moved by one more of them."""

from numba import njit, prange


@njit(cache=True, parallel=True)
def move_towards(mean, now, share):
    """Move each number of ``mean`` by ``share`` of its way to that of ``now``, in float32."""
    for k in prange(len(mean)):
        mean[k] += (now[k] - mean[k]) * share

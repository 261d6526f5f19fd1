"""A mean of arrays, moved by one more of them."""

import numpy as np
from jaxtyping import Float32

from octasplat.engine.core.compilation import kernel


@kernel()
def move_towards(
    first: int, last: int, mean: Float32[np.ndarray, " k"], now: Float32[np.ndarray, " k"], share: float
) -> None:
    """Move each number of ``mean`` by ``share`` of its way to that of ``now``, in float32."""
    for k in range(first, last):
        mean[k] += (now[k] - mean[k]) * share

"""A mean of arrays, moved by one more of them."""

from octasplat.engine.core.compilation import kernel


@kernel()
def move_towards(first, last, mean, now, share):
    """Move each number of ``mean`` by ``share`` of its way to that of ``now``, in float32."""
    for k in range(first, last):
        mean[k] += (now[k] - mean[k]) * share

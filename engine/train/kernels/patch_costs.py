"""How much small patches of photographs differ."""

import numpy as np
from jaxtyping import Float, Float32, Int64

from octasplat.engine.core.compilation import kernel


@kernel(error_model="numpy")
def patch_differences(
    ours: Float32[np.ndarray, "a p 3"],
    theirs: Float32[np.ndarray, "k p 3"],
    rows: Int64[np.ndarray, " k"],
    level_weight: float,
    costs: Float[np.ndarray, " k"],
) -> None:
    """Write the difference of each patch ``theirs[k]`` from ``ours[rows[k]]``, written to ``costs[k]``.

    Patches are pixels of three channels. Mean absolute difference, once the mean of each channel is taken
    out, and ``level_weight`` times that of these means.
    """
    pixels = ours.shape[1]
    for k in range(len(theirs)):
        row = rows[k]
        texture = level = 0.0
        for c in range(3):
            # the mean difference is exposure or shading, the rest is texture
            mean = 0.0
            for p in range(pixels):
                mean += np.float64(theirs[k, p, c]) - np.float64(ours[row, p, c])
            mean /= pixels
            level += abs(mean)
            for p in range(pixels):
                texture += abs(np.float64(theirs[k, p, c]) - np.float64(ours[row, p, c]) - mean)
        costs[k] = texture / (3 * pixels) + level_weight * level / 3

"""Opacities that fade while training, so that what photographs do not hold up goes.

In the place of the resets of "3D Gaussian Splatting for Real-Time Radiance Field Rendering"
(https://arxiv.org/abs/2308.04079): a little at a time, and for all Gaussians.
"""

import numpy as np
from jaxtyping import Float32

DECAY_UNTIL = 0.5
"""Share of the training after which opacities are left alone."""
MIN_OPACITY = 1e-6


def decayed_logits(opacity_logits: Float32[np.ndarray, " n"], factor: float) -> Float32[np.ndarray, " n"]:
    """Return the logits of ``factor`` times the opacities.

    >>> round(float(decayed_logits(np.zeros(1, np.float32), 0.5)[0]), 4)
    -1.0986
    """
    opacities = factor / (1.0 + np.exp(-opacity_logits.astype(np.float64)))
    kept = np.maximum(opacities, MIN_OPACITY)
    return np.log(kept / (1.0 - kept)).astype(np.float32)

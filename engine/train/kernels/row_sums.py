"""Sums for rows of which some are added to."""

import numpy as np
from jaxtyping import Float32, Int32

from octasplat.engine.core.compilation import kernel


@kernel()
def add_to_rows(
    ids: Int32[np.ndarray, " u"], values: Float32[np.ndarray, " u"], sums: Float32[np.ndarray, " n"]
) -> None:
    """Add each value to the sum of its row."""
    for k in range(len(ids)):
        sums[ids[k]] += values[k]

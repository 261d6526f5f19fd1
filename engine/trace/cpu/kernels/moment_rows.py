"""Rows of moments: what the rays of a packet say together about one of its Gaussians."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Int32, Int64

# --- row of sums of a packet's rays for one of its Gaussians, float32, one cache line ---
H, HU, HV, HUU, HUV, HVV, HUUU, HVVV = range(8)  # the last two: h u (u^2 + v^2), h v (u^2 + v^2)
W, COUNT, ERROR, RED, GREEN, BLUE, PACKET = range(8, 15)  # the last is an int32
ROW_WORDS = 16
GT, GTU, GTV, N_0, N_1, N_2 = range(6)
GEOMETRY_WORDS = 6
"""A row's further sums where depths or normals have a gradient: g_t t and the turned normals' gradient."""


class MomentRows(NamedTuple):
    """A row for each Gaussian of each packet; packet p has those from ``firsts[p]`` on.

    ``weights`` are column W of the sums once more, side by side.
    """

    firsts: Int64[np.ndarray, " p1"]
    ids: Int32[np.ndarray, " e"]
    weights: Float32[np.ndarray, " e"]
    sums: Float32[np.ndarray, "e 16"]
    geometry: Float32[np.ndarray, "e _"]
    features: Float32[np.ndarray, "e f"]

"""Ambient visibility: the share of the light from all around that reaches a Gaussian past the others."""

import numpy as np
from jaxtyping import Float32, Float64, Int64

from engine.gaussians.frames import rotation_matrices
from engine.gaussians.model import FlatGaussians
from engine.rays import RayBatch
from engine.trace.protocol import Tracer

_GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))
RAYS_AT_ONCE = 1 << 18


def ambient_visibility(
    gaussians: FlatGaussians, ids: Int64[np.ndarray, " u"], tracer: Tracer, *, rays: int, gap_world: float
) -> Float32[np.ndarray, " u"]:
    """Mean transmittance over the hemisphere, weighted by the cosine, of the side that sees more.

    A Gaussian of a solid thing has one side outside and one inside, and nothing else says which is which.

    Args:
        gaussians: the scene.
        ids: which of them.
        tracer: built around all of them.
        rays: for each side of each.
        gap_world: distance from the Gaussian at which rays begin.
    """
    out = np.empty(len(ids), np.float32)
    fan = cosine_fan(rays)
    step = max(1, RAYS_AT_ONCE // (2 * rays))
    for first in range(0, len(ids), step):
        part = ids[first : first + step]
        frames = rotation_matrices(gaussians.quats_wxyz[part])
        means = gaussians.means_world[part]
        sides = []
        for sign in (1.0, -1.0):
            ways = np.einsum("nij,kj->nki", frames, fan * np.array([sign, 1.0, 1.0]))
            starts = np.repeat(means + sign * gap_world * frames[:, :, 0], rays, axis=0)
            left = tracer.transmittance(RayBatch(starts, ways.reshape(-1, 3), gap_world))
            sides.append(left.reshape(-1, rays).mean(axis=1))
        out[first : first + step] = np.maximum(*sides)
    return out


def cosine_fan(rays: int) -> Float64[np.ndarray, "k 3"]:
    """Directions about the first axis, as dense as the cosine to it; the same each time."""
    square = (np.arange(rays) + 0.5) / rays
    angle = _GOLDEN_ANGLE * np.arange(rays)
    radius = np.sqrt(square)
    return np.stack([np.sqrt(1 - square), radius * np.cos(angle), radius * np.sin(angle)], axis=1)

"""Ambient visibility of Gaussians, and the light that others send them (diffuse interreflection)."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Float32, Float64, Int64

from octasplat.engine.core.rays import RayBatch
from octasplat.engine.gaussians.frames import rotation_matrices
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.shading.gbuffer import RayOffset
from octasplat.engine.trace.protocol import Tracer

_GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))
MAX_RAYS_PER_TRACE = 1 << 18
UNOCCLUDED = 0.98
"""Ambient visibility from which on no interreflection is measured."""

RadianceFn = Callable[[RayBatch], Float64[np.ndarray, "r 3"]]
"""Linear radiance of what rays hit, times its alpha."""


def ambient_visibility(
    gaussians: FlatGaussians,
    ids: Int64[np.ndarray, " u"],
    tracer: Tracer,
    *,
    rays: int,
    offset: RayOffset,
    one_sided: bool = False,
) -> tuple[Float32[np.ndarray, " u"], Float32[np.ndarray, " u"]]:
    """Return the cosine-weighted mean transmittance over the hemisphere of the outer side.

    Where normals do not say which that is, it is the side that sees more: a Gaussian of a solid thing has one
    side outside and one inside.

    Args:
        gaussians: the scene.
        ids: which of them.
        tracer: built around all of them.
        rays: for each side of each.
        offset: how rays leave it.
        one_sided: whether normals point outwards.

    Returns:
        That, and the side: 1 where the normal looks, else -1.
    """
    sides = [1.0] if one_sided else [1.0, -1.0]
    visibility = np.empty((len(sides), len(ids)), np.float32)
    for part in _ray_chunks(len(ids), rays):
        for number, side in enumerate(sides):
            hemisphere = _hemisphere_rays(gaussians, ids[part], np.full(len(ids[part]), side), rays, offset)
            # the mean over cosine-distributed rays is cosine-weighted
            visibility[number, part] = tracer.transmittance(hemisphere).reshape(-1, rays).mean(axis=1)
    return visibility.max(axis=0), np.array(sides, np.float32)[visibility.argmax(axis=0)]


def diffuse_interreflection(
    gaussians: FlatGaussians,
    ids: Int64[np.ndarray, " u"],
    side: Float32[np.ndarray, " u"],
    radiance: RadianceFn,
    *,
    rays: int,
    offset: RayOffset,
) -> Float32[np.ndarray, "u 3"]:
    """Return irradiance over pi that other Gaussians send to one side of each: the mean over the same rays.

    Args:
        gaussians: the scene.
        ids: which of them.
        side: of :func:`ambient_visibility`.
        radiance: what comes from where it is not clear.
        rays: for each.
        offset: how rays leave it.
    """
    out = np.empty((len(ids), 3), np.float32)
    for part in _ray_chunks(len(ids), rays):
        light = radiance(_hemisphere_rays(gaussians, ids[part], side[part], rays, offset))
        out[part] = light.reshape(-1, rays, 3).mean(axis=1)
    return out


def _ray_chunks(count: int, rays: int) -> list[slice]:
    step = max(1, MAX_RAYS_PER_TRACE // rays)
    return [slice(first, first + step) for first in range(0, count, step)]


def _hemisphere_rays(
    gaussians: FlatGaussians,
    ids: Int64[np.ndarray, " u"],
    side: Float[np.ndarray, " u"],
    rays: int,
    offset: RayOffset,
) -> RayBatch:
    """Return rays over the hemisphere of one side of each Gaussian, begun a little above it."""
    frames = rotation_matrices(gaussians.quats_wxyz[ids])
    # the other side: its normal reversed, the axes in its plane kept
    frames = frames * np.stack([side, np.ones_like(side), np.ones_like(side)], axis=1)[:, None, :]
    directions = np.einsum("nij,kj->nki", frames, cosine_hemisphere(rays))
    starts = np.repeat(gaussians.means_world[ids] + offset.bias_world * frames[:, :, 0], rays, axis=0)
    reaches = np.repeat(np.where(side > 0, offset.backface_cull_world, 0.0), rays)
    return RayBatch(starts, directions.reshape(-1, 3), offset.bias_world, t_backface_cull=reaches)


def cosine_hemisphere(rays: int) -> Float64[np.ndarray, "k 3"]:
    """Return directions about the first axis with a density of the cosine to it; the same each time."""
    # a Fibonacci spiral over the disc, lifted to the hemisphere: cosine-weighted
    square = (np.arange(rays) + 0.5) / rays
    angle = _GOLDEN_ANGLE * np.arange(rays)
    radius = np.sqrt(square)
    return np.stack([np.sqrt(1 - square), radius * np.cos(angle), radius * np.sin(angle)], axis=1)

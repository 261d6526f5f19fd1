"""Incident light of a specular lobe from pairs of reflected rays, and its derivatives.

From each point of a G-buffer go two rays, mirrored at two facets on either side of the normal, as far off as
the roughness says. Their mean estimates the light of the lobe; their difference estimates how that changes
with the normal, whatever the rays hit. From some points goes a third ray, mirrored at the normal itself: its
difference from the mean of the two estimates how the light changes with the roughness.

These are derivatives of the light that the lobe blurs, estimated from samples; the tracer gives no derivative
by a ray.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64

from octasplat.engine.core.hashing import hashed_uniforms
from octasplat.engine.core.rays import RayBatch, concatenate_rays
from octasplat.engine.shading.gbuffer import GBuffer, reflected_rays
from octasplat.engine.shading.reflection_tracing import IncidentLight, IncidentTracer, TracedReflections
from octasplat.engine.shading.split_sum import SurfacePoints

MAX_FACET_SLOPE = 0.9
"""Share of GGX's facets that are sampled; the others are steeper than these."""
MIN_ROUGHNESS = 0.02
"""Slopes by the roughness are those of surfaces at least so rough."""


@dataclass(frozen=True)
class FacetPair:
    """Two facets beside each normal, ``p`` points.

    Attributes:
        tangent_world: unit vectors in the surface; the facets' normals are n + slope t and n - slope t.
        slope: tangents of the angles between normal and facets.
    """

    tangent_world: Float64[np.ndarray, "p 3"]
    slope: Float64[np.ndarray, " p"]

    def normals(self, normal_world: Float64[np.ndarray, "p 3"], sign: float) -> Float64[np.ndarray, "p 3"]:
        """Return the facets' unit normals on one side."""
        steep = normal_world + sign * self.slope[:, None] * self.tangent_world
        return steep / np.sqrt(1 + self.slope**2)[:, None]


def sample_facets(
    surface: SurfacePoints, numbers: Float64[np.ndarray, "2 p"], *, min_slope: float
) -> FacetPair:
    """Draw facets by GGX's distribution, at least ``min_slope`` steep, from two uniform numbers each."""
    u, v = numbers
    alpha = surface.material[:, 4] ** 2
    u = u * MAX_FACET_SLOPE  # the steepest facets, which GGX has without bound, are left out
    # tan of GGX's facets: alpha sqrt(u / (1 - u))
    slope = np.maximum(alpha * np.sqrt(u / (1 - u)), min_slope)
    n = surface.normal_world
    across = np.where(np.abs(n[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    first = np.cross(across, n)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    angle = np.pi * v[:, None]  # half way around, as each facet has one on the other side
    return FacetPair(np.cos(angle) * first + np.sin(angle) * np.cross(n, first), slope)


def direction_uniforms(directions: Float64[np.ndarray, "p 3"], salt: int) -> Float64[np.ndarray, "2 p"]:
    """Return two numbers in [0, 1) for each direction that follow from it and the salt alone."""
    bits = np.ascontiguousarray(directions, np.float64).view(np.uint64)
    return hashed_uniforms(bits[:, 0] + np.uint64(salt), bits[:, 1], bits[:, 2])


@dataclass(frozen=True)
class ReflectionRayPairs:
    """Reflected rays of a buffer's points in pairs, one on either side of each lobe.

    Attributes:
        facets: that the two rays of each point were mirrored at.
        reflected: these rays, those of one side and then those of the other.
    """

    facets: FacetPair
    reflected: TracedReflections

    @property
    def incident(self) -> IncidentLight:
        """Return the mean of the two rays of each point."""
        return mean_of_pairs(self.reflected.incident)


class RoughnessProbe(NamedTuple):
    """Probe of the change of radiance as lobes widen, at ``w`` of the points of a buffer.

    Attributes:
        point_ids: their numbers.
        change: mean of the pair less the ray in its middle.
    """

    point_ids: Int64[np.ndarray, " w"]
    change: IncidentLight


def trace_ray_pairs(
    rays: RayBatch,
    gbuffer: GBuffer,
    reflection_tracer: IncidentTracer,
    numbers: Float64[np.ndarray, "2 p"],
    *,
    min_slope: float,
    record: bool,
) -> ReflectionRayPairs:
    """Trace two rays from each point of a G-buffer, mirrored at its facets.

    Args:
        rays: that the buffer was gathered along.
        gbuffer: of ``p`` points.
        reflection_tracer: of reflected rays.
        numbers: see :func:`sample_facets`.
        min_slope: likewise.
        record: whether to keep what the backward pass needs.
    """
    facets = sample_facets(gbuffer.surface, numbers, min_slope=min_slope)
    one, other = (
        reflected_rays(
            rays, gbuffer, reflection_tracer.offset, facets.normals(gbuffer.surface.normal_world, sign)
        )
        for sign in (1.0, -1.0)
    )
    return ReflectionRayPairs(facets, reflection_tracer.trace(concatenate_rays(one, other), record=record))


def probe_roughness(
    rays: RayBatch,
    gbuffer: GBuffer,
    reflection_tracer: IncidentTracer,
    pairs: ReflectionRayPairs,
    is_probed: Bool[np.ndarray, " p"],
    *,
    min_slope: float,
) -> RoughnessProbe:
    # where min_slope decides, the slope does not depend on the roughness
    """Trace a third ray from the drawn points, where facets are as steep as the roughness says."""
    ids = np.flatnonzero(is_probed & (pairs.facets.slope > min_slope))
    middle = reflection_tracer.trace(
        reflected_rays(rays, gbuffer, reflection_tracer.offset)[ids], record=False
    ).incident
    return RoughnessProbe(
        ids,
        IncidentLight(
            *(mean[ids] - at_normal for mean, at_normal in zip(pairs.incident, middle, strict=True))
        ),
    )


def mean_of_pairs(incident: IncidentLight) -> IncidentLight:
    """Return the incident light of a lobe: the mean of the two rays of each point."""
    half = len(incident.visibility) // 2
    return IncidentLight(
        (incident.visibility[:half] + incident.visibility[half:]) / 2,
        (incident.light_linear[:half] + incident.light_linear[half:]) / 2,
    )


def backward_mean(grad_mean: IncidentLight) -> IncidentLight:
    """Return gradients by what each of two rays saw, from those by their mean."""
    visibility, light = grad_mean.visibility / 2, grad_mean.light_linear / 2
    return IncidentLight(np.concatenate([visibility, visibility]), np.concatenate([light, light]))


def backward_normals(
    incident: IncidentLight,
    facets: FacetPair,
    around_linear: Float64[np.ndarray, "p 3"],
    grad_incoming: Float64[np.ndarray, "p 3"],
) -> Float64[np.ndarray, "p 3"]:
    """Return gradients by the normals through what the two rays of each point see differently.

    Tangents are drawn evenly from all ways around, so that twice the slope along one is the slope along both
    axes of the surface in the mean.

    Args:
        incident: what the rays saw.
        facets: that they were mirrored at.
        around_linear: the environment as the lobe sees it where nothing hides it.
        grad_incoming: gradient by the light that comes in.
    """
    half = len(facets.slope)
    change = incident.light_linear[:half] - incident.light_linear[half:]
    # where the environment is hidden differently
    change += (incident.visibility[:half] - incident.visibility[half:])[:, None] * around_linear
    along = (grad_incoming * change).sum(axis=1) / facets.slope
    return along[:, None] * facets.tangent_world


def backward_roughness(
    probe: RoughnessProbe,
    roughness: Float64[np.ndarray, " w"],
    around_linear: Float64[np.ndarray, "w 3"],
    grad_incoming: Float64[np.ndarray, "w 3"],
) -> Float64[np.ndarray, " w"]:
    """Return gradients by the roughness, from how far the mean of two rays is from the one between them.

    That distance grows with the square of the facets' slope where what is seen is smooth, and the slope of
    GGX's facets with the square of the roughness: with its fourth power, then. Where lobes reach an edge it
    grows faster, and beyond it more slowly; the sign is right. As the same pair made the error that
    ``grad_incoming`` comes from, its variance takes part: what makes grain is made less rough, as the loss of
    pictures with one pair a pixel wants it.

    Args:
        probe: what the three rays saw.
        roughness: of the points that sent three.
        around_linear: the environment as their lobes see it where nothing hides it.
        grad_incoming: gradient by the light that comes in there.
    """
    change = probe.change.light_linear + probe.change.visibility[:, None] * around_linear
    return np.asarray(4 * (grad_incoming * change).sum(axis=1) / np.maximum(roughness, MIN_ROUGHNESS))

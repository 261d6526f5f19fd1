"""The lobe of a surface beside others: pairs of reflected rays say what it sees, and how that would change.

From each point of a buffer go two rays, mirrored at two facets that lie on either side of the normal, as far
off as the roughness says. Their mean is what the lobe sees past other surfaces; their difference says how
that changes with the normal, whatever it is that they meet. From some points goes a third, mirrored at the
normal itself: how far the mean of the two is from it says how what is seen changes with the roughness.

These are slopes of what the lobe's blur makes of the scene, estimated from samples; the tracer is asked for
no derivative by a ray.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64

from octasplat.engine.core.hashing import unit_numbers
from octasplat.engine.core.rays import RayBatch, joined
from octasplat.engine.shading.gbuffer import Buffer, reflected_rays
from octasplat.engine.shading.reflection_tracing import Follower, Mirrored, Seen
from octasplat.engine.shading.split_sum import Surface

STEEPEST_FACET = 0.9
"""Share of GGX's facets that are sampled; the others are steeper than these."""
LEAST_ROUGHNESS = 0.02
"""Slopes by the roughness are those of surfaces at least so rough."""


@dataclass(frozen=True)
class Facets:
    """Two facets beside each normal, ``p`` points.

    Attributes:
        tangent_world: unit vectors in the surface; the facets' normals are n + slope t and n - slope t.
        slope: tangents of the angles between normal and facets.
    """

    tangent_world: Float64[np.ndarray, "p 3"]
    slope: Float64[np.ndarray, " p"]

    def normals(self, normal_world: Float64[np.ndarray, "p 3"], sign: float) -> Float64[np.ndarray, "p 3"]:
        """The facets' unit normals on one side."""
        steep = normal_world + sign * self.slope[:, None] * self.tangent_world
        return steep / np.sqrt(1 + self.slope**2)[:, None]


def facets_of(surface: Surface, numbers: Float64[np.ndarray, "2 p"], *, least_slope: float) -> Facets:
    """Facets by GGX's distribution, at least ``least_slope`` steep, from two even numbers in [0, 1) each."""
    u, v = numbers
    alpha = surface.material[:, 4] ** 2
    u = u * STEEPEST_FACET
    slope = np.maximum(alpha * np.sqrt(u / (1 - u)), least_slope)
    n = surface.normal_world
    across = np.where(np.abs(n[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    first = np.cross(across, n)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    angle = np.pi * v[:, None]  # half way around, as each facet has one on the other side
    return Facets(np.cos(angle) * first + np.sin(angle) * np.cross(n, first), slope)


def numbers_of(directions: Float64[np.ndarray, "p 3"], salt: int) -> Float64[np.ndarray, "2 p"]:
    """Two numbers in [0, 1) for each direction that follow from it and the salt alone."""
    bits = np.ascontiguousarray(directions, np.float64).view(np.uint64)
    return unit_numbers(bits[:, 0] + np.uint64(salt), bits[:, 1], bits[:, 2])


@dataclass(frozen=True)
class Lobe:
    """What the lobes of a buffer's points see.

    Attributes:
        facets: that the two rays of each point were mirrored at.
        mirrored: these rays, those of one side and then those of the other.
    """

    facets: Facets
    mirrored: Mirrored

    @property
    def seen(self) -> Seen:
        """The mean of the two rays of each point."""
        return pair_mean(self.mirrored.seen)


class Widening(NamedTuple):
    """What changes as lobes widen, at ``w`` of the points of a buffer.

    Attributes:
        points: their numbers.
        change: mean of the pair less the ray in its middle.
    """

    points: Int64[np.ndarray, " w"]
    change: Seen


def look(
    rays: RayBatch,
    buffer: Buffer,
    follower: Follower,
    numbers: Float64[np.ndarray, "2 p"],
    *,
    least_slope: float,
    record: bool,
) -> Lobe:
    """Send two rays from each point of a buffer, mirrored at its facets.

    Args:
        rays: that the buffer was gathered along.
        buffer: of ``p`` points.
        follower: of reflected rays.
        numbers: see :func:`facets_of`.
        least_slope: likewise.
        record: whether there will be a way back.
    """
    facets = facets_of(buffer.surface, numbers, least_slope=least_slope)
    one, other = (
        reflected_rays(rays, buffer, follower.leaving, facets.normals(buffer.surface.normal_world, sign))
        for sign in (1.0, -1.0)
    )
    return Lobe(facets, follower.follow(joined(one, other), record=record))


def widening(
    rays: RayBatch,
    buffer: Buffer,
    follower: Follower,
    lobe: Lobe,
    drawn: Bool[np.ndarray, " p"],
    *,
    least_slope: float,
) -> Widening:
    """Send a third ray from the points that were drawn, where facets are as steep as the roughness says."""
    points = np.flatnonzero(drawn & (lobe.facets.slope > least_slope))
    middle = follower.follow(reflected_rays(rays, buffer, follower.leaving)[points], record=False).seen
    return Widening(points, Seen(*(mean[points] - own for mean, own in zip(lobe.seen, middle, strict=True))))


def pair_mean(seen: Seen) -> Seen:
    """What the lobe sees: the mean of the two rays of each point."""
    half = len(seen.visibility) // 2
    return Seen(
        (seen.visibility[:half] + seen.visibility[half:]) / 2,
        (seen.light_linear[:half] + seen.light_linear[half:]) / 2,
    )


def by_each(by_mean: Seen) -> Seen:
    """Gradients by what each of two rays saw, from those by their mean."""
    visibility, light = by_mean.visibility / 2, by_mean.light_linear / 2
    return Seen(np.concatenate([visibility, visibility]), np.concatenate([light, light]))


def pair_slope(
    seen: Seen,
    facets: Facets,
    around_linear: Float64[np.ndarray, "p 3"],
    by_incoming: Float64[np.ndarray, "p 3"],
) -> Float64[np.ndarray, "p 3"]:
    """Gradients by the normals through what the two rays of each point see differently.

    Tangents are drawn evenly from all ways around, so that twice the slope along one is the slope along both
    axes of the surface in the mean.

    Args:
        seen: what the rays saw.
        facets: that they were mirrored at.
        around_linear: the environment as the lobe sees it where nothing hides it.
        by_incoming: gradient by the light that comes in.
    """
    half = len(facets.slope)
    change = seen.light_linear[:half] - seen.light_linear[half:]
    change += (seen.visibility[:half] - seen.visibility[half:])[:, None] * around_linear
    along = (by_incoming * change).sum(axis=1) / facets.slope
    return along[:, None] * facets.tangent_world


def roughness_slope(
    found: Widening,
    roughness: Float64[np.ndarray, " w"],
    around_linear: Float64[np.ndarray, "w 3"],
    by_incoming: Float64[np.ndarray, "w 3"],
) -> Float64[np.ndarray, " w"]:
    """Gradients by the roughness through how far the mean of two rays is from the one in their middle.

    That distance grows with the square of the facets' slope where what is seen is smooth, and the slope of
    GGX's facets with the square of the roughness: with its fourth power, then. Where lobes reach an edge it
    grows faster, and beyond it more slowly; the sign is right. As the same pair made the error that
    ``by_incoming`` comes from, its variance takes part: what makes grain is made less rough, as the loss of
    pictures with one pair a pixel wants it.

    Args:
        found: what the three rays saw.
        roughness: of the points that sent three.
        around_linear: the environment as their lobes see it where nothing hides it.
        by_incoming: gradient by the light that comes in there.
    """
    change = found.change.light_linear + found.change.visibility[:, None] * around_linear
    return np.asarray(4 * (by_incoming * change).sum(axis=1) / np.maximum(roughness, LEAST_ROUGHNESS))

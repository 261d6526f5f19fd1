"""What reflected rays see: followed from surface to surface through the same Gaussians, with the way back.

From each point of a buffer go two rays, mirrored at two facets that lie on either side of the normal, as far
off as the roughness says. Their mean is what the lobe sees past other surfaces; their difference says how
that changes with the normal, whatever it is that they meet. From there on a path goes on by plain mirrors.

That is the slope of what the lobe's blur makes of the scene, estimated by pairs of opposite samples; the
tracer is asked for no derivative by a ray.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, UInt64

from engine.rays import RayBatch, joined
from engine.shading.buffer import Buffer, Leaving, gather, reflected_rays, spread_back
from engine.shading.environment_levels import LightLevels
from engine.shading.parted import Parted, part, whole
from engine.shading.split_sum import Surface, shade, shade_reverse
from engine.trace.protocol import Recording, TraceGradients, Tracer, TraceResult

STEEPEST_FACET = 0.9
"""Share of GGX's facets that are sampled; the others are steeper than these."""


class Seen(NamedTuple):
    """What a reflected ray saw, ``s`` of them.

    Attributes:
        visibility: share of the environment that is seen past everything.
        light_linear: radiance of what is met, times one minus that.
    """

    visibility: Float64[np.ndarray, " s"]
    light_linear: Float64[np.ndarray, "s 3"]


@dataclass(frozen=True)
class Mirrored:
    """Reflected rays and what became of them.

    Attributes:
        trace: what they met.
        parted: that, one surface at a time.
        buffer: what was blended along those that met something.
        surface: the points of that, with what further rays say of them.
        linear: their radiance.
        further: the rays from there on.
    """

    trace: TraceResult
    parted: Parted
    buffer: Buffer
    surface: Surface
    linear: Float64[np.ndarray, "q 3"]
    further: "Mirrored | None"

    @property
    def seen(self) -> Seen:
        """What each ray saw."""
        light = np.zeros((len(self.parted.rays), 3))
        light[self.buffer.which] = self.buffer.alpha[:, None] * self.linear
        return Seen(self.trace.transmittance.astype(np.float64), self.parted.joined(light))


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


def facets_of(surface: Surface, *, least_slope: float, salt: int) -> Facets:
    """Facets by GGX's distribution, at least ``least_slope`` steep; the same for the same rays and salt."""
    u, v = noise(surface.direction_world, salt)
    alpha = surface.material[:, 4] ** 2
    u = u * STEEPEST_FACET
    slope = np.maximum(alpha * np.sqrt(u / (1 - u)), least_slope)
    n = surface.normal_world
    across = np.where(np.abs(n[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    first = np.cross(across, n)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    angle = 2 * np.pi * v[:, None]
    return Facets(np.cos(angle) * first + np.sin(angle) * np.cross(n, first), slope)


def mirrored_pair(rays: RayBatch, buffer: Buffer, facets: Facets, leaving: Leaving) -> RayBatch:
    """Rays from the points of a buffer, mirrored at the facets of one side and then at those of the other."""
    one, other = (
        reflected_rays(rays, buffer, leaving, facets.normals(buffer.surface.normal_world, sign))
        for sign in (1.0, -1.0)
    )
    return joined(one, other)


def follow(
    rays: RayBatch,
    tracer: Tracer,
    light: LightLevels,
    frame: Float64[np.ndarray, "3 3"],
    dimmed: Callable[[TraceResult, Buffer], Surface],
    *,
    surfaces: int,
    leaving: Leaving,
    apart_world: float,
    record: bool,
) -> Mirrored:
    """Follow reflected rays over at most so many surfaces.

    Args:
        rays: the first of them.
        tracer: built around the Gaussians, with materials as features.
        light: the environment's levels.
        frame: its right, up and forward in the world, as rows.
        dimmed: the surface of a buffer with its ambient visibility.
        surfaces: on a path, at least 1; the last one sees nothing but the environment.
        leaving: how rays leave a surface.
        apart_world: see :func:`engine.shading.parted.part`; 0 parts nothing.
        record: whether there will be a way back.
    """
    trace = tracer.trace(rays, record=record)
    parted = whole(rays, trace)
    if apart_world > 0:
        parted = part(rays, trace, tracer, apart_world=apart_world, record=record)
    buffer = gather(parted.rays, parted.seen)
    surface, further = dimmed(parted.seen, buffer), None
    if surfaces > 1 and len(buffer.which):
        onward = reflected_rays(parted.rays, buffer, leaving)
        further = follow(
            onward, tracer, light, frame, dimmed,
            surfaces=surfaces - 1, leaving=leaving, apart_world=apart_world, record=record,
        )  # fmt: skip
        seen = further.seen
        surface = replace(surface, visibility=seen.visibility, indirect_linear=seen.light_linear)
    return Mirrored(trace, parted, buffer, surface, shade(surface, light, frame), further)


def follow_back(
    mirrored: Mirrored,
    light: LightLevels,
    frame: Float64[np.ndarray, "3 3"],
    by_light: Float64[np.ndarray, "s 3"],
    by_texels: Float64[np.ndarray, "t 3"],
) -> tuple[tuple[Recording, TraceGradients], ...]:
    """Gradients by the materials of all that was met, from those by :attr:`Seen.light_linear`.

    Those by the texels are added to ``by_texels``. None by visibility, none by the geometry of what was met.
    """
    buffer, trace, parted = mirrored.buffer, mirrored.trace, mirrored.parted
    assert trace.hits is not None
    by_linear = parted.each(by_light)[buffer.which] * buffer.alpha[:, None]
    back = shade_reverse(mirrored.surface, light, frame, by_linear)
    by_texels += back.texels(len(by_texels))
    count = len(parted.rays)
    by_features, nothing = np.zeros((count, trace.features.shape[1])), np.zeros((count, 3))
    spread_back(buffer, back.material, np.zeros_like(back.normal), by_features, np.zeros(count), nothing)
    own = TraceGradients(rgb_srgb=nothing.astype(np.float32), features=by_features.astype(np.float32))
    by_whole, fronts = parted.back(own)
    found = ((trace.hits, by_whole), *fronts)
    if mirrored.further is None:
        return found
    return found + follow_back(mirrored.further, light, frame, back.indirect, by_texels)


def pair_mean(seen: Seen) -> Seen:
    """What the lobe sees: the mean of the two rays of each point."""
    half = len(seen.visibility) // 2
    return Seen(
        (seen.visibility[:half] + seen.visibility[half:]) / 2,
        (seen.light_linear[:half] + seen.light_linear[half:]) / 2,
    )


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


def noise(directions: Float64[np.ndarray, "p 3"], salt: int) -> Float64[np.ndarray, "2 p"]:
    """Two numbers in [0, 1) for each direction that follow from it and the salt alone."""
    bits = np.ascontiguousarray(directions, np.float64).view(np.uint64)
    state = _mixed(bits[:, 0] + np.uint64(salt))
    state = _mixed(state + bits[:, 1])
    state = _mixed(state + bits[:, 2])
    return np.stack([(x >> np.uint64(11)) * 2.0**-53 for x in (state, _mixed(state))])


def _mixed(x: UInt64[np.ndarray, " p"]) -> UInt64[np.ndarray, " p"]:
    """A step of SplitMix64, "Fast Splittable Pseudorandom Number Generators" (Steele et al. 2014)."""
    x = x + np.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))

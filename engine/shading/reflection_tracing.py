"""What reflected rays see: followed from surface to surface through the same Gaussians, with the way back.

:mod:`octasplat.engine.shading.reflection_rays` says how they leave the first surface; from there on paths go by plain
mirrors.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from octasplat.engine.core.rays import RayBatch
from octasplat.engine.shading.depth_split import Parted, part, whole
from octasplat.engine.shading.gbuffer import Buffer, Leaving, gather, reflected_rays, spread_back
from octasplat.engine.shading.kernels.environment_levels import LightLevels
from octasplat.engine.shading.split_sum import Surface, shade, shade_reverse
from octasplat.engine.trace.protocol import Recording, TraceGradients, Tracer, TraceResult


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
class Follower:
    """Follows reflected rays, and goes their ways back.

    Attributes:
        tracer: built around the Gaussians, with materials as features.
        light: the environment's levels.
        frame: its right, up and forward in the world, as rows.
        dimmed: the surface of a buffer with its ambient visibility.
        surfaces: on a path, at least 1; the last one sees nothing but the environment.
        leaving: how rays leave a surface.
        apart_world: see :func:`octasplat.engine.shading.depth_split.part`; 0 parts nothing.
    """

    tracer: Tracer
    light: LightLevels
    frame: Float64[np.ndarray, "3 3"]
    dimmed: Callable[[TraceResult, Buffer], Surface]
    surfaces: int
    leaving: Leaving
    apart_world: float

    def follow(self, rays: RayBatch, *, record: bool) -> Mirrored:
        """What becomes of reflected rays; ``record`` says whether there will be a way back."""
        trace = self.tracer.trace(rays, record=record)
        parted = whole(rays, trace)
        if self.apart_world > 0:
            parted = part(rays, trace, self.tracer, apart_world=self.apart_world, record=record)
        buffer = gather(parted.rays, parted.seen)
        surface, further = self.dimmed(parted.seen, buffer), None
        if self.surfaces > 1 and len(buffer.which):
            onward = reflected_rays(parted.rays, buffer, self.leaving)
            further = replace(self, surfaces=self.surfaces - 1).follow(onward, record=record)
            seen = further.seen
            surface = replace(surface, visibility=seen.visibility, indirect_linear=seen.light_linear)
        return Mirrored(trace, parted, buffer, surface, shade(surface, self.light, self.frame), further)


def follow_back(
    mirrored: Mirrored,
    light: LightLevels,
    frame: Float64[np.ndarray, "3 3"],
    by_seen: Seen,
    by_texels: Float64[np.ndarray, "t 3"],
) -> tuple[tuple[Recording, TraceGradients], ...]:
    """Gradients by the materials of all that was met, and by how much of it there is.

    So what only a mirror shows takes its shape from there. None by its normals, none by where it was met.

    Args:
        mirrored: what rays met.
        light: see :class:`Follower`.
        frame: likewise.
        by_seen: gradients by what each ray saw.
        by_texels: those by the texels are added to this.
    """
    buffer, trace, parted = mirrored.buffer, mirrored.trace, mirrored.parted
    assert trace.recording is not None
    which, count = buffer.which, len(parted.rays)
    by_light = parted.each(by_seen.light_linear)[which]
    back = shade_reverse(mirrored.surface, light, frame, by_light * buffer.alpha[:, None])
    by_texels += back.texels(len(by_texels))
    by_alpha = -parted.each(by_seen.visibility)
    by_alpha[which] += (by_light * mirrored.linear).sum(axis=1)
    by_features, nothing = np.zeros((count, trace.features.shape[1])), np.zeros((count, 3))
    spread_back(buffer, back.material, np.zeros_like(back.normal), by_features, by_alpha, nothing)
    own = TraceGradients(
        rgb_srgb=nothing.astype(np.float32),
        transmittance=-by_alpha.astype(np.float32),
        features=by_features.astype(np.float32),
    )
    by_whole, fronts = parted.back(own)
    found = ((trace.recording, by_whole), *fronts)
    if mirrored.further is None:
        return found
    by_further = Seen(back.visibility, back.indirect)
    return found + follow_back(mirrored.further, light, frame, by_further, by_texels)

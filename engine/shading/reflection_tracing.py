"""Reflected rays traced from surface to surface through the same Gaussians, with their backward pass.

:mod:`octasplat.engine.shading.reflection_rays` says how they leave the first surface; from there on they
are mirrored at the normals.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float64

from octasplat.engine.core.rays import RayBatch
from octasplat.engine.shading.depth_split import DepthLayers, single_layer, split_by_depth
from octasplat.engine.shading.gbuffer import (
    GBuffer,
    RayOffset,
    backward_gbuffer,
    build_gbuffer,
    reflected_rays,
)
from octasplat.engine.shading.kernels.environment_levels import EnvironmentLevels
from octasplat.engine.shading.split_sum import SurfacePoints, shade, shade_backward
from octasplat.engine.trace.protocol import Recording, TraceGradients, Tracer, TraceResult


class IncidentLight(NamedTuple):
    """Visibility and incident radiance along ``s`` reflected rays.

    Attributes:
        visibility: share of the environment that is seen past everything.
        light_linear: radiance of what is met, times one minus that.
    """

    visibility: Float64[np.ndarray, " s"]
    light_linear: Float64[np.ndarray, "s 3"]


@runtime_checkable
class TracedReflections(Protocol):
    """Reflected rays that were traced."""

    @property
    def incident(self) -> IncidentLight:
        """Return what each ray saw."""
        ...

    def backward(
        self, grad_incident: IncidentLight, grad_texels: Float64[np.ndarray, "t 3"]
    ) -> tuple[tuple[Recording, TraceGradients], ...]:
        """Return gradients by what was met; those by the environment are added to ``grad_texels``."""
        ...


@runtime_checkable
class IncidentTracer(Protocol):
    """Tracer of reflected rays."""

    @property
    def offset(self) -> RayOffset:
        """Return how rays leave a surface."""
        ...

    def trace(self, rays: RayBatch, *, record: bool) -> TracedReflections:
        """Trace reflected rays; ``record`` keeps what the backward pass needs."""
        ...


@dataclass(frozen=True)
class ReflectedRays:
    """Reflected rays and what they hit.

    Attributes:
        trace: what they met.
        depth_layers: that, one surface at a time.
        gbuffer: what was blended along those that met something.
        surface: the points of that, with what further rays say of them.
        linear: their radiance.
        next_bounce: the rays from there on.
        tracer: that followed them.
    """

    trace: TraceResult
    depth_layers: DepthLayers
    gbuffer: GBuffer
    surface: SurfacePoints
    linear: Float64[np.ndarray, "q 3"]
    next_bounce: "ReflectedRays | None"
    tracer: "ReflectionTracer"

    @property
    def incident(self) -> IncidentLight:
        """Return what each ray saw."""
        light = np.zeros((len(self.depth_layers.rays), 3))
        light[self.gbuffer.ray_ids] = self.gbuffer.alpha[:, None] * self.linear
        return IncidentLight(self.trace.transmittance.astype(np.float64), self.depth_layers.sum_layers(light))

    def backward(
        self, grad_incident: IncidentLight, grad_texels: Float64[np.ndarray, "t 3"]
    ) -> tuple[tuple[Recording, TraceGradients], ...]:
        """Return :func:`backward_reflections`."""
        return backward_reflections(self, self.tracer.light, self.tracer.frame, grad_incident, grad_texels)


@dataclass(frozen=True)
class ReflectionTracer:
    """Trace reflected rays over several bounces.

    Attributes:
        tracer: built around the Gaussians, with materials as features.
        light: the environment's levels.
        frame: its right, up and forward in the world, as rows.
        with_ambient: the surface of a buffer with its ambient visibility.
        max_bounces: on a path, at least 1; the last one sees nothing but the environment.
        offset: how rays leave a surface.
        min_separation_world: see :func:`octasplat.engine.shading.depth_split.split_by_depth`; 0 parts
            nothing.
    """

    tracer: Tracer
    light: EnvironmentLevels
    frame: Float64[np.ndarray, "3 3"]
    with_ambient: Callable[[TraceResult, GBuffer], SurfacePoints]
    max_bounces: int
    offset: RayOffset
    min_separation_world: float

    def trace(self, rays: RayBatch, *, record: bool) -> ReflectedRays:
        """Trace reflected rays over all bounces; ``record`` keeps what the backward pass needs."""
        trace = self.tracer.trace(rays, record=record)
        split = single_layer(rays, trace)
        if self.min_separation_world > 0:
            split = split_by_depth(
                rays,
                trace,
                self.tracer,
                min_separation_world=self.min_separation_world,
                record_for_backward=record,
            )
        gbuffer = build_gbuffer(split.rays, split.results)
        surface, next_bounce = self.with_ambient(split.results, gbuffer), None
        if self.max_bounces > 1 and len(gbuffer.ray_ids):
            next_rays = reflected_rays(split.rays, gbuffer, self.offset)
            # one bounce less each time
            next_bounce = replace(self, max_bounces=self.max_bounces - 1).trace(next_rays, record=record)
            incident = next_bounce.incident
            surface = replace(surface, visibility=incident.visibility, indirect_linear=incident.light_linear)
        return ReflectedRays(
            trace=trace,
            depth_layers=split,
            gbuffer=gbuffer,
            surface=surface,
            linear=shade(surface, self.light, self.frame),
            next_bounce=next_bounce,
            tracer=self,
        )


def backward_reflections(
    reflected: ReflectedRays,
    light: EnvironmentLevels,
    frame: Float64[np.ndarray, "3 3"],
    grad_incident: IncidentLight,
    grad_texels: Float64[np.ndarray, "t 3"],
) -> tuple[tuple[Recording, TraceGradients], ...]:
    """Return gradients by the materials of all that was hit, and by its alpha.

    So what only a mirror shows takes its shape from there. None by its normals, none by where it was met.

    Args:
        reflected: what rays met.
        light: see :class:`ReflectionTracer`.
        frame: likewise.
        grad_incident: gradients by what each ray saw.
        grad_texels: those by the texels are added to this.
    """
    gbuffer, trace, split = reflected.gbuffer, reflected.trace, reflected.depth_layers
    assert trace.recording is not None
    ray_ids, count = gbuffer.ray_ids, len(split.rays)
    grad_light = split.expand(grad_incident.light_linear)[ray_ids]
    back = shade_backward(reflected.surface, light, frame, grad_light * gbuffer.alpha[:, None])
    grad_texels += back.sum_texels(len(grad_texels))
    grad_alpha = -split.expand(grad_incident.visibility)  # visibility is the transmittance of the ray
    grad_alpha[ray_ids] += (grad_light * reflected.linear).sum(axis=1)
    grad_features, nothing = np.zeros((count, trace.features.shape[1])), np.zeros((count, 3))
    backward_gbuffer(
        gbuffer=gbuffer,
        grad_material=back.material,
        grad_unit_normal=np.zeros_like(back.normal),
        grad_features=grad_features,
        grad_alpha=grad_alpha,
        grad_normal=nothing,
    )
    grad_layers = TraceGradients(
        rgb_srgb=nothing.astype(np.float32),
        transmittance=-grad_alpha.astype(np.float32),
        features=grad_features.astype(np.float32),
    )
    grad_trace, fronts = split.backward(grad_layers)
    recorded = ((trace.recording, grad_trace), *fronts)
    if reflected.next_bounce is None:
        return recorded
    grad_next = IncidentLight(back.visibility, back.indirect)
    return recorded + backward_reflections(reflected.next_bounce, light, frame, grad_next, grad_texels)

"""Light along reflected directions, by pairs of rays or by single ones, with the backward pass."""

from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float64

from octasplat.engine.core.color import srgb_to_linear
from octasplat.engine.shading.depth_split import DepthLayers
from octasplat.engine.shading.gbuffer import GBuffer, RayOffset, reflected_rays
from octasplat.engine.shading.gradient_ops import srgb_derivative
from octasplat.engine.shading.kernels.split_sum import ShadeGradients
from octasplat.engine.shading.material_settings import MaterialSettings
from octasplat.engine.shading.protocol import TracedRays
from octasplat.engine.shading.reflection_rays import (
    ReflectionRayPairs,
    RoughnessProbe,
    backward_mean,
    backward_normals,
    backward_roughness,
    direction_uniforms,
    probe_roughness,
    trace_ray_pairs,
)
from octasplat.engine.shading.reflection_tracing import IncidentLight, IncidentTracer
from octasplat.engine.trace.protocol import Recording, TraceGradients

PROGRESS_SALTS = 1 << 20
"""Resolution at which the share of the training that is done changes the random numbers."""

RecordedGradients = tuple[tuple[Recording, TraceGradients], ...]


@runtime_checkable
class IncidentLightModel(Protocol):
    """Incident light at the points of a G-buffer, and gradients through it."""

    @property
    def incident(self) -> IncidentLight:
        """Return what comes in at each point."""
        ...

    def normal_gradient(self, back: ShadeGradients) -> Float64[np.ndarray, "p 3"] | float:
        """Return gradients by the normals through what reflected rays hit."""
        ...

    def add_roughness_gradient(self, back: ShadeGradients) -> None:
        """Add gradients by the roughness through what reflected rays meet to those of the materials."""
        ...

    def backward(self, back: ShadeGradients, grad_texels: Float64[np.ndarray, "t 3"]) -> RecordedGradients:
        """Return gradients by what reflected rays hit; those by the texels are added to ``grad_texels``."""
        ...


@dataclass(frozen=True)
class RayPairIncidentLight:
    """Pairs of rays, and what they meet as the tracer of reflected rays shades it.

    See :mod:`octasplat.engine.shading.reflection_rays`.

    Attributes:
        pairs: what they saw.
        probe: what changes with the roughness at some of the points; None unless in a training.
        roughness: of all points.
        settings: of the materials.
    """

    pairs: ReflectionRayPairs
    probe: RoughnessProbe | None
    roughness: Float64[np.ndarray, " p"]
    settings: MaterialSettings

    @classmethod
    def trace(
        cls,
        traced: TracedRays,
        split: DepthLayers,
        gbuffer: GBuffer,
        reflection_tracer: IncidentTracer,
        settings: MaterialSettings,
    ) -> "RayPairIncidentLight":
        """Trace pairs of rays for the points of a G-buffer."""
        rays, record, directions = split.rays, traced.is_recorded, gbuffer.surface.direction_world
        salt, min_slope = (
            int(traced.training_progress * PROGRESS_SALTS),
            settings.min_facet_slope(traced.training_progress),
        )
        if traced.dither is None:
            # other numbers at each iteration, the same after a resume
            uniforms = direction_uniforms(directions, salt)
        else:
            uniforms = split.expand(traced.dither.T)[gbuffer.ray_ids].T
        pairs = trace_ray_pairs(
            rays, gbuffer, reflection_tracer, uniforms, min_slope=min_slope, record=record
        )
        probe = None
        if record and settings.roughness_probe_fraction > 0:
            # salt + 1: independent of the facets' numbers
            is_probed = direction_uniforms(directions, salt + 1)[0] < settings.roughness_probe_fraction
            probe = probe_roughness(rays, gbuffer, reflection_tracer, pairs, is_probed, min_slope=min_slope)
        return cls(pairs, probe, gbuffer.surface.material[:, 4], settings)

    @property
    def incident(self) -> IncidentLight:
        """Return the mean of each pair."""
        return self.pairs.incident

    def normal_gradient(self, back: ShadeGradients) -> Float64[np.ndarray, "p 3"]:
        """Return gradients by the normals from the differences of the pairs."""
        return backward_normals(self.pairs.reflected.incident, self.pairs.facets, back.around, back.specular)

    def add_roughness_gradient(self, back: ShadeGradients) -> None:
        """Add gradients by the roughness, estimated from the three rays of the points that were drawn."""
        if (probe := self.probe) is None:
            return
        ids = probe.point_ids
        slope = backward_roughness(probe, self.roughness[ids], back.around[ids], back.specular[ids])
        # unbiased: each point is drawn with this probability
        back.material[ids, 4] += slope / self.settings.roughness_probe_fraction

    def backward(self, back: ShadeGradients, grad_texels: Float64[np.ndarray, "t 3"]) -> RecordedGradients:
        """Return gradients by all that was hit on the way."""
        grad_seen = backward_mean(IncidentLight(back.visibility, back.indirect))
        return self.pairs.reflected.backward(grad_seen, grad_texels)


@dataclass(frozen=True)
class SingleRayIncidentLight:
    """One ray a point in the mirrored direction, which hits the colors of the harmonics.

    Attributes:
        incident: what came in.
        recording: recording of the rays; None where there is none, or nothing learns from them.
        grad_rgb: gradient of what came in by the display colors that were met.
    """

    incident: IncidentLight
    recording: Recording | None = None
    grad_rgb: Float64[np.ndarray, "p #c"] = field(default_factory=lambda: np.zeros((0, 1)))

    @classmethod
    def trace(
        cls,
        traced: TracedRays,
        split: DepthLayers,
        gbuffer: GBuffer,
        offset: RayOffset,
        settings: MaterialSettings,
    ) -> "SingleRayIncidentLight":
        """Trace one ray for each point of a G-buffer."""
        rays = reflected_rays(split.rays, gbuffer, offset)
        result = traced.tracer.trace(rays, record=traced.is_recorded)
        visibility = result.transmittance.astype(np.float64)
        if settings.indirect == "none":
            return cls(IncidentLight(visibility, np.zeros((len(rays), 3))))
        alpha = np.maximum(1.0 - visibility, 1e-6)[:, None]
        linear = srgb_to_linear(result.rgb_srgb / alpha)
        return cls(IncidentLight(visibility, linear * alpha), result.recording, 1.0 / srgb_derivative(linear))

    def normal_gradient(self, back: ShadeGradients) -> float:
        """Return 0: one ray says nothing of the directions beside it."""
        return 0.0

    def add_roughness_gradient(self, back: ShadeGradients) -> None:
        """Add nothing: one ray says nothing of the directions beside it."""

    def backward(self, back: ShadeGradients, grad_texels: Float64[np.ndarray, "t 3"]) -> RecordedGradients:
        """Return gradients by the harmonics that were hit."""
        if self.recording is None:
            return ()
        return (
            (self.recording, TraceGradients(rgb_srgb=(back.indirect * self.grad_rgb).astype(np.float32))),
        )

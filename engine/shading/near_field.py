"""Things that reflect among what they reflect: rooms, and scenes without an outline.

The split sum lights everything by an environment that is infinitely far, which nothing in a closed room sees.
Here only what reflects is shaded. Of a surface the share ``metallic`` is a mirror of its albedo and
roughness, the rest shows its harmonics as without materials; reflected rays see the harmonics, in their
direction, of what they meet, and the environment past everything. So matt surfaces need no light, and are
mirrored with the colors that photographs show of them.

After "EnvGS: Modeling View-Dependent Appearance with Environment Gaussian" (https://arxiv.org/abs/2412.15215),
where the surroundings are Gaussians of their own.
"""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from octasplat.engine.core.color import srgb_to_linear
from octasplat.engine.core.rays import RayBatch
from octasplat.engine.gaussians.materials import DIFFUSE_INTERREFLECTION
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.shading.deferred import DeferredShading
from octasplat.engine.shading.depth_split import DepthLayers
from octasplat.engine.shading.gbuffer import GBuffer, RayOffset
from octasplat.engine.shading.gradient_ops import srgb_derivative
from octasplat.engine.shading.incident_light import (
    PROGRESS_SALTS,
    IncidentLightModel,
    RayPairIncidentLight,
    RecordedGradients,
)
from octasplat.engine.shading.kernels.split_sum import ShadeGradients
from octasplat.engine.shading.material_settings import MaterialSettings
from octasplat.engine.shading.protocol import ShadedRays, TracedRays
from octasplat.engine.shading.reflection_rays import direction_uniforms
from octasplat.engine.shading.reflection_tracing import IncidentLight
from octasplat.engine.shading.shading_context import ShadingContext
from octasplat.engine.shading.split_sum import SurfacePoints
from octasplat.engine.trace.protocol import TraceGradients, Tracer, TraceResult

METALLIC_COLUMN = 3
MIN_REFLECTING_SHARE = 0.04
"""Share of a mirror up to which a surface sends no reflected rays."""
ALBEDO_WEIGHT = 0.05
"""Weight of half the squared difference of what is matt from its base color, in the loss."""
MATT_POWER = 8
"""Power of the matt share in that weight: mirrors, and what becomes one, learn from reflections."""
PROBED_FRACTION = 0.05
"""Of the points below that share, so many send some in a training: they may turn out to reflect."""


@dataclass(frozen=True)
class HarmonicsSeen:
    """What reflected rays saw of the harmonics.

    Attributes:
        trace: what they met.
        linear: radiance of that.
    """

    trace: TraceResult
    linear: Float64[np.ndarray, "s 3"]

    @property
    def incident(self) -> IncidentLight:
        """Return what each ray saw."""
        visibility = self.trace.transmittance.astype(np.float64)
        return IncidentLight(visibility, (1.0 - visibility)[:, None] * self.linear)

    def backward(
        self, grad_incident: IncidentLight, grad_texels: Float64[np.ndarray, "t 3"]
    ) -> RecordedGradients:
        """Return gradients by the harmonics and the alpha of what was met."""
        trace = self.trace
        assert trace.recording is not None
        slope = 1.0 / srgb_derivative(self.linear)
        grad_rgb = grad_incident.light_linear * slope  # light = alpha linear(rgb / alpha)
        alpha = np.maximum(trace.alpha.astype(np.float64), 1e-6)[:, None]
        by_alpha = grad_incident.light_linear * (self.linear - slope * trace.rgb_srgb / alpha)
        grad_transmittance = grad_incident.visibility - by_alpha.sum(axis=1)
        gradients = TraceGradients(
            rgb_srgb=grad_rgb.astype(np.float32), transmittance=grad_transmittance.astype(np.float32)
        )
        return ((trace.recording, gradients),)


@dataclass(frozen=True)
class HarmonicsTracer:
    """Trace reflected rays up to the first surface, which shows its harmonics.

    Attributes:
        tracer: built around the Gaussians.
        offset: how rays leave a surface.
    """

    tracer: Tracer
    offset: RayOffset

    def trace(self, rays: RayBatch, *, record: bool) -> HarmonicsSeen:
        """Trace reflected rays; ``record`` keeps what the backward pass needs."""
        result = self.tracer.trace(rays, record=record)
        alpha = np.maximum(result.alpha.astype(np.float64), 1e-6)[:, None]
        return HarmonicsSeen(result, srgb_to_linear(np.maximum(result.rgb_srgb / alpha, 0.0)))


@dataclass(frozen=True)
class SparseIncidentLight:
    """Incident light at some of the points of a G-buffer; the others see the environment.

    Attributes:
        inner: at these points.
        point_ids: their numbers.
        count: of all points.
    """

    inner: IncidentLightModel
    point_ids: Int64[np.ndarray, " w"]
    count: int

    @property
    def incident(self) -> IncidentLight:
        """Return what comes in at each point."""
        visibility, light = np.ones(self.count), np.zeros((self.count, 3))
        visibility[self.point_ids], light[self.point_ids] = self.inner.incident
        return IncidentLight(visibility, light)

    def normal_gradient(self, back: ShadeGradients) -> Float64[np.ndarray, "p 3"]:
        """Return gradients by the normals through what reflected rays hit."""
        gradient = np.zeros((self.count, 3))
        gradient[self.point_ids] = self.inner.normal_gradient(self._select(back))
        return gradient

    def add_roughness_gradient(self, back: ShadeGradients) -> None:
        """Add gradients by the roughness through what reflected rays meet to those of the materials."""
        some = self._select(back)
        self.inner.add_roughness_gradient(some)
        back.material[self.point_ids] = some.material

    def backward(self, back: ShadeGradients, grad_texels: Float64[np.ndarray, "t 3"]) -> RecordedGradients:
        """Return gradients by what reflected rays hit."""
        return self.inner.backward(self._select(back), grad_texels)

    def _select(self, back: ShadeGradients) -> ShadeGradients:
        return ShadeGradients(*(values[self.point_ids] for values in back))


class NearFieldShading(DeferredShading):
    """Harmonics, and mirrors that see the harmonics of what stands around them."""

    harmonics_are_shaded: ClassVar[bool] = False
    albedo_holds_light: ClassVar[bool] = True

    @classmethod
    def initial_channels(cls, settings: MaterialSettings) -> dict[str, tuple[float, ...]]:
        """Return the channels of the other model, without bounced light, which harmonics hold."""
        channels = super().initial_channels(settings)
        channels.pop(DIFFUSE_INTERREFLECTION, None)
        return channels

    def on_rebuild(self, gaussians: FlatGaussians, tracer: Tracer, *, training_progress: float) -> None:
        """Measure nothing: harmonics hold the light from all around."""

    def _reflecting(self, traced: TracedRays, gbuffer: GBuffer) -> Bool[np.ndarray, " p"]:
        """Return which points send reflected rays."""
        surface = gbuffer.surface
        reflects = surface.material[:, METALLIC_COLUMN] > MIN_REFLECTING_SHARE
        if traced.is_recorded:  # in a training
            salt = int(traced.training_progress * PROGRESS_SALTS) + 2  # other numbers than the facets'
            reflects |= direction_uniforms(surface.direction_world, salt)[0] < PROBED_FRACTION
        return reflects

    def _shaded_share(self, traced: TracedRays, gbuffer: GBuffer, ramp: float) -> Float64[np.ndarray, " p"]:
        share = np.clip(gbuffer.surface.material[:, METALLIC_COLUMN], 0.0, 1.0)
        return np.where(self._reflecting(traced, gbuffer), ramp * share, 0.0)

    def _surface_with_ambient(self, result: TraceResult, gbuffer: GBuffer) -> SurfacePoints:
        """Return the surface as a mirror: what else is there of it is in the harmonics."""
        material = gbuffer.surface.material.copy()
        material[:, METALLIC_COLUMN] = 1.0
        return replace(gbuffer.surface, material=material, ambient=np.zeros(len(material)))

    def _trace_incident(self, traced: TracedRays, split: DepthLayers, gbuffer: GBuffer) -> IncidentLightModel:
        """Trace pairs of reflected rays from what reflects."""
        point_ids = np.flatnonzero(self._reflecting(traced, gbuffer))
        reflection_tracer = HarmonicsTracer(traced.tracer, self._reflection_offset)
        inner = RayPairIncidentLight.trace(
            traced, split, gbuffer.select(point_ids), reflection_tracer, self.settings
        )
        return SparseIncidentLight(inner, point_ids, len(gbuffer.ray_ids))

    def _unshaded_part(self, traced: TracedRays, ctx: ShadingContext) -> Float32[np.ndarray, "l 3"]:
        """Return the harmonics of what does not reflect."""
        rgb = ctx.depth_layers.results.rgb_srgb.copy()
        rgb[ctx.gbuffer.ray_ids] *= (1 - ctx.share).astype(np.float32)[:, None]
        return rgb

    def _unshaded_part_backward(
        self,
        traced: TracedRays,
        shaded: ShadedRays,
        ctx: ShadingContext,
        grad_rgb: Float32[np.ndarray, "r 3"],
        grad_material: Float64[np.ndarray, "p 5"],
    ) -> Float32[np.ndarray, "l 3"]:
        """Return gradients by the harmonics, which learn the shaded colors as far as they are not seen."""
        split, ids = ctx.depth_layers, ctx.gbuffer.ray_ids
        grad_harmonics = split.expand(grad_rgb)
        difference = ctx.gbuffer.alpha[:, None] * ctx.display - split.results.rgb_srgb[ids]
        by_share = (grad_harmonics[ids] * difference).sum(axis=1)
        # surfaces are shaded as mirrors: the share of these is what metallic says here
        by_share = np.where(self._reflecting(traced, ctx.gbuffer), ctx.ramp * by_share, 0.0)
        grad_material[:, METALLIC_COLUMN] = by_share
        # so that files and relighting have a base color of what is matt: that which it shows
        material = ctx.gbuffer.surface.material
        shown = srgb_to_linear(np.clip(split.results.rgb_srgb[ids] / ctx.gbuffer.alpha[:, None], 0.0, 1.0))
        weight = ALBEDO_WEIGHT / len(grad_rgb) * (1 - ctx.share) ** MATT_POWER
        grad_material[:, :METALLIC_COLUMN] += weight[:, None] * (material[:, :METALLIC_COLUMN] - shown)
        harmonics_weight = self.settings.harmonics_weight * 2 / (3 * len(grad_rgb))
        missing = split.expand(harmonics_weight * (traced.result.rgb_srgb - shaded.rgb_srgb))[ids]
        share = ctx.share[:, None]
        grad_harmonics = grad_harmonics.copy()
        grad_harmonics[ids] = (1 - share) * grad_harmonics[ids] + share * missing
        return grad_harmonics.astype(np.float32)

    def _layer_radiance(
        self, ctx: ShadingContext, rgb_srgb: Float32[np.ndarray, "l 3"]
    ) -> Float64[np.ndarray, "p 3"]:
        shown = np.maximum(rgb_srgb[ctx.gbuffer.ray_ids] / ctx.gbuffer.alpha[:, None], 0.0)
        return srgb_to_linear(shown)

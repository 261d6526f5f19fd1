"""The recipe of Reflective Gaussian Splatting, as its published code has it, for comparisons.

"Reflective Gaussian Splatting" (https://arxiv.org/abs/2412.19282). Other than octasplat's own model: the
diffuse part is a color of its own from the harmonics, the environment stays in [0, 1], everything is in
display values, visibility is yes or no, and materials start over when deferred shading begins. Not the same
as there: the first stage shades pixels, not Gaussians, and visibility comes from the Gaussians, not a mesh.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

import numpy as np
from jaxtyping import Float32, Float64

from octasplat.engine.core.color import linear_to_srgb, srgb_to_linear
from octasplat.engine.gaussians.materials import (
    DIFFUSE_INTERREFLECTION,
    MATERIAL_WIDTHS,
    METALLIC,
    ROUGHNESS,
)
from octasplat.engine.gaussians.model import SH_C0, FlatGaussians
from octasplat.engine.shading.deferred import DeferredShading
from octasplat.engine.shading.depth_split import DepthLayers, single_layer
from octasplat.engine.shading.gbuffer import GBuffer, reflected_rays
from octasplat.engine.shading.incident_light import IncidentLightModel, SingleRayIncidentLight
from octasplat.engine.shading.material_settings import MaterialSettings
from octasplat.engine.shading.protocol import ShadedRays, ShadingStep, TracedRays
from octasplat.engine.shading.reflection_tracing import IncidentLight
from octasplat.engine.shading.shading_context import ShadingContext
from octasplat.engine.shading.split_sum import SurfacePoints
from octasplat.engine.trace.protocol import TraceResult

DEFERRED_FROM = 0.36
"""Share of the training after which deferred shading begins, with materials as at first."""
DEFERRED_MATERIAL = (0.5, 0.5, 0.5, 0.01, 0.1)
"""Albedo, metallic and roughness that deferred shading begins with."""
RAY_LENGTH = 10.0
"""World units within which something may hide the environment."""
HIDDEN_TRANSMITTANCE = 0.5
"""Transmittance below which the environment counts as hidden."""
PROPAGATED_OPACITY = 0.9
"""Least opacity of all Gaussians after a propagation."""
PROPAGATION_GROWTH = 1.5
"""Factor on the scales of Gaussians that reflect, in a propagation."""
REFLECTIVE_METALLIC, REFLECTIVE_ROUGHNESS = 0.02, 0.01
"""Least metallic and most roughness of Gaussians that count as reflecting in a propagation."""
PROPAGATION_NOISE = 0.4
"""Largest change of the other Gaussians' colors in a propagation, display values."""


class RefGaussianShading(DeferredShading):
    """Deferred shading as in the code of Reflective Gaussian Splatting."""

    harmonics_are_shaded: ClassVar[bool] = False
    matt_color_is_harmonics: ClassVar[bool] = True

    def __init__(self, settings: MaterialSettings, *, extent_world: float, one_sided: bool = False) -> None:
        super().__init__(settings, extent_world=extent_world, one_sided=one_sided)
        self._has_restarted = np.zeros(1, bool)

    @classmethod
    def has_hdr_light(cls, settings: MaterialSettings) -> bool:
        """Return False: the environment stays in [0, 1]."""
        return False

    @classmethod
    def prunes_unseen(cls, settings: MaterialSettings) -> bool:
        """Return False: Gaussians that lie in no photograph stay."""
        return False

    @classmethod
    def initial_channels(cls, settings: MaterialSettings) -> dict[str, tuple[float, ...]]:
        """Return the channels of the other model, without bounced light."""
        channels = super().initial_channels(settings)
        channels.pop(DIFFUSE_INTERREFLECTION, None)
        return channels

    @staticmethod
    def propagate_normals(
        gaussians: FlatGaussians, rng: np.random.Generator, *, training_progress: float
    ) -> None:
        """Raise all opacities, enlarge what reflects, and disturb the colors of the rest, in place."""
        raised = np.float32(np.log(PROPAGATED_OPACITY / (1 - PROPAGATED_OPACITY)))
        gaussians.opacity_logits[:] = np.maximum(gaussians.opacity_logits, raised)
        is_metallic = gaussians.channels[METALLIC][:, 0] >= REFLECTIVE_METALLIC
        is_smooth = gaussians.channels[ROUGHNESS][:, 0] <= REFLECTIVE_ROUGHNESS
        gaussians.log_scales[is_metallic & is_smooth] += np.float32(np.log(PROPAGATION_GROWTH))
        if is_deferred(training_progress):
            diffuse = np.flatnonzero(~is_metallic)
            noise = rng.uniform(-PROPAGATION_NOISE, PROPAGATION_NOISE, (len(diffuse), 3)) / SH_C0
            gaussians.sh[diffuse, 0] += noise.astype(np.float32)

    def step(self, update: ShadingStep) -> None:
        """Step as the other model, but start materials and environment over when deferred shading begins."""
        if is_deferred(update.training_progress) and not self._has_restarted[0]:
            self._reset_materials(update.gaussians)
            return  # gradients of the former materials are of no use
        super().step(update)

    def _reset_materials(self, gaussians: FlatGaussians) -> None:
        first = 0
        for name, width in MATERIAL_WIDTHS.items():
            gaussians.channels[name][:] = DEFERRED_MATERIAL[first : first + width]
            self._features[:, first : first + width] = DEFERRED_MATERIAL[first : first + width]
            first += width
        self.light.reset()
        self._has_restarted[:] = True

    def state(self) -> dict[str, np.ndarray]:
        """Return the state of the other model, and whether materials have started over."""
        return {**super().state(), "materials.started_over": self._has_restarted}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Take the state that :meth:`state` returned."""
        super().restore(state)
        self._has_restarted = state["materials.started_over"].copy()

    def relight_with(self, radiance_linear: Float32[np.ndarray, "h w 3"]) -> None:
        """Take an environment of linear radiance in display values, in which all is computed here."""
        super().relight_with(linear_to_srgb(radiance_linear))

    def _split_into_layers(self, traced: TracedRays) -> DepthLayers:
        return single_layer(traced.rays, traced.result)

    def _surface_with_ambient(self, result: TraceResult, gbuffer: GBuffer) -> SurfacePoints:
        """Return the surface without ambient light, as the diffuse part is a color of its own."""
        return replace(gbuffer.surface, ambient=np.zeros(len(gbuffer.ray_ids)))

    def _trace_incident(self, traced: TracedRays, split: DepthLayers, gbuffer: GBuffer) -> IncidentLightModel:
        """Trace one mirrored ray a point, which hits harmonics in display values or nothing."""
        rays = reflected_rays(split.rays, gbuffer, self._reflection_offset)
        result = traced.tracer.trace(rays.with_t_max(RAY_LENGTH), record=traced.is_recorded)
        # yes or no, as the published code traces a mesh
        visibility = (result.transmittance > HIDDEN_TRANSMITTANCE).astype(np.float64)
        if self.settings.indirect == "none":
            return SingleRayIncidentLight(IncidentLight(visibility, np.zeros((len(rays), 3))))
        hidden = 1.0 - visibility[:, None]
        incident = IncidentLight(visibility, hidden * result.rgb_srgb)
        return SingleRayIncidentLight(incident, result.recording, hidden)

    def _to_display(self, linear: Float64[np.ndarray, "p 3"]) -> Float64[np.ndarray, "p 3"]:
        return linear

    def _display_backward(
        self, linear: Float64[np.ndarray, "p 3"], grad_display: Float64[np.ndarray, "p 3"]
    ) -> Float64[np.ndarray, "p 3"]:
        return grad_display

    def _unshaded_part(self, traced: TracedRays, ctx: ShadingContext) -> Float32[np.ndarray, "l 3"]:
        """Return what the harmonics add: the diffuse part once deferred shading has begun."""
        rgb = super()._unshaded_part(traced, ctx)
        if is_deferred(traced.training_progress):
            ray_ids = ctx.gbuffer.ray_ids
            rgb[ray_ids] = (1 - ctx.surface.material[:, 3:4]) * traced.result.rgb_srgb[ray_ids]
        return rgb

    def _unshaded_part_backward(
        self,
        traced: TracedRays,
        shaded: ShadedRays,
        ctx: ShadingContext,
        grad_rgb: Float32[np.ndarray, "r 3"],
        grad_material: Float64[np.ndarray, "p 5"],
    ) -> Float32[np.ndarray, "l 3"]:
        if not is_deferred(traced.training_progress):
            return super()._unshaded_part_backward(traced, shaded, ctx, grad_rgb, grad_material)
        ray_ids = ctx.gbuffer.ray_ids
        grad_harmonics = grad_rgb * np.float32(1 - ctx.ramp)
        grad_harmonics[ray_ids] = grad_rgb[ray_ids] * (1 - ctx.surface.material[:, 3:4])
        grad_material[:, 3] -= (grad_rgb[ray_ids] * traced.result.rgb_srgb[ray_ids]).sum(axis=1)
        return grad_harmonics

    def _layer_radiance(
        self, ctx: ShadingContext, rgb_srgb: Float32[np.ndarray, "l 3"]
    ) -> Float64[np.ndarray, "p 3"]:
        return srgb_to_linear(rgb_srgb[ctx.gbuffer.ray_ids] / ctx.gbuffer.alpha[:, None])


def is_deferred(training_progress: float) -> bool:
    """Return whether deferred shading has begun."""
    return training_progress >= DEFERRED_FROM

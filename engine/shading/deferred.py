"""Deferred shading: materials and normals are blended along each ray, then shaded once by the split sum.

Each shaded point sends rays along reflected directions through the same Gaussians: their transmittance says
how much of the environment is visible there, and what they hit is shaded too.

After "Reflective Gaussian Splatting" (https://arxiv.org/abs/2412.19282), whose visibility comes from a mesh;
:mod:`octasplat.engine.shading.ref_gaussian` does as the code of that paper.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

import numpy as np
from jaxtyping import Float32, Float64, Int64

from octasplat.engine.core.color import linear_to_srgb
from octasplat.engine.core.rays import RayBatch
from octasplat.engine.gaussians.channels import stack_channels
from octasplat.engine.gaussians.materials import AMBIENT, DIFFUSE_INTERREFLECTION, MATERIAL_WIDTHS
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.shading.ambient_occlusion import UNOCCLUDED, ambient_visibility, diffuse_interreflection
from octasplat.engine.shading.depth_split import DepthLayers, single_layer, split_by_depth
from octasplat.engine.shading.environment_frame import environment_frame
from octasplat.engine.shading.environment_light import EnvironmentLight
from octasplat.engine.shading.gbuffer import GBuffer, RayOffset, backward_gbuffer, build_gbuffer
from octasplat.engine.shading.geometry_losses import add_surface_gradients, normal_spread_gradient
from octasplat.engine.shading.gradient_ops import clip_gradients, srgb_derivative
from octasplat.engine.shading.incident_light import (
    IncidentLightModel,
    RayPairIncidentLight,
    SingleRayIncidentLight,
)
from octasplat.engine.shading.material_settings import (
    ENVIRONMENT_RATE,
    INITIAL_ALBEDO,
    INITIAL_METALLIC,
    INITIAL_ROUGHNESS,
    MaterialSettings,
)
from octasplat.engine.shading.normal_propagation import propagate_normals
from octasplat.engine.shading.protocol import (
    ShadedRayGradients,
    ShadedRays,
    ShadingGradients,
    ShadingStep,
    TracedRays,
    concatenate_shaded,
)
from octasplat.engine.shading.reflection_tracing import ReflectionTracer
from octasplat.engine.shading.shading_context import ShadingContext
from octasplat.engine.shading.split_sum import SurfacePoints, shade, shade_backward
from octasplat.engine.trace.protocol import TraceGradients, Tracer, TraceResult

MEASURED_RAYS_AT_ONCE = 1 << 14
"""Whole packets of rays."""
AMBIENT_COLUMN = 5
INTERREFLECTION_COLUMNS = slice(6, 9)


class DeferredShading:
    """Compute colors from materials, normals and an environment; follows the protocol of shading models.

    The materials themselves are channels of the Gaussians, stepped by their optimiser. Another recipe is a
    subclass that overrides the steps in which it differs.

    Args:
        settings: how materials and light are learnt.
        extent_world: the scene's extent.
        one_sided: whether normals point outwards, so that only one side of each Gaussian is lit.

    Attributes:
        harmonics_are_shaded: whether the harmonics learn the shaded colors, so that they can be computed
            from materials and light.
        albedo_holds_light: whether the base color of what is matt is the color that photographs show.
        matt_color_is_harmonics: whether what is matt has its color from the harmonics, and none from the base
            color.
        light: the environment.
        frame: its right, up and forward in the world, as rows.
    """

    name = "materials"
    harmonics_are_shaded: ClassVar[bool] = True
    albedo_holds_light: ClassVar[bool] = False
    matt_color_is_harmonics: ClassVar[bool] = False

    def __init__(self, settings: MaterialSettings, *, extent_world: float, one_sided: bool = False) -> None:
        self.settings = settings
        self._is_one_sided = one_sided
        self.light = EnvironmentLight(
            settings.environment_height,
            hdr=self.has_hdr_light(settings),
            white_weight=settings.white_weight,
            smoothness_weight=settings.environment_smoothness_weight,
        )
        self.frame = environment_frame(np.array(settings.up_world, np.float64))
        self._ray_bias_world = settings.ray_bias * extent_world
        self._reflection_offset = RayOffset(
            self._ray_bias_world, settings.backface_cull_distance * extent_world
        )
        self._hemisphere_offset = self._reflection_offset._replace(bias_world=2 * self._ray_bias_world)
        self._occlusion_turn = np.array([-1.0, -1.0])  # no turn yet: no progress is negative
        self._features: Float32[np.ndarray, "n f"] = np.empty((0, 5), np.float32)

    # --- what a recipe says of the training around it ---

    @classmethod
    def has_hdr_light(cls, settings: MaterialSettings) -> bool:
        """Return whether the environment may be brighter than 1."""
        return settings.hdr

    @classmethod
    def prunes_unseen(cls, settings: MaterialSettings) -> bool:
        """Return whether Gaussians that lie in no photograph are removed."""
        return settings.prune_unseen

    @classmethod
    def initial_channels(cls, settings: MaterialSettings) -> dict[str, tuple[float, ...]]:
        """Return the channels that each Gaussian begins with, and their values."""
        values = (INITIAL_ALBEDO,) * 3, (INITIAL_METALLIC,), (INITIAL_ROUGHNESS,)
        channels = dict(zip(MATERIAL_WIDTHS, values, strict=True)) | {AMBIENT: (1.0,)}
        if settings.diffuse_interreflection:
            channels[DIFFUSE_INTERREFLECTION] = (0.0,) * 3
        return channels

    @staticmethod
    def propagate_normals(
        gaussians: FlatGaussians, rng: np.random.Generator, *, training_progress: float
    ) -> None:
        """Hand normals on to neighbouring Gaussians, in place."""
        propagate_normals(gaussians)

    # --- the protocol of shading models ---

    def features(self, gaussians: FlatGaussians) -> Float32[np.ndarray, "n f"]:
        """Return the materials side by side, then ambient visibility and interreflection where known."""
        names = [
            name
            for name in (*MATERIAL_WIDTHS, AMBIENT, DIFFUSE_INTERREFLECTION)
            if name in gaussians.channels
        ]
        self._features = stack_channels(gaussians.channels, names)
        return self._features

    def on_rebuild(self, gaussians: FlatGaussians, tracer: Tracer, *, training_progress: float) -> None:
        """Measure ambient visibility and interreflection of some of the Gaussians, by turns."""
        settings = self.settings
        if (
            not settings.ambient_occlusion
            or training_progress < settings.secondary_from
            or AMBIENT not in gaussians.channels
        ):
            return
        parts = settings.ambient_occlusion_rebuilds
        if training_progress != self._occlusion_turn[1]:  # a resumed training rebuilds where it stopped
            self._occlusion_turn = np.array([self._occlusion_turn[0] + 1, training_progress])
        ids = np.arange(int(self._occlusion_turn[0]) % parts, len(gaussians), parts)
        self.measure_diffuse_interreflection(
            gaussians, ids, self.measure_ambient_occlusion(gaussians, ids, tracer), tracer
        )

    def measure_ambient_occlusion(
        self, gaussians: FlatGaussians, ids: Int64[np.ndarray, " u"], tracer: Tracer
    ) -> Float32[np.ndarray, " u"]:
        """Measure the ambient visibility of Gaussians ``ids``.

        Returns:
            Their open sides, for :meth:`measure_diffuse_interreflection`.
        """
        rays = self.settings.ambient_occlusion_rays
        visible, side = ambient_visibility(
            gaussians, ids, tracer, rays=rays, offset=self._hemisphere_offset, one_sided=self._is_one_sided
        )
        gaussians.channels[AMBIENT][ids, 0] = visible
        self._features[ids, AMBIENT_COLUMN] = visible
        return side

    def measure_diffuse_interreflection(
        self,
        gaussians: FlatGaussians,
        ids: Int64[np.ndarray, " u"],
        open_side: Float32[np.ndarray, " u"],
        tracer: Tracer,
    ) -> None:
        """Measure the light that others send to the open sides of Gaussians with such a channel."""
        if DIFFUSE_INTERREFLECTION not in gaussians.channels:
            return
        dim = gaussians.channels[AMBIENT][ids, 0] < UNOCCLUDED
        bounced = np.zeros((len(ids), 3), np.float32)
        bounced[dim] = diffuse_interreflection(
            gaussians, ids[dim], open_side[dim], lambda rays: self._outgoing_radiance(rays, tracer),
            rays=self.settings.ambient_occlusion_rays, offset=self._hemisphere_offset,
        )  # fmt: skip
        gaussians.channels[DIFFUSE_INTERREFLECTION][ids] = bounced
        self._features[ids, INTERREFLECTION_COLUMNS] = bounced

    def _outgoing_radiance(self, rays: RayBatch, tracer: Tracer) -> Float64[np.ndarray, "r 3"]:
        """Return the radiance of what rays hit times its alpha, lit by the environment alone.

        So a Gaussian's bounced light does not depend on that of others, and not on whose turn it was.
        """
        result = tracer.trace(rays)
        gbuffer = build_gbuffer(rays, result)
        surface = self._surface_with_ambient(result, gbuffer)
        no_bounces = np.zeros((len(gbuffer.ray_ids), 3))
        # the environment through the mean visibility, no reflected rays
        surface = replace(surface, visibility=surface.ambient, bounced_linear=no_bounces)
        radiance = np.zeros((len(rays), 3))
        radiance[gbuffer.ray_ids] = gbuffer.alpha[:, None] * shade(surface, self.light.levels, self.frame)
        return radiance

    def shade(self, traced: TracedRays) -> ShadedRays:
        """Return display colors, shaded as far as the ramp from the harmonics to that has come.

        Of many rays from which nothing is learnt some are shaded at a time: each takes some 20 KB with those
        that it sends on.
        """
        if traced.is_recorded or len(traced.rays) <= MEASURED_RAYS_AT_ONCE:
            return self._shade_together(traced)
        return concatenate_shaded(
            replace(self._shade_together(part), ctx=None) for part in traced.split(MEASURED_RAYS_AT_ONCE)
        )

    def _shade_together(self, traced: TracedRays) -> ShadedRays:
        ramp, result = self.settings.shading_ramp(traced.training_progress), traced.result
        if ramp == 0:
            return ShadedRays(result.rgb_srgb, result.transmittance)
        split = self._split_into_layers(traced)
        gbuffer = build_gbuffer(split.rays, split.results)
        surface, incident = self._surface_with_ambient(split.results, gbuffer), None
        if self.settings.visibility and traced.training_progress >= self.settings.secondary_from:
            incident = self._trace_incident(traced, split, gbuffer)
            visibility, indirect = incident.incident
            surface = replace(surface, visibility=visibility, indirect_linear=indirect)
        linear = shade(surface, self.light.levels, self.frame)
        display = self._to_display(linear)
        context = ShadingContext(
            depth_layers=split,
            gbuffer=gbuffer,
            surface=surface,
            linear=linear,
            display=display,
            incident=incident,
            ramp=ramp,
            share=self._shaded_share(traced, gbuffer, ramp),
        )
        rgb = self._unshaded_part(traced, context)
        rgb[gbuffer.ray_ids] += ((context.share * gbuffer.alpha)[:, None] * display).astype(np.float32)
        # only finished pictures have layers
        layers = {} if traced.view is not None else context.named_layers(self._layer_radiance(context, rgb))
        return ShadedRays(split.sum_layers(rgb), result.transmittance, context, layers)

    def backward(self, traced: TracedRays, shaded: ShadedRays, grad: ShadedRayGradients) -> ShadingGradients:
        """Return gradients by what was blended, by what reflected rays hit, and by the environment."""
        settings, ctx = self.settings, shaded.ctx
        if not isinstance(ctx, ShadingContext):
            return ShadingGradients(TraceGradients(grad.rgb_srgb, grad.transmittance))
        split, gbuffer, incident = ctx.depth_layers, ctx.gbuffer, ctx.incident
        grad_rgb = grad.rgb_srgb
        # --- regularisers of the rays' geometry and materials ---
        # dL/dT is -dL/dalpha
        grad_alpha = -grad.transmittance.astype(np.float64)
        grad_normal = np.zeros((len(grad_rgb), 3))
        grad_features = np.zeros((len(grad_rgb), split.results.features.shape[1]))
        grad_depth = np.zeros(len(grad_rgb))
        add_surface_gradients(traced, settings, grad_features, grad_alpha, grad_normal, grad_depth)
        grad_alpha, grad_normal = split.expand(grad_alpha), split.expand(grad_normal)
        grad_features, grad_depth = split.expand(grad_features), split.expand(grad_depth)
        # --- the split sum at the shaded points ---
        grad_display = split.expand(grad_rgb)[gbuffer.ray_ids] * ctx.share[:, None].astype(np.float32)
        grad_alpha[gbuffer.ray_ids] += (grad_display * ctx.display).sum(axis=1)  # rgb = share alpha display
        grad_linear = self._display_backward(ctx.linear, grad_display * gbuffer.alpha[:, None])
        blur = settings.blur_roughness(traced.training_progress)
        back = shade_backward(ctx.surface, self.light.levels, self.frame, grad_linear, blur=blur)
        surface_normal = back.normal
        if settings.reflected_gradient:
            grad_direction = back.reflected + (0.0 if incident is None else incident.normal_gradient(back))
            surface_normal = surface_normal + clip_gradients(grad_direction, settings.normal_gradient_clip)
        if incident is not None:
            incident.add_roughness_gradient(back)
        grad_harmonics = self._unshaded_part_backward(traced, shaded, ctx, grad_rgb, back.material)
        # --- what was blended along the rays ---
        backward_gbuffer(gbuffer, back.material, surface_normal, grad_features, grad_alpha, grad_normal)
        normal_spread_gradient(gbuffer, settings.normal_weight / len(grad_rgb), grad_alpha, grad_normal)
        grad_texels = back.sum_texels(len(self.light.levels.texels))
        reflected = () if incident is None else incident.backward(back, grad_texels)
        grad_layers = TraceGradients(
            rgb_srgb=grad_harmonics.astype(np.float32),
            transmittance=(-grad_alpha).astype(np.float32),
            depth_sum=grad_depth.astype(np.float32),
            normal_world=grad_normal.astype(np.float32),
            features=grad_features.astype(np.float32),
        )
        grad_trace, fronts = split.backward(grad_layers)
        return ShadingGradients(grad_trace, fronts + reflected, {"materials.texels": grad_texels})

    def step(self, update: ShadingStep) -> None:
        """Step the environment, and take over the materials as the optimiser of the Gaussians left them."""
        ids, first = update.gradients.ids, 0
        for name, width in MATERIAL_WIDTHS.items():
            self._features[ids, first : first + width] = update.gaussians.channels[name][ids]
            first += width
        if "materials.texels" in update.parameters:
            rate = ENVIRONMENT_RATE * 0.1**update.training_progress  # falls to a tenth by the end
            self.light.step(update.parameters["materials.texels"], rate=rate)

    def state(self) -> dict[str, np.ndarray]:
        """Return the environment with its optimiser, and whose turn it is to be measured."""
        light = {f"materials.{name}": value for name, value in self.light.state().items()}
        return {**light, "materials.turn": self._occlusion_turn}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Take the state that :meth:`state` returned."""
        own = {name.removeprefix("materials."): value for name, value in state.items()}
        self._occlusion_turn = own["turn"].copy()
        self.light.restore(own)

    # --- the steps in which recipes differ ---

    def relight_with(self, radiance_linear: Float32[np.ndarray, "h w 3"]) -> None:
        """Take an environment of linear radiance instead of the learnt one."""
        self.light.set_radiance(radiance_linear)

    def _shaded_share(self, traced: TracedRays, gbuffer: GBuffer, ramp: float) -> Float64[np.ndarray, " p"]:
        """Return the share of each point that is shaded, not taken from the harmonics."""
        return np.full(len(gbuffer.ray_ids), ramp)

    def _split_into_layers(self, traced: TracedRays) -> DepthLayers:
        """Return the depth layers of the rays, each to be shaded separately."""
        if self.settings.depth_split == 0:
            return single_layer(traced.rays, traced.result)
        return split_by_depth(
            traced.rays,
            traced.result,
            traced.tracer,
            min_separation_world=self.settings.depth_split * self._ray_bias_world,
            record_for_backward=traced.is_recorded,
        )

    def _surface_with_ambient(self, result: TraceResult, gbuffer: GBuffer) -> SurfacePoints:
        """Return the surface of a G-buffer with the light from all around, to which no gradient goes."""
        surface = gbuffer.surface
        if not self.settings.ambient_occlusion or result.features.shape[1] <= AMBIENT_COLUMN:
            return surface
        features = result.features[gbuffer.ray_ids].astype(np.float64) / gbuffer.alpha[:, None]
        surface = replace(surface, ambient=features[:, AMBIENT_COLUMN])
        if features.shape[1] < INTERREFLECTION_COLUMNS.stop:
            return surface
        return replace(surface, bounced_linear=features[:, INTERREFLECTION_COLUMNS])

    def _trace_incident(self, traced: TracedRays, split: DepthLayers, gbuffer: GBuffer) -> IncidentLightModel:
        """Trace the light that comes in along reflected directions."""
        settings = self.settings
        if settings.indirect != "shaded":
            return SingleRayIncidentLight.trace(traced, split, gbuffer, self._reflection_offset, settings)
        reflection_tracer = ReflectionTracer(
            tracer=traced.tracer,
            light=self.light.levels,
            frame=self.frame,
            with_ambient=self._surface_with_ambient,
            max_bounces=settings.max_bounces,
            offset=self._reflection_offset,
            min_separation_world=settings.depth_split * self._ray_bias_world,
        )
        return RayPairIncidentLight.trace(traced, split, gbuffer, reflection_tracer, settings)

    def _to_display(self, linear: Float64[np.ndarray, "p 3"]) -> Float64[np.ndarray, "p 3"]:
        """Return the colors with which radiance is shown."""
        return linear_to_srgb(np.minimum(linear, 1.0))

    def _display_backward(
        self, linear: Float64[np.ndarray, "p 3"], grad_display: Float64[np.ndarray, "p 3"]
    ) -> Float64[np.ndarray, "p 3"]:
        """Return gradients by radiance from those by the colors with which it is shown."""
        grad_linear = grad_display * srgb_derivative(linear)
        grad_linear[(linear >= 1) & (grad_linear < 0)] = 0.0  # no photograph is whiter than white
        return grad_linear

    def _unshaded_part(self, traced: TracedRays, ctx: ShadingContext) -> Float32[np.ndarray, "l 3"]:
        """Return what the harmonics add to the colors of each layer."""
        return ctx.depth_layers.results.rgb_srgb * np.float32(1 - ctx.ramp)

    def _unshaded_part_backward(
        self,
        traced: TracedRays,
        shaded: ShadedRays,
        ctx: ShadingContext,
        grad_rgb: Float32[np.ndarray, "r 3"],
        grad_material: Float64[np.ndarray, "p 5"],
    ) -> Float32[np.ndarray, "l 3"]:
        """Return gradients by the colors of the harmonics; those by materials are added to ``grad_material``.

        Once the harmonics add nothing any more, they learn the shaded colors.
        """
        if ctx.ramp < 1:
            return ctx.depth_layers.expand(grad_rgb * np.float32(1 - ctx.ramp))
        weight = np.float32(self.settings.harmonics_weight * 2 / (3 * len(grad_rgb)))
        return ctx.depth_layers.expand(weight * (traced.result.rgb_srgb - shaded.rgb_srgb))

    def _layer_radiance(
        self, ctx: ShadingContext, rgb_srgb: Float32[np.ndarray, "l 3"]
    ) -> Float64[np.ndarray, "p 3"]:
        """Return the radiance of the shaded points that a finished picture of ``rgb_srgb`` shows."""
        return ctx.linear

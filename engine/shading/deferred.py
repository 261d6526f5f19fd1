"""Deferred shading: materials and normals are blended along each ray, then shaded once by the split sum.

A share of the pixels sends a ray along the reflected direction through the same Gaussians: its transmittance
says how much of the environment is seen there, and what it meets is shaded too.

After "Reflective Gaussian Splatting" (https://arxiv.org/abs/2412.19282), whose visibility comes from a mesh.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32, Float64, Int64

from octasplat.engine.core.color import linear_to_srgb, srgb_to_linear
from octasplat.engine.core.rays import RayBatch
from octasplat.engine.gaussians.channels import stack_channels
from octasplat.engine.gaussians.materials import AMBIENT, DIFFUSE_INTERREFLECTION, MATERIAL_WIDTHS
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.shading.ambient_occlusion import UNOCCLUDED, ambient_visibility, diffuse_interreflection
from octasplat.engine.shading.depth_split import DepthSplit, no_split, split_by_depth
from octasplat.engine.shading.environment_frame import environment_frame
from octasplat.engine.shading.environment_light import EnvironmentLight
from octasplat.engine.shading.gbuffer import GBuffer, RayOffset, backward_gbuffer, build_gbuffer
from octasplat.engine.shading.geometry_losses import add_patch_gradients, normal_spread_gradient
from octasplat.engine.shading.gradient_ops import clip_gradients, srgb_derivative
from octasplat.engine.shading.incident_light import (
    IncidentLightModel,
    RayPairIncidentLight,
    SingleRayIncidentLight,
)
from octasplat.engine.shading.material_settings import (
    ENVIRONMENT_RATE,
    REF_GAUSSIAN_MATERIAL,
    MaterialSettings,
)
from octasplat.engine.shading.protocol import ShadedRays, ShadingGradients, TracedRays
from octasplat.engine.shading.reflection_tracing import ReflectionTracer
from octasplat.engine.shading.split_sum import SurfacePoints, shade, shade_backward
from octasplat.engine.trace.protocol import GaussianGradients, TraceGradients, Tracer, TraceResult

AMBIENT_COLUMN = 5
INTERREFLECTION_COLUMNS = slice(6, 9)


@dataclass(frozen=True)
class _ShadingContext:
    depth_split: DepthSplit
    gbuffer: GBuffer
    surface: SurfacePoints
    linear: Float64[np.ndarray, "p 3"]
    display: Float64[np.ndarray, "p 3"]
    incident: IncidentLightModel | None
    ramp: float


class DeferredShading:
    """Materials, normals and an environment make the colours; follows the protocol of shading models.

    The materials themselves are channels of the Gaussians, stepped by their optimiser.

    Args:
        settings: how they are learnt.
        extent_world: the scene's extent.
        one_sided: whether normals point outwards, so that only one side of each Gaussian is lit.

    Attributes:
        light: the environment.
        frame: its right, up and forward in the world, as rows.
    """

    name = "materials"

    def __init__(self, settings: MaterialSettings, *, extent_world: float, one_sided: bool = False) -> None:
        self.settings = settings
        self._is_one_sided = one_sided
        self.light = EnvironmentLight(
            settings.environment_height,
            hdr=settings.hdr and settings.recipe != "ref_gaussian",
            white_weight=settings.white_weight,
            smoothness_weight=settings.environment_smoothness_weight,
        )
        self.frame = environment_frame(np.array(settings.up_world, np.float64))
        self._ray_bias = settings.ray_bias * extent_world
        self._reflection_offset = RayOffset(self._ray_bias, settings.backface_cull_distance * extent_world)
        self._hemisphere_offset = self._reflection_offset._replace(bias_world=2 * self._ray_bias)
        self._has_restarted = np.zeros(1, bool)
        self._occlusion_turn = np.array([-1.0, -1.0])
        self._features: Float32[np.ndarray, "n f"] = np.empty((0, 5), np.float32)

    def features(self, gaussians: FlatGaussians) -> Float32[np.ndarray, "n f"]:
        """The materials side by side, and what reaches a Gaussian from all around where it is known."""
        names = [
            name
            for name in (*MATERIAL_WIDTHS, AMBIENT, DIFFUSE_INTERREFLECTION)
            if name in gaussians.channels
        ]
        self._features = stack_channels(gaussians.channels, names)
        return self._features

    def on_rebuild(self, gaussians: FlatGaussians, tracer: Tracer, *, training_progress: float) -> None:
        """Measure what reaches some of the Gaussians from all around, by turns."""
        settings = self.settings
        if (
            not settings.ambient_occlusion
            or training_progress < settings.secondary_from
            or AMBIENT not in gaussians.channels
        ):
            return
        parts = settings.ambient_occlusion_rebuilds
        if (
            training_progress != self._occlusion_turn[1]
        ):  # a training that goes on settles once more where it stopped
            self._occlusion_turn = np.array([self._occlusion_turn[0] + 1, training_progress])
        ids = np.arange(int(self._occlusion_turn[0]) % parts, len(gaussians), parts)
        self.measure_diffuse_interreflection(
            gaussians, ids, self.measure_ambient_occlusion(gaussians, ids, tracer), tracer
        )

    def measure_ambient_occlusion(
        self, gaussians: FlatGaussians, ids: Int64[np.ndarray, " u"], tracer: Tracer
    ) -> Float32[np.ndarray, " u"]:
        """Measure the ambient visibility of Gaussians.

        Returns their open sides, for :meth:`measure_diffuse_interreflection`.
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
        """Find the light that others send to the open sides of Gaussians, if the scene has room for it."""
        if DIFFUSE_INTERREFLECTION not in gaussians.channels:
            return
        dim = gaussians.channels[AMBIENT][ids, 0] < UNOCCLUDED
        bounced = np.zeros((len(ids), 3), np.float32)
        bounced[dim] = diffuse_interreflection(
            gaussians, ids[dim], open_side[dim], lambda fan: self._outgoing_radiance(fan, tracer),
            rays=self.settings.ambient_occlusion_rays, offset=self._hemisphere_offset,
        )  # fmt: skip
        gaussians.channels[DIFFUSE_INTERREFLECTION][ids] = bounced
        self._features[ids, INTERREFLECTION_COLUMNS] = bounced

    def _outgoing_radiance(self, rays: RayBatch, tracer: Tracer) -> Float64[np.ndarray, "r 3"]:
        """What rays meet, times the share of it that hides the rest; lit by the environment alone.

        So a Gaussian's bounced light does not depend on that of others, and not on whose turn it was.
        """
        seen = tracer.trace(rays)
        buffer = build_gbuffer(rays, seen)
        surface = self._surface_with_ambient(seen, buffer)
        out = np.zeros((len(rays), 3))
        surface = replace(
            surface, visibility=surface.ambient, bounced_linear=np.zeros((len(buffer.ray_ids), 3))
        )
        linear = shade(surface, self.light.levels, self.frame)
        out[buffer.ray_ids] = buffer.alpha[:, None] * linear
        return out

    def shade(self, traced: TracedRays) -> ShadedRays:
        """Display colours, shaded as far as the training has handed over to that."""
        share = self.settings.shading_ramp(traced.training_progress)
        seen = traced.result
        if share == 0:
            return ShadedRays(seen.rgb_srgb, seen.transmittance)
        parted = self._split_by_depth(traced)
        buffer = build_gbuffer(parted.rays, parted.results)
        surface, incoming = self._surface_with_ambient(parted.results, buffer), None
        if self.settings.visibility and traced.training_progress >= self.settings.secondary_from:
            incoming = self._trace_incident(traced, parted, buffer)
            visibility, indirect = incoming.incident
            surface = replace(surface, visibility=visibility, indirect_linear=indirect)
        linear = shade(surface, self.light.levels, self.frame)
        rgb = parted.results.rgb_srgb * np.float32(1 - share)
        if self.settings.recipe == "ref_gaussian":
            shown = linear
            if self.settings.is_ref_gaussian_deferred(traced.training_progress):
                matt = 1 - surface.material[:, 3:4]
                rgb[buffer.ray_ids] = matt * seen.rgb_srgb[buffer.ray_ids]
        else:
            shown = linear_to_srgb(np.minimum(linear, 1.0))
        rgb[buffer.ray_ids] += (share * buffer.alpha[:, None] * shown).astype(np.float32)
        kept = _ShadingContext(parted, buffer, surface, linear, shown, incoming, share)
        layers = {} if traced.view is not None else self._layers(parted, rgb, buffer, surface, linear)
        return ShadedRays(parted.sum_layers(rgb), seen.transmittance, kept, layers)

    def _split_by_depth(self, traced: TracedRays) -> DepthSplit:
        """The surfaces that are shaded each by itself."""
        if self.settings.depth_split == 0 or self.settings.recipe == "ref_gaussian":
            return no_split(traced.rays, traced.result)
        apart, record = self.settings.depth_split * self._ray_bias, traced.view is not None
        return split_by_depth(
            traced.rays, traced.result, traced.tracer, min_separation_world=apart, record=record
        )

    def backward(
        self,
        traced: TracedRays,
        shaded: ShadedRays,
        by_rgb: Float32[np.ndarray, "r 3"],
        by_transmittance: Float32[np.ndarray, " r"],
    ) -> ShadingGradients:
        """Gradients by what was blended, by what reflected rays met, and by the environment."""
        settings, kept = self.settings, shaded.ctx
        if not isinstance(kept, _ShadingContext):
            return ShadingGradients(TraceGradients(rgb_srgb=by_rgb, transmittance=by_transmittance))
        parted, seen, buffer = kept.depth_split, kept.depth_split.results, kept.gbuffer
        which, harmonics = buffer.ray_ids, by_rgb * np.float32(1 - kept.ramp)
        by_alpha = -by_transmittance.astype(np.float64)
        by_normal = np.zeros((len(by_rgb), 3))
        by_features = np.zeros((len(by_rgb), seen.features.shape[1]))
        by_depth = np.zeros(len(by_rgb))
        add_patch_gradients(traced, settings, by_features, by_alpha, by_normal, by_depth)
        if kept.ramp == 1 and not settings.is_ref_gaussian_deferred(traced.training_progress):
            weight = np.float32(settings.harmonics_weight * 2 / (3 * len(by_rgb)))
            harmonics = weight * (traced.result.rgb_srgb - shaded.rgb_srgb)
        spread = settings.normal_weight / len(by_rgb)
        by_rgb, rgb, by_depth = parted.expand(by_rgb), parted.expand(harmonics), parted.expand(by_depth)
        by_alpha, by_normal = parted.expand(by_alpha), parted.expand(by_normal)
        by_features = parted.expand(by_features)
        by_shown = by_rgb[which] * kept.ramp
        by_alpha[which] += (by_shown * kept.display).sum(axis=1)
        by_linear = by_shown * buffer.alpha[:, None]
        if settings.recipe != "ref_gaussian":
            by_linear *= srgb_derivative(kept.linear)
            by_linear[(kept.linear >= 1) & (by_linear < 0)] = 0.0  # no photograph is whiter than white
        blur = settings.blur_roughness(traced.training_progress)
        back = shade_backward(kept.surface, self.light.levels, self.frame, by_linear, blur=blur)
        normal = back.normal
        incoming = kept.incident
        if settings.reflected_gradient:
            led = back.reflected + (0.0 if incoming is None else incoming.normal_gradient(back))
            normal = normal + clip_gradients(led, settings.normal_gradient_clip)
        if incoming is not None:
            incoming.add_roughness_gradient(back)
        by_material = back.material
        if settings.is_ref_gaussian_deferred(traced.training_progress):
            rgb[which] = by_rgb[which] * (1 - kept.surface.material[:, 3:4])
            by_material[:, 3] -= (by_rgb[which] * seen.rgb_srgb[which]).sum(axis=1)
        backward_gbuffer(buffer, by_material, normal, by_features, by_alpha, by_normal)
        normal_spread_gradient(buffer, spread, by_alpha, by_normal)
        by_texels = back.sum_texels(len(self.light.levels.texels))
        further = () if incoming is None else incoming.backward(back, by_texels)
        narrow = (x.astype(np.float32) for x in (rgb, -by_alpha, by_depth, by_normal, by_features))
        rgb, transmittance, depth, normal, features = narrow
        by_parts = TraceGradients(
            rgb_srgb=rgb,
            transmittance=transmittance,
            depth_sum=depth,
            normal_world=normal,
            features=features,
        )
        back_seen, fronts = parted.backward(by_parts)
        return ShadingGradients(back_seen, fronts + further, {"materials.texels": by_texels})

    def step(
        self,
        gaussians: FlatGaussians,
        gradients: GaussianGradients,
        parameters: Mapping[str, np.ndarray],
        *,
        training_progress: float,
    ) -> None:
        """A step of the environment; what the optimiser made of the materials is taken over."""
        ids = gradients.ids
        if (
            self.settings.recipe == "ref_gaussian"
            and not self._has_restarted[0]
            and self.settings.is_ref_gaussian_deferred(training_progress)
        ):
            self._restart(gaussians)
            return
        first = 0
        for name, width in MATERIAL_WIDTHS.items():
            self._features[ids, first : first + width] = gaussians.channels[name][ids]
            first += width
        if "materials.texels" in parameters:
            self.light.step(parameters["materials.texels"], rate=ENVIRONMENT_RATE * 0.1**training_progress)

    def _restart(self, gaussians: FlatGaussians) -> None:
        """Do as the seed's code does when its second stage begins."""
        first = 0
        for name, width in MATERIAL_WIDTHS.items():
            gaussians.channels[name][:] = REF_GAUSSIAN_MATERIAL[first : first + width]
            self._features[:, first : first + width] = REF_GAUSSIAN_MATERIAL[first : first + width]
            first += width
        self.light.reset()
        self._has_restarted[:] = True

    def state(self) -> dict[str, np.ndarray]:
        """The environment."""
        own = {f"materials.{name}": value for name, value in self.light.state().items()}
        return {**own, "materials.started_over": self._has_restarted, "materials.turn": self._occlusion_turn}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Take it back."""
        own = {name.removeprefix("materials."): value for name, value in state.items()}
        self._has_restarted = own["started_over"].copy()
        self._occlusion_turn = own["turn"].copy()
        self.light.restore(own)

    def _surface_with_ambient(self, result: TraceResult, gbuffer: GBuffer) -> SurfacePoints:
        """The surface of a buffer with what reaches it from all around, to which no gradient goes."""
        surface = gbuffer.surface
        if self.settings.recipe == "ref_gaussian":  # the seed's matt part is a colour of its own
            return replace(surface, ambient=np.zeros(len(gbuffer.ray_ids)))
        if not self.settings.ambient_occlusion or result.features.shape[1] <= AMBIENT_COLUMN:
            return surface
        around = result.features[gbuffer.ray_ids].astype(np.float64) / gbuffer.alpha[:, None]
        surface = replace(surface, ambient=around[:, AMBIENT_COLUMN])
        if around.shape[1] < INTERREFLECTION_COLUMNS.stop:
            return surface
        return replace(surface, bounced_linear=around[:, INTERREFLECTION_COLUMNS])

    def _layers(
        self,
        split: DepthSplit,
        rgb_srgb: Float32[np.ndarray, "l 3"],
        gbuffer: GBuffer,
        surface: SurfacePoints,
        linear: Float64[np.ndarray, "p 3"],
    ) -> dict[str, Float32[np.ndarray, "r _"]]:
        """What is behind a finished picture: radiance, materials, and what reflected rays said."""
        if self.settings.recipe == "ref_gaussian":
            linear = srgb_to_linear(rgb_srgb[gbuffer.ray_ids] / gbuffer.alpha[:, None])
        parts = {
            "linear": linear,
            "albedo": surface.material[:, :3],
            "metallic": surface.material[:, 3:4],
            "roughness": surface.material[:, 4:5],
            "visibility": surface.visibility[:, None],
            "indirect": surface.indirect_linear,
        }
        share = np.zeros((len(rgb_srgb), 1))
        share[gbuffer.ray_ids] = gbuffer.alpha[:, None]
        share /= np.maximum(split.expand(split.sum_layers(share)), 1e-12)
        layers = {}
        for name, values in parts.items():
            each = np.zeros((len(rgb_srgb), values.shape[1]))
            each[gbuffer.ray_ids] = values
            layers[name] = split.sum_layers(share * each).astype(np.float32)
        return layers

    def _trace_incident(self, traced: TracedRays, split: DepthSplit, gbuffer: GBuffer) -> IncidentLightModel:
        """Ask what comes in along reflected directions, in the way of the settings."""
        settings = self.settings
        if settings.indirect != "shaded" or settings.recipe == "ref_gaussian":
            return SingleRayIncidentLight.trace(traced, split, gbuffer, self._reflection_offset, settings)
        follower = ReflectionTracer(
            traced.tracer, self.light.levels, self.frame, self._surface_with_ambient,
            settings.max_bounces, self._reflection_offset, settings.depth_split * self._ray_bias,
        )  # fmt: skip
        return RayPairIncidentLight.trace(traced, split, gbuffer, follower, settings)

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
from octasplat.engine.shading.ambient_occlusion import OPEN, ambient_visibility, bounced_light
from octasplat.engine.shading.depth_split import Parted, part, whole
from octasplat.engine.shading.environment_frame import environment_frame
from octasplat.engine.shading.environment_light import LearntLight
from octasplat.engine.shading.gbuffer import Buffer, Leaving, gather, spread_back
from octasplat.engine.shading.geometry_losses import neighbour_terms, spread_term
from octasplat.engine.shading.gradient_ops import clipped, encoding_slope
from octasplat.engine.shading.incident_light import ByLobes, ByOneRay, Incoming
from octasplat.engine.shading.material_settings import ENVIRONMENT_RATE, SEED_MATERIAL, MaterialSettings
from octasplat.engine.shading.protocol import Developed, Reversed, Sight
from octasplat.engine.shading.reflection_tracing import Follower
from octasplat.engine.shading.split_sum import Surface, shade, shade_reverse
from octasplat.engine.trace.protocol import GaussianGradients, TraceGradients, Tracer, TraceResult

AMBIENT_COLUMN = 5
BOUNCED_COLUMNS = slice(6, 9)


@dataclass(frozen=True)
class _Kept:
    parted: Parted
    buffer: Buffer
    surface: Surface
    linear: Float64[np.ndarray, "p 3"]
    shown: Float64[np.ndarray, "p 3"]
    incoming: Incoming | None
    shaded: float


class Deferred:
    """Materials, normals and an environment make the colours; follows the protocol of shading models.

    The materials themselves are channels of the Gaussians, stepped by their optimiser.

    Args:
        settings: how they are learnt.
        extent_world: the scene's extent.
        sided: whether normals point outwards, so that only one side of each Gaussian is lit.

    Attributes:
        light: the environment.
        frame: its right, up and forward in the world, as rows.
    """

    name = "materials"

    def __init__(self, settings: MaterialSettings, *, extent_world: float, sided: bool = False) -> None:
        self.settings = settings
        self._sided = sided
        self.light = LearntLight(
            settings.environment_height,
            hdr=settings.hdr and settings.recipe != "ref_gaussian",
            white_weight=settings.white_weight,
            even_weight=settings.environment_smoothness_weight,
        )
        self.frame = environment_frame(np.array(settings.up_world, np.float64))
        self._gap = settings.ray_bias * extent_world
        self._leaving = Leaving(self._gap, settings.backface_cull_distance * extent_world)
        self._leaving_far = self._leaving._replace(gap_world=2 * self._gap)
        self._started_over = np.zeros(1, bool)
        self._turn = np.array([-1.0, -1.0])
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

    def settle(self, gaussians: FlatGaussians, tracer: Tracer, *, progress: float) -> None:
        """Measure what reaches some of the Gaussians from all around, by turns."""
        settings = self.settings
        if (
            not settings.ambient_occlusion
            or progress < settings.secondary_from
            or AMBIENT not in gaussians.channels
        ):
            return
        parts = settings.ambient_occlusion_rebuilds
        if progress != self._turn[1]:  # a training that goes on settles once more where it stopped
            self._turn = np.array([self._turn[0] + 1, progress])
        ids = np.arange(int(self._turn[0]) % parts, len(gaussians), parts)
        self.bounce(gaussians, ids, self.look_around(gaussians, ids, tracer), tracer)

    def look_around(
        self, gaussians: FlatGaussians, ids: Int64[np.ndarray, " u"], tracer: Tracer
    ) -> Float32[np.ndarray, " u"]:
        """Measure the ambient visibility of Gaussians; returns their open sides for :meth:`bounce`."""
        rays = self.settings.ambient_occlusion_rays
        visible, side = ambient_visibility(
            gaussians, ids, tracer, rays=rays, leaving=self._leaving_far, sided=self._sided
        )
        gaussians.channels[AMBIENT][ids, 0] = visible
        self._features[ids, AMBIENT_COLUMN] = visible
        return side

    def bounce(
        self,
        gaussians: FlatGaussians,
        ids: Int64[np.ndarray, " u"],
        side: Float32[np.ndarray, " u"],
        tracer: Tracer,
    ) -> None:
        """Find the light that others send to the open sides of Gaussians, if the scene has room for it."""
        if DIFFUSE_INTERREFLECTION not in gaussians.channels:
            return
        dim = gaussians.channels[AMBIENT][ids, 0] < OPEN
        bounced = np.zeros((len(ids), 3), np.float32)
        bounced[dim] = bounced_light(
            gaussians, ids[dim], side[dim], lambda fan: self._radiance(fan, tracer),
            rays=self.settings.ambient_occlusion_rays, leaving=self._leaving_far,
        )  # fmt: skip
        gaussians.channels[DIFFUSE_INTERREFLECTION][ids] = bounced
        self._features[ids, BOUNCED_COLUMNS] = bounced

    def _radiance(self, rays: RayBatch, tracer: Tracer) -> Float64[np.ndarray, "r 3"]:
        """What rays meet, times the share of it that hides the rest; lit by the environment alone.

        So a Gaussian's bounced light does not depend on that of others, and not on whose turn it was.
        """
        seen = tracer.trace(rays)
        buffer = gather(rays, seen)
        surface = self._dimmed(seen, buffer)
        out = np.zeros((len(rays), 3))
        surface = replace(
            surface, visibility=surface.ambient, bounced_linear=np.zeros((len(buffer.which), 3))
        )
        linear = shade(surface, self.light.levels, self.frame)
        out[buffer.which] = buffer.alpha[:, None] * linear
        return out

    def develop(self, sight: Sight) -> Developed:
        """Display colours, shaded as far as the training has handed over to that."""
        share = self.settings.handed_over(sight.progress)
        seen = sight.seen
        if share == 0:
            return Developed(seen.rgb_srgb, seen.transmittance)
        parted = self._part(sight)
        buffer = gather(parted.rays, parted.seen)
        surface, incoming = self._dimmed(parted.seen, buffer), None
        if self.settings.visibility and sight.progress >= self.settings.secondary_from:
            incoming = self._ask(sight, parted, buffer)
            visibility, indirect = incoming.seen
            surface = replace(surface, visibility=visibility, indirect_linear=indirect)
        linear = shade(surface, self.light.levels, self.frame)
        rgb = parted.seen.rgb_srgb * np.float32(1 - share)
        if self.settings.recipe == "ref_gaussian":
            shown = linear
            if self.settings.is_seed_deferred(sight.progress):
                matt = 1 - surface.material[:, 3:4]
                rgb[buffer.which] = matt * seen.rgb_srgb[buffer.which]
        else:
            shown = linear_to_srgb(np.minimum(linear, 1.0))
        rgb[buffer.which] += (share * buffer.alpha[:, None] * shown).astype(np.float32)
        kept = _Kept(parted, buffer, surface, linear, shown, incoming, share)
        layers = {} if sight.view is not None else self._layers(parted, rgb, buffer, surface, linear)
        return Developed(parted.joined(rgb), seen.transmittance, kept, layers)

    def _part(self, sight: Sight) -> Parted:
        """The surfaces that are shaded each by itself."""
        if self.settings.depth_split == 0 or self.settings.recipe == "ref_gaussian":
            return whole(sight.rays, sight.seen)
        apart, record = self.settings.depth_split * self._gap, sight.view is not None
        return part(sight.rays, sight.seen, sight.tracer, apart_world=apart, record=record)

    def reverse(
        self,
        sight: Sight,
        developed: Developed,
        by_rgb: Float32[np.ndarray, "r 3"],
        by_transmittance: Float32[np.ndarray, " r"],
    ) -> Reversed:
        """Gradients by what was blended, by what reflected rays met, and by the environment."""
        settings, kept = self.settings, developed.kept
        if not isinstance(kept, _Kept):
            return Reversed(TraceGradients(rgb_srgb=by_rgb, transmittance=by_transmittance))
        parted, seen, buffer = kept.parted, kept.parted.seen, kept.buffer
        which, harmonics = buffer.which, by_rgb * np.float32(1 - kept.shaded)
        by_alpha = -by_transmittance.astype(np.float64)
        by_normal = np.zeros((len(by_rgb), 3))
        by_features = np.zeros((len(by_rgb), seen.features.shape[1]))
        by_depth = np.zeros(len(by_rgb))
        neighbour_terms(sight, settings, by_features, by_alpha, by_normal, by_depth)
        if kept.shaded == 1 and not settings.is_seed_deferred(sight.progress):
            weight = np.float32(settings.harmonics_weight * 2 / (3 * len(by_rgb)))
            harmonics = weight * (sight.seen.rgb_srgb - developed.rgb_srgb)
        spread = settings.normal_weight / len(by_rgb)
        by_rgb, rgb, by_depth = parted.each(by_rgb), parted.each(harmonics), parted.each(by_depth)
        by_alpha, by_normal = parted.each(by_alpha), parted.each(by_normal)
        by_features = parted.each(by_features)
        by_shown = by_rgb[which] * kept.shaded
        by_alpha[which] += (by_shown * kept.shown).sum(axis=1)
        by_linear = by_shown * buffer.alpha[:, None]
        if settings.recipe != "ref_gaussian":
            by_linear *= encoding_slope(kept.linear)
            by_linear[(kept.linear >= 1) & (by_linear < 0)] = 0.0  # no photograph is whiter than white
        blur = settings.blurred(sight.progress)
        back = shade_reverse(kept.surface, self.light.levels, self.frame, by_linear, blur=blur)
        normal = back.normal
        incoming = kept.incoming
        if settings.reflected_gradient:
            led = back.reflected + (0.0 if incoming is None else incoming.led(back))
            normal = normal + clipped(led, settings.normal_gradient_clip)
        if incoming is not None:
            incoming.add_widening(back)
        by_material = back.material
        if settings.is_seed_deferred(sight.progress):
            rgb[which] = by_rgb[which] * (1 - kept.surface.material[:, 3:4])
            by_material[:, 3] -= (by_rgb[which] * seen.rgb_srgb[which]).sum(axis=1)
        spread_back(buffer, by_material, normal, by_features, by_alpha, by_normal)
        spread_term(buffer, spread, by_alpha, by_normal)
        by_texels = back.texels(len(self.light.levels.texels))
        further = () if incoming is None else incoming.back(back, by_texels)
        narrow = (x.astype(np.float32) for x in (rgb, -by_alpha, by_depth, by_normal, by_features))
        rgb, transmittance, depth, normal, features = narrow
        by_parts = TraceGradients(
            rgb_srgb=rgb,
            transmittance=transmittance,
            depth_sum=depth,
            normal_world=normal,
            features=features,
        )
        back_seen, fronts = parted.back(by_parts)
        return Reversed(back_seen, fronts + further, {"materials.texels": by_texels})

    def step(
        self,
        gaussians: FlatGaussians,
        gradients: GaussianGradients,
        parameters: Mapping[str, np.ndarray],
        *,
        progress: float,
    ) -> None:
        """A step of the environment; what the optimiser made of the materials is taken over."""
        ids = gradients.ids
        if (
            self.settings.recipe == "ref_gaussian"
            and not self._started_over[0]
            and self.settings.is_seed_deferred(progress)
        ):
            self._start_over(gaussians)
            return
        first = 0
        for name, width in MATERIAL_WIDTHS.items():
            self._features[ids, first : first + width] = gaussians.channels[name][ids]
            first += width
        if "materials.texels" in parameters:
            self.light.step(parameters["materials.texels"], rate=ENVIRONMENT_RATE * 0.1**progress)

    def _start_over(self, gaussians: FlatGaussians) -> None:
        """Do as the seed's code does when its second stage begins."""
        first = 0
        for name, width in MATERIAL_WIDTHS.items():
            gaussians.channels[name][:] = SEED_MATERIAL[first : first + width]
            self._features[:, first : first + width] = SEED_MATERIAL[first : first + width]
            first += width
        self.light.start_over()
        self._started_over[:] = True

    def state(self) -> dict[str, np.ndarray]:
        """The environment."""
        own = {f"materials.{name}": value for name, value in self.light.state().items()}
        return {**own, "materials.started_over": self._started_over, "materials.turn": self._turn}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Take it back."""
        own = {name.removeprefix("materials."): value for name, value in state.items()}
        self._started_over = own["started_over"].copy()
        self._turn = own["turn"].copy()
        self.light.restore(own)

    def _dimmed(self, seen: TraceResult, buffer: Buffer) -> Surface:
        """The surface of a buffer with what reaches it from all around, to which no gradient goes."""
        surface = buffer.surface
        if self.settings.recipe == "ref_gaussian":  # the seed's matt part is a colour of its own
            return replace(surface, ambient=np.zeros(len(buffer.which)))
        if not self.settings.ambient_occlusion or seen.features.shape[1] <= AMBIENT_COLUMN:
            return surface
        around = seen.features[buffer.which].astype(np.float64) / buffer.alpha[:, None]
        surface = replace(surface, ambient=around[:, AMBIENT_COLUMN])
        if around.shape[1] < BOUNCED_COLUMNS.stop:
            return surface
        return replace(surface, bounced_linear=around[:, BOUNCED_COLUMNS])

    def _layers(
        self,
        parted: Parted,
        rgb_srgb: Float32[np.ndarray, "l 3"],
        buffer: Buffer,
        surface: Surface,
        linear: Float64[np.ndarray, "p 3"],
    ) -> dict[str, Float32[np.ndarray, "r _"]]:
        """What is behind a finished picture: radiance, materials, and what reflected rays said."""
        if self.settings.recipe == "ref_gaussian":
            linear = srgb_to_linear(rgb_srgb[buffer.which] / buffer.alpha[:, None])
        parts = {
            "linear": linear,
            "albedo": surface.material[:, :3],
            "metallic": surface.material[:, 3:4],
            "roughness": surface.material[:, 4:5],
            "visibility": surface.visibility[:, None],
            "indirect": surface.indirect_linear,
        }
        share = np.zeros((len(rgb_srgb), 1))
        share[buffer.which] = buffer.alpha[:, None]
        share /= np.maximum(parted.each(parted.joined(share)), 1e-12)
        layers = {}
        for name, values in parts.items():
            each = np.zeros((len(rgb_srgb), values.shape[1]))
            each[buffer.which] = values
            layers[name] = parted.joined(share * each).astype(np.float32)
        return layers

    def _ask(self, sight: Sight, parted: Parted, buffer: Buffer) -> Incoming:
        """Ask what comes in along reflected directions, in the way of the settings."""
        settings = self.settings
        if settings.indirect != "shaded" or settings.recipe == "ref_gaussian":
            return ByOneRay.ask(sight, parted, buffer, self._leaving, settings)
        follower = Follower(
            sight.tracer, self.light.levels, self.frame, self._dimmed,
            settings.max_bounces, self._leaving, settings.depth_split * self._gap,
        )  # fmt: skip
        return ByLobes.ask(sight, parted, buffer, follower, settings)

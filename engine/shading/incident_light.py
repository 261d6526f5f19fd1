"""What comes in along reflected directions: asked by lobes, or by one ray as others do, with the way back."""

from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float64

from octasplat.engine.core.color import srgb_to_linear
from octasplat.engine.shading.depth_split import Parted
from octasplat.engine.shading.gbuffer import Buffer, Leaving, reflected_rays
from octasplat.engine.shading.gradient_ops import encoding_slope
from octasplat.engine.shading.material_settings import SEED_REACH, MaterialSettings
from octasplat.engine.shading.protocol import Sight
from octasplat.engine.shading.reflection_rays import (
    Lobe,
    Widening,
    by_each,
    look,
    numbers_of,
    pair_slope,
    roughness_slope,
    widening,
)
from octasplat.engine.shading.reflection_tracing import Follower, Seen, follow_back
from octasplat.engine.shading.split_sum import ShadeGradients
from octasplat.engine.trace.protocol import Recording, TraceGradients

HIDDEN = 0.5
"""Transmittance below which the seed's way of seeing counts the environment as hidden."""
SALTS = 1 << 20
"""So finely the share of the training that is done draws other numbers."""

Traced = tuple[tuple[Recording, TraceGradients], ...]


@runtime_checkable
class Incoming(Protocol):
    """What reflected rays say of the points of a buffer, and gradients through that."""

    @property
    def seen(self) -> Seen:
        """What comes in at each point."""
        ...

    def led(self, back: ShadeGradients) -> Float64[np.ndarray, "p 3"] | float:
        """Gradients by the normals through what reflected rays meet."""
        ...

    def add_widening(self, back: ShadeGradients) -> None:
        """Add gradients by the roughness through what reflected rays meet to those of the materials."""
        ...

    def back(self, back: ShadeGradients, by_texels: Float64[np.ndarray, "t 3"]) -> Traced:
        """Gradients by what reflected rays met; those by the texels are added to ``by_texels``."""
        ...


@dataclass(frozen=True)
class ByLobes:
    """Pairs of rays, what they meet shaded by the split sum; see :mod:`octasplat.engine.shading.reflection_rays`.

    Attributes:
        lobe: what they saw.
        widened: what changes with the roughness at some of the points; None unless in a training.
        roughness: of all points.
        follower: that followed the rays.
        settings: of the materials.
    """

    lobe: Lobe
    widened: Widening | None
    roughness: Float64[np.ndarray, " p"]
    follower: Follower
    settings: MaterialSettings

    @classmethod
    def ask(
        cls, sight: Sight, parted: Parted, buffer: Buffer, follower: Follower, settings: MaterialSettings
    ) -> "ByLobes":
        """Ask for the points of a buffer."""
        rays, record, ways = parted.rays, sight.view is not None, buffer.surface.direction_world
        salt, least = int(sight.progress * SALTS), settings.least_slope(sight.progress)
        if sight.dither is None:
            numbers = numbers_of(ways, salt)
        else:
            numbers = parted.each(sight.dither.T)[buffer.which].T
        lobe = look(rays, buffer, follower, numbers, least_slope=least, record=record)
        widened = None
        if record and settings.roughness_probe_fraction > 0:
            drawn = numbers_of(ways, salt + 1)[0] < settings.roughness_probe_fraction
            widened = widening(rays, buffer, follower, lobe, drawn, least_slope=least)
        return cls(lobe, widened, buffer.surface.material[:, 4], follower, settings)

    @property
    def seen(self) -> Seen:
        """The mean of each pair."""
        return self.lobe.seen

    def led(self, back: ShadeGradients) -> Float64[np.ndarray, "p 3"]:
        """From the differences of the pairs."""
        return pair_slope(self.lobe.mirrored.seen, self.lobe.facets, back.around, back.specular)

    def add_widening(self, back: ShadeGradients) -> None:
        """From the three rays of those that were drawn, for all."""
        if (found := self.widened) is None:
            return
        at = found.points
        slope = roughness_slope(found, self.roughness[at], back.around[at], back.specular[at])
        back.material[at, 4] += slope / self.settings.roughness_probe_fraction

    def back(self, back: ShadeGradients, by_texels: Float64[np.ndarray, "t 3"]) -> Traced:
        """To all that was met on the way."""
        by_seen = by_each(Seen(back.visibility, back.indirect))
        return follow_back(self.lobe.mirrored, self.follower.light, self.follower.frame, by_seen, by_texels)


@dataclass(frozen=True)
class ByOneRay:
    """One ray a point in the mirrored direction, which meets harmonics, or as the seed's code has it.

    Attributes:
        seen: what came in.
        hits: recording of the rays; None where there is none, or nothing learns from them.
        by_rgb: gradient of what came in by the display colours that were met.
    """

    seen: Seen
    hits: Recording | None = None
    by_rgb: Float64[np.ndarray, "p #c"] = field(default_factory=lambda: np.zeros((0, 1)))

    @classmethod
    def ask(
        cls, sight: Sight, parted: Parted, buffer: Buffer, leaving: Leaving, settings: MaterialSettings
    ) -> "ByOneRay":
        """Ask for the points of a buffer."""
        rays = reflected_rays(parted.rays, buffer, leaving)
        if settings.recipe == "ref_gaussian":
            met = sight.tracer.trace(rays.up_to(SEED_REACH), record=sight.view is not None)
            visibility = (met.transmittance > HIDDEN).astype(np.float64)
            if settings.indirect == "none":
                return cls(Seen(visibility, np.zeros((len(rays), 3))))
            hidden = 1.0 - visibility[:, None]
            return cls(Seen(visibility, hidden * met.rgb_srgb), met.recording, hidden)
        met = sight.tracer.trace(rays, record=sight.view is not None)
        visibility = met.transmittance.astype(np.float64)
        if settings.indirect == "none":
            return cls(Seen(visibility, np.zeros((len(rays), 3))))
        alpha = np.maximum(1.0 - visibility, 1e-6)[:, None]
        linear = srgb_to_linear(met.rgb_srgb / alpha)
        return cls(Seen(visibility, linear * alpha), met.recording, 1.0 / encoding_slope(linear))

    def led(self, back: ShadeGradients) -> float:
        """None: one ray says nothing of those beside it."""
        return 0.0

    def add_widening(self, back: ShadeGradients) -> None:
        """None, likewise."""

    def back(self, back: ShadeGradients, by_texels: Float64[np.ndarray, "t 3"]) -> Traced:
        """To the harmonics that were met."""
        if self.hits is None:
            return ()
        return ((self.hits, TraceGradients(rgb_srgb=(back.indirect * self.by_rgb).astype(np.float32))),)

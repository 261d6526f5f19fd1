"""Materials of Gaussians: the named channels of a material, and whether a scene has them.

A material is that of "Physically Based Shading at Disney" (Burley 2012,
https://media.disneyanimation.com/uploads/production/publication_asset/48/asset/s2012_pbs_disney_brdf_notes_v3.pdf)
cut down to what real-time renderers and glTF share: base color, metallic and roughness. All values are kept
as they mean, in [0, 1], not as their logits; the base color is linear.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.gaussians.channels import FILL_VALUE, stack_channels
from octasplat.engine.gaussians.model import FlatGaussians

ALBEDO, METALLIC, ROUGHNESS = "albedo", "metallic", "roughness"
MATERIAL_WIDTHS: Mapping[str, int] = {ALBEDO: 3, METALLIC: 1, ROUGHNESS: 1}
"""The channels of a material and their widths, in the order in which they are traced.

``albedo`` is the linear base color: of the matt ground, and of what a metal reflects head-on. ``roughness``
is perceptual: GGX's alpha is its square.
"""
AMBIENT = "ambient"
"""A channel beside them, which follows from the geometry: share of the light from all around that arrives."""
DIFFUSE_INTERREFLECTION = "bounced"
"""A channel of width 3: irradiance over pi that other surfaces send, in the light a scene was learnt in."""
DIELECTRIC_F0 = 0.04
"""What a surface that is no metal reflects head-on, that of an index of refraction of 1.5."""


def has_materials(gaussians: FlatGaussians) -> bool:
    """Return whether a scene has all three channels of a material, each of its width."""
    widths = gaussians.channels.widths
    return all(widths.get(name) == width for name, width in MATERIAL_WIDTHS.items())


def is_material_known(gaussians: FlatGaussians) -> Bool[np.ndarray, " n"]:
    """Return which Gaussians have a material; those that came from a scene without have 0 in all channels.

    The ambient visibility, where there is one, tells them from a black mirror that somebody made.
    """
    if not has_materials(gaussians):
        return np.zeros(len(gaussians), np.bool_)
    names = [*MATERIAL_WIDTHS, *(name for name in (AMBIENT,) if name in gaussians.channels)]
    return np.asarray((stack_channels(gaussians.channels, names) != FILL_VALUE).any(axis=1))


def require_materials(gaussians: FlatGaussians, path: Path) -> None:
    """Check that a scene has materials.

    Args:
        gaussians: the scene.
        path: the file that it was read from, for the message.

    Raises:
        ConfigError: it has none.
    """
    if not has_materials(gaussians):
        raise ConfigError(
            f"{path} has no materials (the channels {', '.join(MATERIAL_WIDTHS)}); "
            "train it with: octasplat reconstruct PHOTOS -o OUT --materials."
        )


def reflective_fraction(gaussians: FlatGaussians) -> float:
    """Return the fraction of a scene's surface, by area times opacity, that is smooth metal.

    Where there is next to none, nothing says how bright the environment is, nor what is metal.
    """
    area = gaussians.opacities * np.prod(gaussians.scales, axis=1)  # up to a constant factor
    shows = (gaussians.channels[METALLIC][:, 0] > 0.5) & (gaussians.channels[ROUGHNESS][:, 0] < 0.5)
    total = float(area.sum(dtype=np.float64))
    return float(area[shows].sum(dtype=np.float64)) / total if total > 0 else 0.0


def with_interreflection_channel(gaussians: FlatGaussians) -> FlatGaussians:
    """Return the scene with a channel for light between surfaces, zero at first.

    A scene whose ambient visibility is not known stays without, as nothing says where that light arrives.
    """
    if AMBIENT not in gaussians.channels:
        return gaussians
    nothing = np.zeros((len(gaussians), 3), np.float32)
    channels = {name: values.copy() for name, values in gaussians.channels.items()}
    return gaussians.with_channels({**channels, DIFFUSE_INTERREFLECTION: nothing})

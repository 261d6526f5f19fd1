"""Conversion of mesh files' materials to a stage's materials."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from octasplat.engine.core.color import linear_to_srgb
from octasplat.engine.core.errors import ConfigError
from octasplat.engine.geometry.mesh_material import FileImage, MeshMaterial
from octasplat.engine.pathtracing.stage.materials import Glass, Material, MetallicRoughness

MAX_IOR = 4.0
THIN_IOR = 1.0
"""Index of refraction of a pane without an inside: light goes straight on."""


@dataclass(frozen=True)
class ImportedMaterial:
    """A material of a stage that came from a mesh file.

    Attributes:
        material: with names of images that only ``images`` knows.
        images: of the file.
        uses_vertex_alpha: whether the alpha of the mesh's corners is multiplied by the opacity.
    """

    material: Material
    images: Mapping[str, FileImage]
    uses_vertex_alpha: bool = False


def import_material(
    source: MeshMaterial, is_closed: Callable[[], bool], scale: float, warn: Callable[[str], None]
) -> ImportedMaterial:
    """Return the stage's material for that of a mesh file.

    Args:
        source: the file's.
        is_closed: whether its triangles close something, so that glass has an inside.
        scale: world units in one unit of the file.
        warn: called with a sentence on what is not understood.

    Raises:
        ConfigError: a number is not finite or out of range.
    """
    cutoff = source.opacity_cutoff
    numbers = (
        *source.rgb_linear, *source.emission_linear, source.metallic, source.roughness, source.ior,
        source.opacity, 0.0 if cutoff is None else cutoff, source.clear_coat, source.clear_coat_roughness,
    )  # fmt: skip
    if not (np.isfinite(numbers).all() and min(numbers) >= 0.0):
        raise ConfigError(f"the material {source.name} holds a number that is negative or not finite.")
    left_out = list(source.unsupported)
    ior = min(source.ior, MAX_IOR) if source.ior >= 1.0 else 1.5
    if ior != source.ior:
        left_out.append(f"an index of refraction of {source.ior:g} ({ior:g} is taken)")
    material: Material
    if source.transmission >= 0.5:
        named = {
            "texture": source.texture,
            "texture of metallic and roughness": source.metallic_roughness_texture,
            "normal texture": source.normal_texture,
        }
        left_out += [f"{key} on glass" for key, image in named.items() if image is not None]
        if source.opacity < 1.0 or source.opacity_texture is not None or source.uses_vertex_alpha:
            left_out.append("opacity of glass")
        if source.clear_coat > 0.0:
            left_out.append("a clear coat on glass")
        if max(source.emission_linear) > 0.0:
            left_out.append("light of its own of glass")
        # its texture, which is told above, may say that there is no metal
        if source.metallic > 0.0 and source.metallic_roughness_texture is None:
            left_out.append(f"metallic {source.metallic:g} of glass")
        if not is_closed():
            left_out.append("the refraction of glass that is not closed")
            ior = THIN_IOR
        # per unit of the file to per world unit
        red, green, blue = (value / scale for value in source.absorption)
        material = Glass(
            ior=ior,
            tint_srgb=_to_srgb(source.rgb_linear),
            absorption=(red, green, blue),
            roughness=_clamp_unit(source.roughness),
        )
        images: dict[str, FileImage] = {}
    else:
        if source.transmission > 0.0:
            left_out.append(f"transmission {source.transmission:g}, which is less than half")
        if source.normal_texture is not None and source.normal_scale < 0.0:
            left_out.append("the sign of the scale of its normal texture")
        if (
            source.clear_coat > 0.0
            and source.normal_texture is not None
            and not source.coat_has_normal_texture
        ):
            left_out.append("a clear coat that is smoother than the normal texture")
        fields = {
            "texture": source.texture,
            "metallic_roughness_texture": source.metallic_roughness_texture,
            "normal_texture": source.normal_texture,
            "emission_texture": source.emission_texture,
            "clear_coat_texture": source.clear_coat_texture,
            "clear_coat_roughness_texture": source.clear_coat_roughness_texture,
        }
        strength = max(source.emission_linear)
        # an image alone sends no light: it is a factor
        if strength == 0.0:
            fields["emission_texture"] = None
        if source.clear_coat == 0.0:
            fields["clear_coat_texture"] = fields["clear_coat_roughness_texture"] = None
        images = {name: image for name, image in fields.items() if image is not None}
        names = {name: name for name in images}
        opacity_texture = None
        if source.opacity_texture is not None:
            is_own = source.opacity_texture == source.texture
            opacity_texture = "texture" if is_own else "opacity_texture"
            images[opacity_texture] = source.opacity_texture
        # split into a strength and a color whose largest channel is 1
        red, green, blue = (value / strength if strength else 1.0 for value in source.emission_linear)
        material = MetallicRoughness(
            color_srgb=_to_srgb(source.rgb_linear),
            metallic=_clamp_unit(source.metallic),
            roughness=_clamp_unit(source.roughness),
            ior=max(ior, 1.0 + 1e-6),
            normal_scale=abs(source.normal_scale),
            emission=strength,
            emission_srgb=_to_srgb((red, green, blue)),
            clear_coat=_clamp_unit(source.clear_coat),
            clear_coat_roughness=_clamp_unit(source.clear_coat_roughness),
            opacity=_clamp_unit(source.opacity),
            opacity_texture=opacity_texture,
            opacity_cutoff=cutoff,
            **names,
        )
    if left_out:
        warn(f"of the material {source.name or 'without a name'} is not used: {', '.join(left_out)}.")
    is_glass = isinstance(material, Glass)
    return ImportedMaterial(material, images, source.uses_vertex_alpha and not is_glass)


def _clamp_unit(value: float) -> float:
    return min(max(value, 0.0), 1.0)


def _to_srgb(linear: tuple[float, float, float]) -> tuple[float, float, float]:
    red, green, blue = linear_to_srgb(np.clip(np.array(linear, np.float64), 0.0, 1.0))
    return _clamp_unit(float(red)), _clamp_unit(float(green)), _clamp_unit(float(blue))

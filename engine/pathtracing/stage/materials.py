"""What the meshes of a stage are made of. Imports neither torch nor numba."""

from typing import Annotated, Literal

from pydantic import Field

from octasplat.engine.pathtracing.stage.base import (
    IS_NUMBER,
    WHITE,
    Color,
    NonNegative,
    StageModel,
    UnitInterval,
)


class NormalMapped(StageModel):
    """A surface with an optional normal map.

    Attributes:
        normal_texture: image file of normals in the frame of the texture coordinates: x to the right of the
            image, y up in it, z off the surface, each from -1 to 1 as 0 to 1.
        normal_scale: factor of x and y.
    """

    normal_texture: str | None = None
    normal_scale: NonNegative = 1.0


class Emissive(StageModel):
    """A surface that may emit light, on both sides.

    Attributes:
        emission: linear radiance of its own light, the same in all directions; 0 for none.
        emission_srgb: color of that light.
        emission_texture: image file of display colors, multiplied by it.
    """

    emission: NonNegative = 0.0
    emission_srgb: Color = WHITE
    emission_texture: str | None = None


class Cutout(StageModel):
    """A surface that may have holes, or cover what is behind it in part.

    Attributes:
        opacity: share of the surface that is there.
        opacity_texture: image file whose alpha is multiplied by it, or whose grey where it has no alpha.
        opacity_cutoff: the surface is there where its opacity reaches this, and else not.
    """

    opacity: UnitInterval = 1.0
    opacity_texture: str | None = None
    opacity_cutoff: NonNegative | None = None


class ClearCoated(StageModel):
    """A surface that may have a clear coat of index 1.5 over all else, such as lacquer on metal.

    Attributes:
        clear_coat: share of the surface that has it.
        clear_coat_texture: image file whose red is multiplied by it.
        clear_coat_roughness: perceptual, GGX's alpha is its square.
        clear_coat_roughness_texture: image file whose green is multiplied by it.
    """

    clear_coat: UnitInterval = 0.0
    clear_coat_texture: str | None = None
    clear_coat_roughness: UnitInterval = 0.0
    clear_coat_roughness_texture: str | None = None


class Diffuse(NormalMapped, Emissive, Cutout):
    """A diffuse (Lambertian) surface.

    Attributes:
        color_srgb: share of the light that it sends back.
        texture: image file of display colors, multiplied by the color.
    """

    kind: Literal["diffuse"] = "diffuse"
    color_srgb: Color = (0.8, 0.8, 0.8)
    texture: str | None = None


class Mirror(StageModel):
    """A perfect mirror; white reflects everything."""

    kind: Literal["mirror"] = "mirror"
    color_srgb: Color = WHITE


class Glass(StageModel):
    """Clear or rough glass, for closed meshes.

    Attributes:
        ior: index of refraction; that of the surroundings is 1, or that of the glass around it where both
            have a priority.
        tint_srgb: color that light takes at each surface that it passes.
        absorption: what is absorbed inside in each linear channel, per world unit (Beer's law).
        roughness: of its surface; perceptual, GGX's alpha is its square; below 0.03 it is smooth.
        multiple_scattering: light that facets throw at each other is kept, not lost.
        priority: where meshes of glass overlap, the one with the highest is there, of equal ones the one that
            a ray enters last. Without a priority it is taken to stand in air.
    """

    kind: Literal["glass"] = "glass"
    ior: Annotated[float, Field(ge=1, le=4), IS_NUMBER] = 1.5
    tint_srgb: Color = WHITE
    absorption: tuple[NonNegative, NonNegative, NonNegative] = (0.0, 0.0, 0.0)
    roughness: UnitInterval = 0.0
    multiple_scattering: bool = True
    priority: Annotated[int, Field(ge=0, le=1000), IS_NUMBER] | None = None


class Metal(NormalMapped, ClearCoated):
    """Metal with a microfacet surface (GGX).

    Attributes:
        color_srgb: color of what it reflects head-on.
        roughness: perceptual, GGX's alpha is its square.
        multiple_scattering: light that facets throw at each other is kept, not lost.
    """

    kind: Literal["metal"] = "metal"
    color_srgb: Color = (0.9, 0.9, 0.9)
    roughness: UnitInterval = 0.2
    multiple_scattering: bool = True


class Dielectric(NormalMapped, Emissive, Cutout, ClearCoated):
    """A colored substrate under a clear coat with a microfacet surface, such as plastic or glaze.

    Attributes:
        color_srgb: of the ground.
        texture: image file of the ground's display colors, multiplied by the color.
        roughness: of the coat; perceptual, GGX's alpha is its square.
        ior: index of refraction of the coat.
    """

    kind: Literal["dielectric"] = "dielectric"
    color_srgb: Color = (0.8, 0.8, 0.8)
    texture: str | None = None
    roughness: UnitInterval = 0.3
    ior: Annotated[float, Field(gt=1, le=4), IS_NUMBER] = 1.5


class MetallicRoughness(NormalMapped, Emissive, Cutout, ClearCoated):
    """glTF's material: a mixture of a dielectric and a metal.

    Attributes:
        color_srgb: of the dielectric's ground and of the metal.
        texture: image file of display colors, multiplied by the color.
        metallic: share of the metal.
        roughness: perceptual, GGX's alpha is its square.
        metallic_roughness_texture: image file with roughness in green and metallic in blue, multiplied by
            the two numbers.
        ior: index of refraction of the dielectric.
        diffuse: how the ground shares light with the coat: ``coupled`` keeps all energy, ``burley`` is the
            diffuse term of Disney's principled material, which does not quite.
        multiple_scattering: light that facets throw at each other is kept, not lost.
    """

    kind: Literal["metallic-roughness"] = "metallic-roughness"
    color_srgb: Color = WHITE
    texture: str | None = None
    metallic: UnitInterval = 0.0
    roughness: UnitInterval = 1.0
    metallic_roughness_texture: str | None = None
    ior: Annotated[float, Field(gt=1, le=4), IS_NUMBER] = 1.5
    diffuse: Literal["coupled", "burley"] = "coupled"
    multiple_scattering: bool = True


Material = Annotated[
    Diffuse | Mirror | Glass | Metal | Dielectric | MetallicRoughness,
    Field(discriminator="kind"),
]

TEXTURE_KEYS = (
    "texture", "metallic_roughness_texture", "normal_texture", "emission_texture", "opacity_texture",
    "clear_coat_texture", "clear_coat_roughness_texture",
)  # fmt: skip
"""Keys of materials that name images."""

"""Materials of mesh files, in glTF's terms, of any file format."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from octasplat.engine.core.errors import SceneFileError

Wrap = Literal["repeat", "clamp", "mirror"]
"""What is beyond the edges of an image: itself again, the color of the edge, or itself mirrored."""


@dataclass(frozen=True)
class FileImage:
    """An image that a mesh file holds or names.

    Attributes:
        name: what errors call it.
        suffix: of the image's format, with its dot.
        content: the encoded image where the mesh file holds it.
        path: the file where the mesh file names it.
        wrap: beyond its edges to the left and right, and above and below.
        is_blocky: whether each pixel has one color, rather than a mean of its neighbours.
    """

    name: str
    suffix: str
    content: bytes | None = None
    path: Path | None = None
    wrap: tuple[Wrap, Wrap] = ("repeat", "repeat")
    is_blocky: bool = False


@dataclass(frozen=True)
class MeshMaterial:
    """A material of a mesh file.

    Attributes:
        name: as the file gives it.
        rgb_linear: base color.
        texture: display colors, multiplied by the base color.
        metallic: share of the metal.
        roughness: perceptual.
        metallic_roughness_texture: roughness in green and metallic in blue, multiplied by the two numbers.
        emission_linear: radiance of its own light.
        emission_texture: display colors, multiplied by that radiance.
        normal_texture: normals in the frame of the texture coordinates.
        normal_scale: factor of their slopes.
        transmission: share of the light that goes through instead of being scattered by the ground.
        ior: index of refraction.
        absorption: of what lies inside, in each linear channel, per unit of the file.
        opacity: share of the surface that is there.
        opacity_texture: alpha, multiplied by it; of an image other than ``texture`` that has none its grey.
        opacity_cutoff: the surface is there where the opacity reaches this; None where it covers in part.
        uses_vertex_alpha: whether the alpha of the vertices' colors is multiplied by the opacity.
        clear_coat: share of the surface under a clear coat.
        clear_coat_texture: multiplied by it, in red.
        clear_coat_roughness: perceptual.
        clear_coat_roughness_texture: multiplied by it, in green.
        coat_has_normal_texture: whether the coat is said to follow ``normal_texture``, too.
        unsupported: what else the file says of it, which is not understood, in words.
    """

    name: str
    rgb_linear: tuple[float, float, float] = (1.0, 1.0, 1.0)
    texture: FileImage | None = None
    metallic: float = 0.0
    roughness: float = 1.0
    metallic_roughness_texture: FileImage | None = None
    emission_linear: tuple[float, float, float] = (0.0, 0.0, 0.0)
    emission_texture: FileImage | None = None
    normal_texture: FileImage | None = None
    normal_scale: float = 1.0
    transmission: float = 0.0
    ior: float = 1.5
    absorption: tuple[float, float, float] = (0.0, 0.0, 0.0)
    opacity: float = 1.0
    opacity_texture: FileImage | None = None
    opacity_cutoff: float | None = None
    uses_vertex_alpha: bool = False
    clear_coat: float = 0.0
    clear_coat_texture: FileImage | None = None
    clear_coat_roughness: float = 0.0
    clear_coat_roughness_texture: FileImage | None = None
    coat_has_normal_texture: bool = False
    unsupported: tuple[str, ...] = ()


def resolve_image(mesh: Path, name: str) -> FileImage:
    """Return the image that a mesh file names, which must lie in the mesh's folder or below.

    Programs like to write where an image was on another computer; then one of the same name beside the mesh
    is taken.

    Raises:
        SceneFileError: there is none.
    """
    folder = mesh.parent.resolve()
    plain = name.replace("\\", "/").strip()
    for candidate in (plain, plain.rsplit("/", 1)[-1]):
        # Resolved, so that neither links nor .. lead out of the folder
        path = (folder / candidate).resolve()
        if candidate and path.is_relative_to(folder) and path.is_file():
            return FileImage(str(path), path.suffix, path=path)
    raise SceneFileError(
        f"{mesh}: names the image {plain}, which is not in its folder; put it there, or give the mesh a "
        "material in the stage."
    )

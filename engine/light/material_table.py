"""All materials of a stage as rows, with their tables and textures."""

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float32

from octasplat.engine.colour import srgb_to_linear
from octasplat.engine.errors import ConfigError, DatasetError
from octasplat.engine.files.mesh_looks import FileImage
from octasplat.engine.light.arrays import Materials
from octasplat.engine.light.bsdf import albedo_table, frosted_table
from octasplat.engine.light.kernels_bsdf import BURLEY, COUPLED
from octasplat.engine.light.kernels_surface import DIFFUSE, GLASS, LIGHT, MIRROR, OPAQUE
from octasplat.engine.light.stage import (
    Bumped,
    Dielectric,
    Diffuse,
    Glass,
    Material,
    Metal,
    MetallicRoughness,
    Mirror,
    Shining,
)
from octasplat.engine.render.images import read_image

MAX_TEXELS = 1 << 27
Use = Literal["colour", "light", "data"]
"""What an image holds: display colours, display colours of light, or numbers that are taken as they are."""

_DEFAULTS: dict[str, np.ndarray] = {
    "kinds": np.array(DIFFUSE, np.int32),
    "colours_linear": np.ones(3),
    "metallic": np.array(0.0),
    "roughness": np.array(0.0),
    "iors": np.array(1.5),
    "absorption": np.zeros(3),
    "grounds": np.array(COUPLED, np.int32),
    "kept": np.array(1, np.int32),
    "coats": np.array(0, np.int32),
    "colour_textures": np.array(-1, np.int32),
    "metallic_roughness_textures": np.array(-1, np.int32),
    "normal_textures": np.array(-1, np.int32),
    "normal_scales": np.array(1.0),
    "tinted": np.array(0, np.int32),
    "lights": np.array(-1, np.int32),
}
"""What a material is where it says nothing else."""


class MaterialTable:
    """Rows of materials as they come.

    Args:
        folder: where the names of images are relative to.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._rows: list[dict[str, object]] = []
        self._coats: list[tuple[str, float]] = [("coat", 1.5)]
        self._textures: dict[tuple[FileImage, Use], int] = {}
        self._images: list[Float32[np.ndarray, "h w 3"]] = []

    def add(
        self, material: Material, where: str, *, has_uv: bool, tinted: bool, images: Mapping[str, FileImage]
    ) -> int:
        """The row of a material.

        Args:
            material: what to add.
            where: what errors call it.
            has_uv: whether the mesh has texture coordinates.
            tinted: whether the colours of the mesh's corners count.
            images: of a mesh file, by the names that the material has for them.

        Raises:
            ConfigError: an image is none, or the mesh has no texture coordinates for it.
        """
        row: dict[str, object] = {"tinted": int(tinted)}

        def texture(name: str | None, use: Use) -> int:
            if name is None:
                return -1
            path = self._folder / name
            return self._texture(
                images.get(name) or FileImage(str(path), path.suffix, path=path), use, has_uv, where
            )

        if isinstance(material, Glass):
            colour = material.tint_srgb
            row |= {"kinds": GLASS, "iors": material.ior, "absorption": material.absorption}
            row |= {"roughness": material.roughness, "kept": material.multiple_scattering}
            if material.roughness > 0.0 and material.ior > 1.0:
                row["coats"] = self._coat("frost", material.ior)
                self._coat("frost", 1.0 / material.ior)
        else:
            colour = material.colour_srgb
            row["kinds"] = {Diffuse: DIFFUSE, Mirror: MIRROR}.get(type(material), OPAQUE)
        row["colours_linear"] = srgb_to_linear(np.array(colour))
        if isinstance(material, Metal | Dielectric | MetallicRoughness):
            row["roughness"] = material.roughness
        if isinstance(material, Metal):
            row |= {"metallic": 1.0, "kept": material.multiple_scattering}
        if isinstance(material, MetallicRoughness):
            row |= {"metallic": material.metallic, "kept": material.multiple_scattering}
            row["grounds"] = BURLEY if material.diffuse == "burley" else COUPLED
            row["metallic_roughness_textures"] = texture(material.metallic_roughness_texture, "data")
        if isinstance(material, Dielectric | MetallicRoughness):
            row |= {"iors": material.ior, "coats": self._coat("coat", material.ior)}
        if isinstance(material, Diffuse | Dielectric | MetallicRoughness):
            row["colour_textures"] = texture(material.texture, "colour")
        if isinstance(material, Bumped):
            row["normal_textures"] = texture(material.normal_texture, "data")
            row["normal_scales"] = material.normal_scale
        if isinstance(material, Shining):
            row["emission"] = texture(material.emission_texture, "light")
        self._rows.append(row)
        return len(self._rows) - 1

    def add_light(self, number: int) -> int:
        """The row of the surface of a light."""
        self._rows.append({"kinds": LIGHT, "lights": number})
        return len(self._rows) - 1

    def shine(self, row: int, number: int) -> int:
        """Make a row the surface of a light as well; returns the texture of its light, -1 for none."""
        self._rows[row]["lights"] = number
        texture = self._rows[row]["emission"]
        assert isinstance(texture, int)
        return texture

    def arrays(self) -> Materials:
        """All rows as arrays."""
        count = len(self._rows)
        columns = {
            name: np.array([row.get(name, default) for row in self._rows], default.dtype).reshape(
                count, *default.shape
            )
            for name, default in _DEFAULTS.items()
        }
        tables = [albedo_table(ior) if kind == "coat" else frosted_table(ior) for kind, ior in self._coats]
        sizes = np.zeros((len(self._images), 3), np.int64)
        first = 0
        for k, image in enumerate(self._images):
            sizes[k] = first, image.shape[0], image.shape[1]
            first += image.shape[0] * image.shape[1]
        texels = np.concatenate([np.zeros((0, 3), np.float32), *(i.reshape(-1, 3) for i in self._images)])
        return Materials(
            **columns,
            mirror=albedo_table(None).by_cosine,
            coat=np.stack([table.by_cosine for table in tables]),
            coat_means=np.stack([table.mean for table in tables]),
            texels_linear=texels,
            texture_sizes=sizes,
        )

    def _coat(self, kind: str, ior: float) -> int:
        """The number of a table; that of light that leaves rough glass comes right after its own."""
        if kind == "coat" and (kind, ior) in self._coats:
            return self._coats.index((kind, ior))
        self._coats.append((kind, ior))
        return len(self._coats) - 1

    def _texture(self, image: FileImage, use: Use, has_uv: bool, where: str) -> int:
        """The number of a texture; display values are made linear, unless the image holds linear ones."""
        if not has_uv:
            raise ConfigError(f"{where}: {image.name} needs texture coordinates, which the mesh lacks.")
        if (image, use) not in self._textures:
            try:
                values = _pixels(image)
            except DatasetError as error:
                raise ConfigError(f"{where}: {error}") from None
            rgb = values[..., :3] if values.shape[2] >= 3 else np.repeat(values[..., :1], 3, axis=2)
            if use != "data" and image.suffix.lower() not in (".exr", ".hdr"):
                rgb = srgb_to_linear(rgb)
            if not np.isfinite(rgb).all():
                raise ConfigError(f"{where}: {image.name} holds values that are not finite; mend the image.")
            self._textures[image, use] = len(self._images)
            most = None if use == "light" else 1.0
            self._images.append(np.ascontiguousarray(np.clip(rgb, 0.0, most), np.float32))
            if sum(i.shape[0] * i.shape[1] for i in self._images) > MAX_TEXELS:
                raise ConfigError(
                    f"{image.name}: the textures have more than {MAX_TEXELS >> 20} million pixels together."
                )
        return self._textures[image, use]


def _pixels(image: FileImage) -> Float32[np.ndarray, "h w c"]:
    """The pixels of an image, from where it lies."""
    if image.path is not None:
        return read_image(image.path)
    with tempfile.TemporaryDirectory(prefix="octasplat-") as folder:
        path = Path(folder) / f"image{image.suffix}"
        path.write_bytes(image.content or b"")
        try:
            return read_image(path)
        except DatasetError:
            raise DatasetError(f"{image.name} cannot be read as an image.") from None

"""All materials of a stage as table rows, with albedo tables and textures."""

import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float32

from octasplat.engine.core.color import srgb_to_linear
from octasplat.engine.core.errors import ConfigError, DatasetError
from octasplat.engine.geometry.mesh_material import FileImage
from octasplat.engine.pathtracing.bsdf_tables import albedo_table, rough_dielectric_table
from octasplat.engine.pathtracing.kernels.kernel_args import MaterialArrays
from octasplat.engine.pathtracing.kernels.principled_bsdf import BURLEY, COUPLED
from octasplat.engine.pathtracing.kernels.surface import DIFFUSE, EMITTER, GLASS, MIRROR, PRINCIPLED
from octasplat.engine.pathtracing.kernels.texture import TEXTURE_COLUMNS, WRAP_MODES
from octasplat.engine.pathtracing.lights import Opacity
from octasplat.engine.pathtracing.stage.materials import (
    ClearCoated,
    Dielectric,
    Diffuse,
    Emissive,
    Glass,
    Material,
    Metal,
    MetallicRoughness,
    Mirror,
    NormalMapped,
)
from octasplat.engine.render.image_files import read_image

MAX_TEXELS = 1 << 27
TextureUse = Literal["color", "light", "data", "alpha", "alpha or grey"]
"""What an image holds: display colors, display colors of light, or numbers that are taken as they are; or its
alpha is meant, of an image without one 1 everywhere or its first channel."""

_DEFAULTS: dict[str, np.ndarray] = {
    "kinds": np.array(DIFFUSE, np.int32),
    "colors_linear": np.ones(3),
    "metallic": np.array(0.0),
    "roughness": np.array(0.0),
    "iors": np.array(1.5),
    "absorption": np.zeros(3),
    "priorities": np.array(-1, np.int32),
    "substrates": np.array(COUPLED, np.int32),
    "energy_compensation": np.array(1, np.int32),
    "coat_tables": np.array(0, np.int32),
    "clear_coats": np.array(0.0),
    "clear_coat_roughness": np.array(0.0),
    "clear_coat_textures": np.array(-1, np.int32),
    "clear_coat_roughness_textures": np.array(-1, np.int32),
    "opacities": np.array(1.0),
    "opacity_textures": np.array(-1, np.int32),
    "opacity_cutoffs": np.array(-1.0),
    "uses_vertex_alpha": np.array(0, np.int32),
    "color_textures": np.array(-1, np.int32),
    "metallic_roughness_textures": np.array(-1, np.int32),
    "normal_textures": np.array(-1, np.int32),
    "normal_scales": np.array(1.0),
    "uses_vertex_color": np.array(0, np.int32),
    "light_ids": np.array(-1, np.int32),
}
"""What a material is where it says nothing else."""

OPACITY_COLUMNS = ("opacities", "opacity_textures", "opacity_cutoffs", "uses_vertex_alpha")


class MaterialTable:
    """Accumulator of materials as rows.

    Args:
        folder: where the names of images are relative to.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._rows: list[dict[str, object]] = []
        # the default, which Gaussians with materials and clear coats read too
        self._albedo_tables: list[tuple[str, float]] = [("coat", 1.5)]
        self._textures: dict[tuple[FileImage, TextureUse], int] = {}
        self._images: list[Float32[np.ndarray, "h w 3"]] = []
        self._sources: list[FileImage] = []

    def add(
        self,
        material: Material,
        label: str,
        *,
        has_uv: bool,
        uses_vertex_color: bool,
        uses_vertex_alpha: bool,
        images: Mapping[str, FileImage],
    ) -> int:
        """Add a material and return its row.

        Args:
            material: what to add.
            label: what errors call it.
            has_uv: whether the mesh has texture coordinates.
            uses_vertex_color: whether the colors of the mesh's corners count.
            uses_vertex_alpha: whether the alpha of these colors does.
            images: of a mesh file, by the names that the material has for them.

        Raises:
            ConfigError: an image is none, or the mesh has no texture coordinates for it.
        """
        row: dict[str, object] = {"uses_vertex_color": int(uses_vertex_color)}

        def texture(name: str | None, use: TextureUse) -> int:
            if name is None:
                return -1
            path = self._folder / name
            return self._texture_id(
                images.get(name) or FileImage(str(path), path.suffix, path=path), use, has_uv, label
            )

        if isinstance(material, Glass):
            color = material.tint_srgb
            row |= {"kinds": GLASS, "iors": material.ior, "absorption": material.absorption}
            row |= {"roughness": material.roughness, "energy_compensation": material.multiple_scattering}
            if material.priority is not None:
                row["priorities"] = material.priority
            if material.roughness > 0.0 and material.ior > 1.0:
                row["coat_tables"] = self._albedo_table_id("rough_dielectric", material.ior)
                # of leaving, in the place behind that of entering
                self._albedo_table_id("rough_dielectric", 1.0 / material.ior)
        else:
            color = material.color_srgb
            row["kinds"] = {Diffuse: DIFFUSE, Mirror: MIRROR}.get(type(material), PRINCIPLED)
        row["colors_linear"] = srgb_to_linear(np.array(color))  # tables and materials are linear
        if isinstance(material, Metal | Dielectric | MetallicRoughness):
            row["roughness"] = material.roughness
        if isinstance(material, Metal):
            row |= {"metallic": 1.0, "energy_compensation": material.multiple_scattering}
        if isinstance(material, MetallicRoughness):
            row |= {"metallic": material.metallic, "energy_compensation": material.multiple_scattering}
            row["substrates"] = BURLEY if material.diffuse == "burley" else COUPLED
            row["metallic_roughness_textures"] = texture(material.metallic_roughness_texture, "data")
        if isinstance(material, Dielectric | MetallicRoughness):
            row |= {"iors": material.ior, "coat_tables": self._albedo_table_id("coat", material.ior)}
        if isinstance(material, Diffuse | Dielectric | MetallicRoughness):
            row["color_textures"] = texture(material.texture, "color")
            row |= _opacity_columns(material, uses_vertex_alpha, texture)
        if isinstance(material, ClearCoated):
            row |= {"clear_coats": material.clear_coat, "clear_coat_roughness": material.clear_coat_roughness}
            row["clear_coat_textures"] = texture(material.clear_coat_texture, "data")
            row["clear_coat_roughness_textures"] = texture(material.clear_coat_roughness_texture, "data")
        if isinstance(material, NormalMapped):
            row["normal_textures"] = texture(material.normal_texture, "data")
            row["normal_scales"] = material.normal_scale
        if isinstance(material, Emissive):
            row["emission"] = texture(material.emission_texture, "light")
        self._rows.append(row)
        return len(self._rows) - 1

    def add_light(self, light_id: int) -> int:
        """Add the surface of a light and return its row."""
        self._rows.append({"kinds": EMITTER, "light_ids": light_id})
        return len(self._rows) - 1

    def set_emissive(self, row: int, light_id: int) -> tuple[int, Opacity]:
        """Make a row emissive as well; return the texture of its emission, -1 for none, and its opacity."""
        self._rows[row]["light_ids"] = light_id
        values = self._rows[row]
        texture = values["emission"]
        assert isinstance(texture, int)
        return texture, Opacity(*(values[name] for name in OPACITY_COLUMNS))  # type: ignore[arg-type]

    def arrays(self) -> MaterialArrays:
        """Return all rows as arrays."""
        count = len(self._rows)
        columns = {
            name: np.array([row.get(name, default) for row in self._rows], default.dtype).reshape(
                count, *default.shape
            )
            for name, default in _DEFAULTS.items()
        }
        tables = [
            albedo_table(ior) if kind == "coat" else rough_dielectric_table(ior)
            for kind, ior in self._albedo_tables
        ]
        sizes = np.zeros((len(self._images), TEXTURE_COLUMNS), np.int64)
        first = 0
        for k, (source, image) in enumerate(zip(self._sources, self._images, strict=True)):
            wraps = [WRAP_MODES.index(wrap) for wrap in source.wrap]
            sizes[k] = first, *image.shape[:2], *wraps, source.is_blocky
            first += image.shape[0] * image.shape[1]
        texels = np.concatenate([np.zeros((0, 3), np.float32), *(i.reshape(-1, 3) for i in self._images)])
        return MaterialArrays(
            **columns,
            ggx_albedo=albedo_table(None).directional,
            coat_albedo=np.stack([table.directional for table in tables]),
            coat_mean_albedo=np.stack([table.mean for table in tables]),
            texels_linear=texels,
            texture_sizes=sizes,
        )

    def _albedo_table_id(self, kind: str, ior: float) -> int:
        """Return the index of a table; a rough dielectric's table for leaving light follows its own."""
        if kind == "coat" and (kind, ior) in self._albedo_tables:
            return self._albedo_tables.index((kind, ior))
        self._albedo_tables.append((kind, ior))
        return len(self._albedo_tables) - 1

    def _texture_id(self, image: FileImage, use: TextureUse, has_uv: bool, label: str) -> int:
        """Return the index of a texture, converted to linear unless the image is linear already."""
        if not has_uv:
            raise ConfigError(f"{label}: {image.name} needs texture coordinates, which the mesh lacks.")
        if (image, use) not in self._textures:
            try:
                values = _read_pixels(image)
            except DatasetError as error:
                raise ConfigError(f"{label}: {error}") from None
            rgb = _channels_of_use(values, use)
            if use in ("color", "light") and image.suffix.lower() not in (".exr", ".hdr"):
                rgb = srgb_to_linear(rgb)
            if not np.isfinite(rgb).all():
                raise ConfigError(f"{label}: {image.name} holds values that are not finite; mend the image.")
            self._textures[image, use] = len(self._images)
            most = None if use == "light" else 1.0  # reflectances are at most 1, light is not limited
            self._images.append(np.ascontiguousarray(np.clip(rgb, 0.0, most), np.float32))
            self._sources.append(image)
            if sum(i.shape[0] * i.shape[1] for i in self._images) > MAX_TEXELS:
                raise ConfigError(
                    f"{image.name}: the textures have more than {MAX_TEXELS >> 20} million pixels together."
                )
        return self._textures[image, use]


def _opacity_columns(
    material: Diffuse | Dielectric | MetallicRoughness,
    uses_vertex_alpha: bool,
    texture: Callable[[str | None, TextureUse], int],
) -> dict[str, object]:
    """Return the columns of what is there of a surface; ``texture`` gives the number of an image."""
    is_own = material.opacity_texture == material.texture
    image = texture(material.opacity_texture, "alpha" if is_own else "alpha or grey")
    opacity, cutoff = material.opacity, material.opacity_cutoff
    # one number and a cutoff: all of it or nothing
    if image < 0 and not uses_vertex_alpha and cutoff is not None:
        opacity, cutoff = float(opacity >= cutoff), None
    values = (opacity, image, -1.0 if cutoff is None else cutoff, int(uses_vertex_alpha))
    return dict(zip(OPACITY_COLUMNS, values, strict=True))


def _channels_of_use(values: Float32[np.ndarray, "h w c"], use: TextureUse) -> Float32[np.ndarray, "h w 3"]:
    """Return the three channels of an image that are meant; a single one thrice."""
    count = values.shape[2]
    if use in ("alpha", "alpha or grey"):
        if count in (2, 4):
            return np.repeat(values[..., -1:], 3, axis=2)
        return np.ones((*values.shape[:2], 3), np.float32) if use == "alpha" else _repeated_grey(values)
    return values[..., :3] if count >= 3 else _repeated_grey(values)


def _repeated_grey(values: Float32[np.ndarray, "h w c"]) -> Float32[np.ndarray, "h w 3"]:
    return np.repeat(values[..., :1], 3, axis=2)


def _read_pixels(image: FileImage) -> Float32[np.ndarray, "h w c"]:
    """Return the pixels of an image, from memory or from its file."""
    if image.path is not None:
        return read_image(image.path)
    with tempfile.TemporaryDirectory(prefix="octasplat-") as folder:
        path = Path(folder) / f"image{image.suffix}"
        path.write_bytes(image.content or b"")
        try:
            return read_image(path)
        except DatasetError:
            raise DatasetError(f"{image.name} cannot be read as an image.") from None

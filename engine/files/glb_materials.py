"""The materials of a GLB, as far as they are understood.

glTF 2.0 (https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html) and its extensions
``KHR_materials_clearcoat``, ``_emissive_strength``, ``_ior``, ``_transmission``, ``_unlit``, ``_volume`` and
``KHR_texture_transform``.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.files.glb_container import GlbFile
from octasplat.engine.geometry.mesh_material import FileImage, MeshMaterial, Wrap

SUPPORTED_EXTENSIONS = ("clearcoat", "emissive_strength", "ior", "transmission", "unlit", "volume")
SUFFIXES = {"image/png": ".png", "image/jpeg": ".jpg", "image/webp": ".webp"}
KINDS = {b"\x89PNG": ".png", b"\xff\xd8\xff": ".jpg", b"RIFF": ".webp"}
REPEAT = 10497
WRAPS: Mapping[int, Wrap] = {REPEAT: "repeat", 33071: "clamp", 33648: "mirror"}
NEAREST = 9728
PARTLY_SUPPORTED_EXTENSIONS = {
    "clearcoatNormalTexture", "thicknessTexture", "transmissionTexture"
}  # fmt: skip


def glb_materials(file: GlbFile, path: Path) -> tuple[MeshMaterial, ...]:
    """Return all materials of a file, in its order.

    Raises:
        SceneFileError: an image is missing or stored in a way that is not read.
        KeyError, IndexError, TypeError, ValueError, AttributeError: the document is damaged.
    """
    return tuple(
        _MaterialReader(file, path, material).read(number)
        for number, material in enumerate(file.document.get("materials", []))
    )


def texture_frame(material: Mapping[str, Any]) -> tuple[int, Float64[np.ndarray, "2 3"]]:
    """Return the texture coordinate set of a material, and the matrix from it to image coordinates."""
    # The first texture decides; others with other coordinates are told as unsupported.
    for info in _texture_infos(material).values():
        transform = info.get("extensions", {}).get("KHR_texture_transform", {})
        turn = float(transform.get("rotation", 0.0))
        (x, y), (u, v) = transform.get("scale", (1.0, 1.0)), transform.get("offset", (0.0, 0.0))
        # uv' = offset + rotation . scale . uv
        matrix = np.array(
            [
                [math.cos(turn) * x, math.sin(turn) * y, u],
                [-math.sin(turn) * x, math.cos(turn) * y, v],
            ],
            np.float64,
        )
        return int(transform.get("texCoord", info.get("texCoord", 0))), matrix
    return 0, np.eye(2, 3)


def _texture_infos(material: Mapping[str, Any]) -> dict[str, Any]:
    """Return the texture references of a material by name, base color first."""
    shading = material.get("pbrMetallicRoughness", {})
    coat = material.get("extensions", {}).get("KHR_materials_clearcoat", {})
    found = {
        "texture": shading.get("baseColorTexture"),
        "metallic_roughness_texture": shading.get("metallicRoughnessTexture"),
        "normal_texture": material.get("normalTexture"),
        "emission_texture": material.get("emissiveTexture"),
        "clear_coat_texture": coat.get("clearcoatTexture"),
        "clear_coat_roughness_texture": coat.get("clearcoatRoughnessTexture"),
    }
    return {name: info for name, info in found.items() if info is not None}


class _MaterialReader:
    """One material on its way."""

    def __init__(self, file: GlbFile, path: Path, material: dict[str, Any]) -> None:
        self._file, self._path, self._material = file, path, material
        self._name = str(material.get("name") or "")
        self._extensions = {
            name.removeprefix("KHR_materials_"): values
            for name, values in material.get("extensions", {}).items()
        }

    def read(self, number: int) -> MeshMaterial:
        material, extensions = self._material, self._extensions
        shading = material.get("pbrMetallicRoughness", {})
        unlit = "unlit" in extensions
        strength = float(extensions.get("emissive_strength", {}).get("emissiveStrength", 1.0))
        red, green, blue = (
            strength * float(share) for share in material.get("emissiveFactor", (0.0, 0.0, 0.0))
        )
        base = [float(value) for value in shading.get("baseColorFactor", (1.0, 1.0, 1.0, 1.0))]
        images = {name: self._read_texture_image(info) for name, info in _texture_infos(material).items()}
        return MeshMaterial(
            self._name or f"material {number}",
            (base[0], base[1], base[2]),
            metallic=0.0 if unlit else float(shading.get("metallicFactor", 1.0)),
            roughness=1.0 if unlit else float(shading.get("roughnessFactor", 1.0)),
            emission_linear=(red, green, blue),
            normal_scale=float(material.get("normalTexture", {}).get("scale", 1.0)),
            transmission=float(extensions.get("transmission", {}).get("transmissionFactor", 0.0)),
            ior=float(extensions.get("ior", {}).get("ior", 1.5)),
            absorption=self._absorption_coefficients(),
            clear_coat=float(extensions.get("clearcoat", {}).get("clearcoatFactor", 0.0)),
            clear_coat_roughness=float(extensions.get("clearcoat", {}).get("clearcoatRoughnessFactor", 0.0)),
            coat_has_normal_texture=self._coat_has_normal_texture(),
            **self._opacity(number, base[3], images.get("texture")),
            unsupported=self._unsupported_features(),
            **images,  # type: ignore[arg-type]
        )

    def _coat_has_normal_texture(self) -> bool:
        """Return whether the normal texture of the clear coat is that of what is below."""
        coat = self._extensions.get("clearcoat", {}).get("clearcoatNormalTexture")
        usual = {"scale": 1.0, "texCoord": 0}
        below = self._material.get("normalTexture", {})
        return coat is not None and bool(usual | coat == usual | below)

    def _absorption_coefficients(self) -> tuple[float, float, float]:
        """Return the absorption of the volume, from its attenuation distance and color."""
        volume = self._extensions.get("volume", {})
        distance = float(volume.get("attenuationDistance", math.inf))
        left = [float(share) for share in volume.get("attenuationColor", (1.0, 1.0, 1.0))]
        # A surface without thickness encloses no volume.
        if not (volume.get("thicknessFactor", 0.0) > 0.0 and 0.0 < distance < math.inf):
            return 0.0, 0.0, 0.0
        # Beer-Lambert law: the color is what is left after the distance.
        red, green, blue = (-math.log(min(max(share, 1e-6), 1.0)) / distance for share in left)
        return red, green, blue

    def _alpha_mode(self) -> str:
        return str(self._material.get("alphaMode", "OPAQUE"))

    def _opacity(self, number: int, factor: float, texture: FileImage | None) -> dict[str, Any]:
        """Return what of a :class:`MeshMaterial` says where the surface is, by its alpha."""
        mode = self._alpha_mode()
        if mode not in ("MASK", "BLEND"):
            return {}
        cutoff = float(self._material.get("alphaCutoff", 0.5)) if mode == "MASK" else None
        return {
            "opacity": factor,
            "opacity_texture": texture,
            "opacity_cutoff": cutoff,
            "uses_vertex_alpha": self._has_vertex_alpha(number),
        }

    def _has_vertex_alpha(self, number: int) -> bool:
        """Return whether some vertices with this material have colors with an alpha below 1."""
        for mesh in self._file.document.get("meshes", []):
            for primitive in mesh.get("primitives", []):
                color = primitive.get("attributes", {}).get("COLOR_0")
                if primitive.get("material") == number and color is not None:
                    values = self._file.array(color, np.float32)
                    if values.shape[1] == 4 and (values[:, 3] < 1.0).any():
                        return True
        return False

    def _unsupported_features(self) -> tuple[str, ...]:
        """Return what is not understood, in words."""
        material = self._material
        found = [
            name if "_" in name and name[:3].isupper() else f"KHR_materials_{name}"
            for name in self._extensions
            if name not in SUPPORTED_EXTENSIONS
        ]
        mode = self._alpha_mode()
        if mode not in ("OPAQUE", "MASK", "BLEND"):
            found.append(f"alphaMode {mode}")
        if "occlusionTexture" in material:
            found.append("occlusionTexture")
        for values in self._extensions.values():
            found += sorted(PARTLY_SUPPORTED_EXTENSIONS & set(values))
        if self._coat_has_normal_texture():
            found.remove("clearcoatNormalTexture")
        infos = list(_texture_infos(material).values())
        if len({(i.get("texCoord", 0), str(i.get("extensions"))) for i in infos}) > 1:
            found.append("other texture coordinates than those of its first texture")
        return tuple(found)

    def _read_texture_image(self, info: dict[str, Any]) -> FileImage:
        document = self._file.document
        texture = document["textures"][info["index"]]
        source = texture.get("source")
        webp = texture.get("extensions", {}).get("EXT_texture_webp", {}).get("source")
        if source is None and webp is None:
            packed = ", ".join(texture.get("extensions", {})) or "no source"
            raise SceneFileError(
                f"{self._path}: a texture of {self._name or 'a material'} is stored in a way that is not "
                f"read ({packed}); export it with PNG or JPEG images."
            )
        image = document["images"][source if source is not None else webp]
        if "bufferView" not in image:
            raise SceneFileError(
                f"{self._path}: the image {str(image.get('uri'))[:60]} lies outside of the file; export the "
                "GLB with its images inside."
            )
        content = self._file.view_bytes(image["bufferView"])
        # By its first bytes, as the stated type may be wrong
        kind = next((suffix for start, suffix in KINDS.items() if content.startswith(start)), "")
        suffix = kind or SUFFIXES.get(image.get("mimeType", ""), ".png")
        name = f"{self._path} (image {image.get('name') or info['index']})"
        sampler = document["samplers"][texture["sampler"]] if "sampler" in texture else {}
        wrap = (
            WRAPS.get(sampler.get("wrapS", REPEAT), "repeat"),
            WRAPS.get(sampler.get("wrapT", REPEAT), "repeat"),
        )
        is_blocky = sampler.get("magFilter") == NEAREST
        return FileImage(name, suffix, content=content, wrap=wrap, is_blocky=is_blocky)

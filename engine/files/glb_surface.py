"""Surfaces as binary glTF: normals, and a texture, materials or the colors of the vertices."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from octasplat.engine.core.color import srgb_to_linear
from octasplat.engine.files import glb_container
from octasplat.engine.files.glb_container import pad_to_four, write_glb
from octasplat.engine.files.glb_place import HALF_TURN_ABOUT_X, root_place, upright_root
from octasplat.engine.files.textures import png_bytes
from octasplat.engine.geometry.triangle_mesh import TriangleMesh

UNLIT = "KHR_materials_unlit"
SAMPLER = {
    "magFilter": glb_container.LINEAR,
    "minFilter": glb_container.LINEAR_MIPMAP_LINEAR,
    "wrapS": glb_container.CLAMP_TO_EDGE,
    "wrapT": glb_container.CLAMP_TO_EDGE,
}


def write_surface(
    mesh: TriangleMesh, path: Path, turn_xyzw: Sequence[float] | None = None
) -> tuple[Path, ...]:
    """Write a surface with normals and with a texture or the colors of its vertices.

    Unlit, unless it has materials: then these are textures beside the base color's, tangents say how its
    normals lie, and the root node turns the light's up to y and its forward to x, which is how environments
    lie in glTF's viewers and in Blender.

    Args:
        mesh: the surface.
        path: the file.
        turn_xyzw: rotation of the root node of what is not lit, which turns the scene upright; None is a half
            turn about x.

    Raises:
        SceneFileError: more than the 4 GiB that a GLB can hold.
        OSError: the file cannot be written.
    """
    attributes = {"POSITION": mesh.vertices_world, "NORMAL": mesh.vertex_normals()}
    data = _SurfaceData()
    shading: dict[str, object] = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    material: dict[str, object] = {"name": "surface", "pbrMetallicRoughness": shading, "doubleSided": True}
    node: dict[str, Any] = {"name": "surface", "rotation": HALF_TURN_ABOUT_X, "mesh": 0}
    document: dict[str, object] = {
        "asset": {"version": "2.0", "generator": "octasplat"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
        "materials": [material],
    }
    if mesh.materials is None:
        document["extensionsUsed"] = [UNLIT]
        material["extensions"] = {UNLIT: {}}
    else:
        attributes["TANGENT"] = mesh.materials.tangents
        node["rotation"] = glb_container.light_rotation(mesh.materials.light_frame)
    if turn_xyzw is not None and mesh.materials is None:
        node |= upright_root(turn_xyzw, mesh.origin_world, mesh.georeference)
    else:
        node |= root_place(mesh.origin_world, mesh.georeference, node["rotation"])
    if mesh.texture_srgb is not None and mesh.uv is not None:
        attributes["TEXCOORD_0"] = mesh.uv
        shading["baseColorTexture"] = data.texture("surface", mesh.texture_srgb)
        if mesh.materials is not None:
            shading["metallicFactor"] = 1.0
            # With factors of 1, the values of the texture count as they are.
            packed = data.texture("materials", mesh.materials.occlusion_roughness_metallic)
            shading["metallicRoughnessTexture"] = packed
            material["occlusionTexture"] = packed
            material["normalTexture"] = data.texture("normals", mesh.materials.normals)
        document |= {"textures": data.textures, "samplers": [SAMPLER], "images": data.images}
    elif mesh.rgb_srgb is not None:
        attributes["COLOR_0"] = srgb_to_linear(mesh.rgb_srgb)  # glTF has linear vertex colors
    used, accessors = _add_accessors(mesh, attributes, data)
    document |= {
        "meshes": [
            {
                "name": "surface",
                "primitives": [{"attributes": used, "indices": len(accessors) - 1, "material": 0}],
            }
        ],
        "accessors": accessors,
        "bufferViews": data.views,
        "buffers": [{"byteLength": data.length}],
    }
    text = glb_container.json_bytes(document)
    room = pad_to_four(len(text))
    if glb_container.glb_size(room, data.length) > glb_container.MAX_BYTES:
        advice = "Decimate it with --max-triangles, or name a .ply."
        raise glb_container.too_large_error(
            path, "the surface needs", glb_container.glb_size(room, data.length), advice
        )
    write_glb(path, room, data.length, data.pieces, lambda: text)
    return (path,)


class _SurfaceData:
    """The binary part of a surface as it grows, and what the document says of it.

    Attributes:
        pieces: in the order of the file.
        length: bytes of all pieces.
        views: of the buffer.
        textures: of the document.
        images: likewise.
    """

    def __init__(self) -> None:
        self.pieces: list[bytes] = []
        self.length = 0
        self.views: list[dict[str, object]] = []
        self.textures: list[dict[str, object]] = []
        self.images: list[dict[str, object]] = []

    def add(self, piece: bytes, target: int | None = None) -> int:
        """Add a buffer view and return its number."""
        self.views.append({"buffer": 0, "byteOffset": self.length, "byteLength": len(piece)})
        if target is not None:
            self.views[-1]["target"] = target
        # so that each view begins at a multiple of four bytes
        self.pieces.append(piece.ljust(pad_to_four(len(piece)), b"\0"))
        self.length += len(self.pieces[-1])
        return len(self.views) - 1

    def texture(self, name: str, pixels: UInt8[np.ndarray, "h w 3"]) -> dict[str, object]:
        """Add an image and return how a material names it."""
        view = self.add(png_bytes(pixels))
        self.images.append({"name": name, "mimeType": "image/png", "bufferView": view})
        self.textures.append({"sampler": 0, "source": len(self.images) - 1})
        return {"index": len(self.textures) - 1}


def _add_accessors(
    mesh: TriangleMesh, attributes: Mapping[str, np.ndarray], data: _SurfaceData
) -> tuple[dict[str, int], list[dict[str, object]]]:
    """Add the vertices' attributes and then the faces to ``data``.

    Returns:
        The number of the accessor of each attribute, and the accessors; the last one is that of the faces.
    """
    accessors: list[dict[str, object]] = []
    used: dict[str, int] = {}
    for semantic, values in attributes.items():
        view = data.add(np.ascontiguousarray(values, "<f4").tobytes(), glb_container.ARRAY_BUFFER)
        used[semantic] = len(accessors)
        accessors.append(
            glb_container.accessor_json(
                view, glb_container.FLOAT, len(values), glb_container.vector_type(values.shape[1])
            )
        )
    accessors[0] |= {  # glTF requires the bounds of positions
        "min": mesh.vertices_world.min(axis=0).tolist(),
        "max": mesh.vertices_world.max(axis=0).tolist(),
    }
    view = data.add(mesh.faces.astype("<u4").tobytes(), glb_container.ELEMENT_ARRAY_BUFFER)
    accessors.append(glb_container.accessor_json(view, glb_container.UNSIGNED_INT, mesh.faces.size, "SCALAR"))
    return used, accessors

"""A surface as GLB, PLY or OBJ; the suffix says which."""

import json
import struct
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from engine.colour import srgb_to_linear, to_bytes
from engine.errors import ConfigError, SceneFileError
from engine.files.ply_container import COUNT_SUFFIX, PlyWriteElement, list_field, write_ply
from engine.surface.mesh import TriangleMesh
from engine.writing import replacing

MAX_GLB_BYTES = 2**32 - 1
ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963
FLOAT, UNSIGNED_INT = 5126, 5125
LINES_AT_ONCE = 100_000
HALF_TURN_ABOUT_X = [1.0, 0.0, 0.0, 0.0]
"""x, y, z, w; brings COLMAP's frame (y down, z forward) to glTF's (y up)."""


def check_surface_path(path: Path, *, textured: bool) -> None:
    """Refuse names that no writer takes, before the long work.

    Raises:
        ConfigError: the suffix is unknown, or cannot hold a texture.
    """
    suffix = path.suffix.lower()
    if suffix not in _WRITERS:
        raise ConfigError(f"{path}: a surface is written as .glb, .ply or .obj; name one of these.")
    if textured and suffix == ".ply":
        raise ConfigError(f"{path}: a PLY holds no texture; name a .glb or .obj, or leave the texture out.")


def write_surface(mesh: TriangleMesh, path: Path) -> tuple[Path, ...]:
    """Write ``mesh`` and return every file written, ``path`` first.

    GLB: unlit, the colours being those of the photographs with their light; normals are there for who wants
    to light it anew. Its root node turns COLMAP's frame to glTF's. PLY and OBJ keep the world frame. OBJ
    with vertex colours writes them behind the positions; with a texture, an MTL and a PNG lie beside it.

    Raises:
        ConfigError: the suffix does not fit.
        SceneFileError: the file cannot be written.
    """
    check_surface_path(path, textured=mesh.texture_srgb is not None)
    try:
        return _WRITERS[path.suffix.lower()](mesh, path)
    except OSError as error:
        raise SceneFileError(f"{path}: cannot be written ({error.strerror or error}).") from error


def _write_glb(mesh: TriangleMesh, path: Path) -> tuple[Path, ...]:
    normals = mesh.vertex_normals()
    attributes = {"POSITION": mesh.vertices_world, "NORMAL": normals}
    material: dict[str, object] = {
        "name": "surface",
        "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0},
        "extensions": {"KHR_materials_unlit": {}},
        "doubleSided": True,
    }
    parts: list[bytes] = []
    views: list[dict[str, object]] = []

    def add(data: bytes, target: int | None = None) -> int:
        offset = sum(len(part) for part in parts)
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": len(data)})
        if target is not None:
            views[-1]["target"] = target
        parts.append(data + b"\0" * (-len(data) % 4))
        return len(views) - 1

    document: dict[str, object] = {
        "asset": {"version": "2.0", "generator": "octasplat"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "surface", "rotation": HALF_TURN_ABOUT_X, "mesh": 0}],
        "materials": [material],
    }
    if mesh.texture_srgb is not None and mesh.uv is not None:
        attributes["TEXCOORD_0"] = mesh.uv
        image = add(_png_bytes(mesh.texture_srgb))
        document |= {
            "textures": [{"sampler": 0, "source": 0}],
            "samplers": [{"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}],
            "images": [{"name": "surface", "mimeType": "image/png", "bufferView": image}],
        }
        material["pbrMetallicRoughness"] = {
            "metallicFactor": 0.0, "roughnessFactor": 1.0, "baseColorTexture": {"index": 0},
        }  # fmt: skip
    elif mesh.rgb_srgb is not None:
        attributes["COLOR_0"] = srgb_to_linear(mesh.rgb_srgb)
    accessors: list[dict[str, object]] = []
    used: dict[str, int] = {}
    for semantic, values in attributes.items():
        view = add(np.ascontiguousarray(values, "<f4").tobytes(), ARRAY_BUFFER)
        used[semantic] = len(accessors)
        accessors.append(
            {
                "bufferView": view,
                "componentType": FLOAT,
                "count": len(values),
                "type": f"VEC{values.shape[1]}",
            }
        )
    accessors[0] |= {
        "min": mesh.vertices_world.min(axis=0).tolist(),
        "max": mesh.vertices_world.max(axis=0).tolist(),
    }
    view = add(mesh.faces.astype("<u4").tobytes(), ELEMENT_ARRAY_BUFFER)
    accessors.append(
        {"bufferView": view, "componentType": UNSIGNED_INT, "count": mesh.faces.size, "type": "SCALAR"}
    )
    primitive = {"attributes": used, "indices": len(accessors) - 1, "material": 0}
    length = sum(len(part) for part in parts)
    document |= {
        "meshes": [{"name": "surface", "primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": length}],
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    total = 12 + 8 + len(text) + 8 + length
    if total > MAX_GLB_BYTES:
        raise SceneFileError(
            f"{path}: not written; the surface needs {total / 2**30:.1f} GiB, and a GLB holds at most 4. "
            "Decimate it with --max-triangles, or name a .ply."
        )
    with replacing(path) as temporary, temporary.open("wb") as handle:
        handle.write(struct.pack("<4sII", b"glTF", 2, total) + struct.pack("<I4s", len(text), b"JSON") + text)
        handle.write(struct.pack("<I4s", length, b"BIN\0"))
        handle.writelines(parts)
    return (path,)


def _write_ply(mesh: TriangleMesh, path: Path) -> tuple[Path, ...]:
    fields = [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")]
    colours = ("red", "green", "blue")
    rows = np.empty(
        len(mesh.vertices_world),
        dtype=fields + ([(c, "u1") for c in colours] if mesh.rgb_srgb is not None else []),
    )
    vectors = np.concatenate([mesh.vertices_world, mesh.vertex_normals()], axis=1)
    for column, (name, _) in enumerate(fields):
        rows[name] = vectors[:, column]
    if mesh.rgb_srgb is not None:
        for column, name in enumerate(colours):
            rows[name] = to_bytes(mesh.rgb_srgb[:, column])
    triangles = np.empty(len(mesh.faces), dtype=list_field("vertex_indices", "i4", 3))
    triangles["vertex_indices"] = mesh.faces
    triangles["vertex_indices" + COUNT_SUFFIX] = 3
    write_ply(
        path,
        [
            PlyWriteElement("vertex", len(rows), rows.dtype, [rows]),
            PlyWriteElement("face", len(triangles), triangles.dtype, [triangles]),
        ],
        ["octasplat surface"],
    )
    return (path,)


def _write_obj(mesh: TriangleMesh, path: Path) -> tuple[Path, ...]:
    head, files = "# octasplat surface\n", [path]
    if mesh.texture_srgb is not None:
        material, image = path.with_suffix(".mtl"), path.with_suffix(".png")
        with replacing(image) as temporary:
            temporary.write_bytes(_png_bytes(mesh.texture_srgb))
        with replacing(material) as temporary:
            temporary.write_text(
                f"newmtl surface\nKa 0 0 0\nKd 1 1 1\nKs 0 0 0\nillum 0\nmap_Kd {image.name}\n",
                encoding="utf-8",
            )
        head += f"mtllib {material.name}\nusemtl surface\n"
        files += [material, image]
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8") as handle:
        handle.write(head)
        vertices = (
            mesh.vertices_world if mesh.rgb_srgb is None else np.hstack([mesh.vertices_world, mesh.rgb_srgb])
        )
        _write_lines(handle.write, "v %.7g %.7g %.7g" + " %.4g" * (vertices.shape[1] - 3), vertices)
        numbers = mesh.faces.astype(np.int64) + 1
        if mesh.uv is None:
            _write_lines(handle.write, "f %d %d %d", numbers)
        else:
            _write_lines(handle.write, "vt %.7g %.7g", mesh.uv * [1, -1] + [0, 1])  # from the lower left
            _write_lines(handle.write, "f %d/%d %d/%d %d/%d", np.repeat(numbers, 2, axis=1))
    return tuple(files)


def _write_lines(write: Callable[[str], object], line: str, rows: np.ndarray) -> None:
    for start in range(0, len(rows), LINES_AT_ONCE):
        part = rows[start : start + LINES_AT_ONCE]
        write((line + "\n") * len(part) % tuple(part.reshape(-1).tolist()))


def _png_bytes(texture_srgb: np.ndarray) -> bytes:
    from engine.render.images import write_png  # loads the image library, which the front end has not

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "texture.png"
        write_png(path, texture_srgb.astype(np.float32) / np.float32(255))
        return path.read_bytes()


_WRITERS: dict[str, Callable[[TriangleMesh, Path], tuple[Path, ...]]] = {
    ".glb": _write_glb,
    ".ply": _write_ply,
    ".obj": _write_obj,
}

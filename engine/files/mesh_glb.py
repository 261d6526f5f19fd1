"""Meshes as binary glTF: octagons of a scene out, edited meshes in with their ids kept.

Octagons: the format to look at, as it carries color, opacity and the Gaussian fall-off. Base color = white
texture with radial alpha x COLOR_0, so that alpha = opacity * exp(-rho^2 / 2) at every pixel (to the 8 bits
of the texture). COLOR_0 is float32, as some programs misread 16-bit colors and 8-bit linear colors are too
coarse in the dark. Vertices stay in the world frame of COLMAP (y down, z forward); a half turn about x in the
root node brings them to glTF's (y up). The scene is cut into spatial chunks, each with its own node, because
viewers sort transparent objects, not triangles.

The lit variant has the base color of the materials in place of the color, normals, and second texture
coordinates that look metallic and roughness up in an image which holds all pairs: so every Gaussian has its
own, to 8 bits, though glTF has one material for all. Light falls on it as viewers lay it, so its root node
turns the light's up to y; it carries no ids, as it is not what edits come from.

The opaque variant needs no sorting: alpha is cut at a threshold (``alphaMode`` MASK), and each octagon
shrinks to the ellipse that is left of it.
"""

import itertools
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, Int, Int32, Int64

from octasplat.engine.core.color import srgb_to_linear
from octasplat.engine.core.errors import ConfigError, SceneFileError
from octasplat.engine.files import glb_container, glb_parts
from octasplat.engine.files.export_options import ExportOptions
from octasplat.engine.files.glb_container import GlbFile, channel_attributes, pad_to_four, write_glb
from octasplat.engine.files.glb_materials import glb_materials, texture_frame
from octasplat.engine.files.glb_surface import write_surface
from octasplat.engine.files.kd_split import kd_split
from octasplat.engine.files.octagon_batches import OctagonBatch, OctagonSoup
from octasplat.engine.files.octagon_glb_layout import OPAQUE_CUTOFF, Bounds, GlbLayout
from octasplat.engine.files.registry import Exporter, MeshReader, SurfaceWriter, register
from octasplat.engine.files.textures import (
    material_ramp_png,
    material_ramp_uv,
    white_with_alpha_png,
)
from octasplat.engine.gaussians.channels import Channels
from octasplat.engine.gaussians.materials import ALBEDO, METALLIC, ROUGHNESS, has_materials
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.octagon import SIDES, octagon_triangles
from octasplat.engine.geometry.imported_mesh import (
    ALPHA_CUTOFF_KEY,
    MIN_OPACITY_KEY,
    Q_KEY,
    SCENE_SIZE_KEY,
    ImportedMesh,
    scene_size_of,
)

COMPRESSIONS = ("KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression")
VIEWER_FORMAT = "viewer-glb"
CORES_OF_CHUNKS, CORES_IN_ORDER = 0.3, 0.5
"""From which alpha on octagons are drawn solid for viewers, in chunks and in one order
(docs/opening/threejs.md)."""
TRIANGLE_MODES = (
    glb_container.TRIANGLES, glb_container.TRIANGLE_STRIP, glb_container.TRIANGLE_FAN,
)  # fmt: skip
ATTRIBUTES = {"uv": "TEXCOORD_0", "gid": "_GID", "corner": "_CORNER", "radius": "_RADIUS"}
MATERIAL_ATTRIBUTES = {"normal": "NORMAL", "color": "COLOR_0", "alpha": "COLOR_0"}
ATTRIBUTE_WIDTHS = {"uv": 2, "normal": 3, "color": 3}
ChunkIndices = list[Int[np.ndarray, "_"]]


def read(path: Path) -> ImportedMesh:
    """Read the triangles of a GLB, in the frame of its scene, in which glTF says that y is up.

    All triangles of the default scene, with node transforms applied.

    Raises:
        SceneFileError: the file is no GLB, is damaged, or its meshes are compressed.
    """
    return _read(path, with_materials=False)


def read_with_materials(path: Path) -> ImportedMesh:
    """Read the triangles of a GLB with materials, normals and colors.

    Raises:
        SceneFileError: likewise, or an image is missing.
    """
    return _read(path, with_materials=True)


def _read(path: Path, *, with_materials: bool) -> ImportedMesh:
    file = GlbFile(path)
    try:
        packed = [name for name in COMPRESSIONS if name in file.document.get("extensionsUsed", [])]
        if packed:
            raise SceneFileError(
                f"{path}: its meshes are compressed ({packed[0]}), which changes the order of vertices; "
                "export it without compression."
            )
        mesh, numbers = _read_triangles(file, with_materials=with_materials)
        if not with_materials:
            return mesh
        uv = None if mesh.uv is None else mesh.uv[mesh.triangles]
        return replace(
            mesh,
            corner_uv=uv,
            material_indices=numbers,
            materials=glb_materials(file, path),
            notes=_notes(file.document),
        )
    except glb_container.GLB_READ_ERRORS as error:
        raise SceneFileError(f"{path}: its glTF is damaged or not understood ({error}).") from error


def _notes(document: dict[str, Any]) -> tuple[str, ...]:
    """Return sentences on what of the shape of a file is passed over."""
    nodes = [node for node in document.get("nodes", []) if "mesh" in node]
    weights = [part.get("weights", ()) for part in (*nodes, *document.get("meshes", []))]
    found = {
        "Its bones (skins) are passed over: its vertices stay where they lie.": any(
            "skin" in node for node in nodes
        ),
        "Its morph targets are passed over: its vertices stay where they lie.": any(map(any, weights)),
        "Its lamps (KHR_lights_punctual) are passed over: those of the stage light it.": any(
            "KHR_lights_punctual" in node.get("extensions", {}) for node in document.get("nodes", [])
        ),
        "Copies of its meshes (EXT_mesh_gpu_instancing) are passed over: each is shown once.": any(
            "EXT_mesh_gpu_instancing" in node.get("extensions", {}) for node in nodes
        ),
    }
    return tuple(sentence for sentence, is_there in found.items() if is_there)


def _read_triangles(file: GlbFile, *, with_materials: bool) -> tuple[ImportedMesh, Int32[np.ndarray, " t"]]:
    """Return all triangles, and the material index of each."""
    vertices: list[np.ndarray] = []
    triangles: list[np.ndarray] = []
    numbers: list[np.ndarray] = []
    names = ATTRIBUTES | (MATERIAL_ATTRIBUTES if with_materials else {})
    extras: dict[str, list[np.ndarray]] = {key: [] for key in names}
    count = 0
    for matrix, primitive in file.primitives():
        mode = primitive.get("mode", glb_container.TRIANGLES)
        if mode not in TRIANGLE_MODES:
            continue
        attributes = primitive["attributes"]
        positions = file.array(attributes["POSITION"], np.float64)
        size = len(positions)
        vertices.append(positions @ matrix[:3, :3].T + matrix[:3, 3])
        if "indices" in primitive:
            corners = file.array(primitive["indices"], np.int64).reshape(-1)
        else:
            corners = np.arange(size - size % 3 if mode == glb_container.TRIANGLES else size)
        indices = _triangles_of(corners, mode)
        # A node that mirrors turns the winding of its triangles over.
        mirrored = with_materials and np.linalg.det(matrix[:3, :3]) < 0
        triangles.append((indices[:, ::-1] if mirrored else indices) + count)
        number = int(primitive.get("material", -1))
        numbers.append(np.full(len(indices), number, np.int32))
        names["uv"], turn = ATTRIBUTES["uv"], np.eye(2, 3)
        if with_materials and number >= 0:
            place, turn = texture_frame(file.document["materials"][number])
            names["uv"] = f"TEXCOORD_{place}"
        for key, name in names.items():
            if name in attributes:
                values = file.array(attributes[name], np.float32)
                if key == "normal":
                    values = values @ _normal_map(matrix[:3, :3]).T
                elif key == "uv" and with_materials:
                    values = values @ turn[:, :2].T + turn[:, 2]
                elif key == "alpha":
                    values = values[:, 3:] if values.shape[1] == 4 else np.full((size, 1), np.nan)
                extras[key].append(values[:, : ATTRIBUTE_WIDTHS.get(key, 1)].astype(np.float32))
            else:
                extras[key].append(np.full((size, ATTRIBUTE_WIDTHS.get(key, 1)), np.nan, np.float32))
        count += size
    joined = {key: _concatenate_attribute(parts) for key, parts in extras.items()}
    stated = glb_container.asset_extras(file.document)
    numbers_stated = {
        key: float(value)
        for key in (Q_KEY, MIN_OPACITY_KEY, ALPHA_CUTOFF_KEY)
        if isinstance(value := stated.get(key), int | float)
    }
    joined_triangles = np.concatenate([*triangles, np.zeros((0, 3), np.int64)])
    normals = joined.get("normal")
    mesh = ImportedMesh(
        np.concatenate([*vertices, np.zeros((0, 3))]),
        joined_triangles,
        uv=joined["uv"],
        gid=_flatten_scalar(joined["gid"]),
        corner=_flatten_scalar(joined["corner"]),
        radius=_flatten_scalar(joined["radius"]),
        q=numbers_stated.get(Q_KEY),
        min_opacity=numbers_stated.get(MIN_OPACITY_KEY),
        scene_size=scene_size_of(stated.get(SCENE_SIZE_KEY)),
        alpha_cutoff=numbers_stated.get(ALPHA_CUTOFF_KEY),
        part=glb_parts.stated_part(file.document),
        corner_normals=None if normals is None else normals[joined_triangles],
        rgb_linear=joined.get("color"),
        alpha=_flatten_scalar(joined.get("alpha")),
    )
    return mesh, np.concatenate([*numbers, np.zeros(0, np.int32)])


def _normal_map(linear: Float64[np.ndarray, "3 3"]) -> Float64[np.ndarray, "3 3"]:
    """Return the map of normals where points are mapped linearly: the inverse transposed, of another length.

    Of cofactors, so that nodes of no extent, by which programs hide things, are no error.
    """
    a, b, c = linear
    cofactors = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)])
    largest = max(float(np.abs(cofactors).max()), 1e-300)
    return np.asarray(cofactors / (-largest if np.linalg.det(linear) < 0 else largest))


def _triangles_of(corners: Int64[np.ndarray, " c"], mode: int) -> Int64[np.ndarray, "t 3"]:
    """Return the triangles of a list, a strip or a fan of vertices, all wound alike."""
    if mode == glb_container.TRIANGLES:
        return corners.reshape(-1, 3)
    k = np.arange(max(len(corners) - 2, 0))
    if mode == glb_container.TRIANGLE_FAN:
        return corners[np.stack([k + 1, k + 2, np.zeros_like(k)], axis=1)]
    odd = k % 2  # every other one is turned over
    return corners[np.stack([k, k + 1 + odd, k + 2 - odd], axis=1)]


def _concatenate_attribute(parts: list[np.ndarray]) -> np.ndarray | None:
    """Concatenate an attribute; None where no part has it."""
    if not parts:
        return None
    joined = np.concatenate(parts)
    return None if np.isnan(joined).all() else joined


def _flatten_scalar(values: np.ndarray | None) -> np.ndarray | None:
    return None if values is None else values[:, 0]


def write_octagons(gaussians: FlatGaussians, path: Path, options: ExportOptions) -> tuple[Path, ...]:
    """Write the octagons as unlit meshes; memory stays at one chunk's vertices.

    A scene for which one file is too small goes into ``path``, ``<stem>.part2.glb`` and so on, by chunks.

    Raises:
        ConfigError: the octagons are to be lit and have no materials.
        SceneFileError: nothing to write, or a chunk that is larger than the 4 GiB that a GLB can hold.
        OSError: a file cannot be written.
    """
    ramp = b""
    if options.light_up is not None:
        if not has_materials(gaussians):
            raise ConfigError(f"{path}: not written, as the scene has no materials to be lit by.")
        options, ramp = options.model_copy(update={"ids": False}), material_ramp_png()
    cutoff = OPAQUE_CUTOFF if options.opaque else None
    soup = OctagonSoup(gaussians, path, options, cutoff, is_numbered=options.ids)
    png = white_with_alpha_png(options.falloff_texture_size, options.q)
    parts = _plan_files(soup, path, (len(png), len(ramp)), options)
    paths = glb_parts.part_paths(path, len(parts))
    for part_path, (layout, chunks) in glb_parts.in_order_of_writing(paths, parts):
        bounds: list[Bounds] = []
        data = _octagon_data(
            layout=layout, soup=soup, chunks=chunks, images=(png, ramp), options=options, bounds=bounds
        )
        write_glb(part_path, layout.json_room, layout.length, data, lambda: layout.json(bounds))  # noqa: B023
    return paths


def _plan_files(
    soup: OctagonSoup, path: Path, png_sizes: tuple[int, int], options: ExportOptions
) -> list[tuple[GlbLayout, ChunkIndices]]:
    """Return the fewest files that hold all chunks; neighbouring chunks stay together."""
    chunks = kd_split(soup.means_world, options.chunks)
    channels = channel_attributes(soup.channel_widths, widest=1)
    for count in range(1, len(chunks) + 1):
        bounds = np.linspace(0, len(chunks), count + 1).astype(int).tolist()
        groups = [chunks[start:end] for start, end in itertools.pairwise(bounds)]
        parts = [
            (
                GlbLayout(
                    chunk_sizes=[len(chunk) for chunk in group],
                    png_size=png_sizes[0],
                    options=options,
                    extras=extras,
                    channels=channels,
                    ramp_size=png_sizes[1],
                ),
                group,
            )
            for group, extras in zip(groups, _file_extras(soup, options, count), strict=True)
        ]
        if all(layout.total <= glb_container.MAX_BYTES for layout, _ in parts):
            return parts
    largest = max(layout.total for layout, _ in parts)
    advice = "Allow more chunks, leave faint Gaussians out with min_opacity, or export a mesh PLY."
    raise glb_container.too_large_error(path, "its largest chunk needs", largest, advice)


def _file_extras(soup: OctagonSoup, options: ExportOptions, parts: int) -> list[dict[str, object]]:
    """Return what each file says of itself: enough for an edited mesh to find back to its Gaussians."""
    extras: dict[str, object] = {
        Q_KEY: options.q,
        MIN_OPACITY_KEY: options.min_opacity,
        SCENE_SIZE_KEY: soup.scene_size,
    }
    if options.opaque:
        extras[ALPHA_CUTOFF_KEY] = OPAQUE_CUTOFF
    extras |= glb_container.channel_extras(soup.channel_widths)
    return [extras | glb_parts.part_extras(part, parts) for part in range(1, parts + 1)]


def _octagon_data(
    layout: GlbLayout,
    soup: OctagonSoup,
    chunks: ChunkIndices,
    images: tuple[bytes, bytes],
    options: ExportOptions,
    bounds: list[Bounds],
) -> Iterator[bytes]:
    """Yield the binary part in the order of the layout; add the bounds of each chunk to ``bounds``."""
    fall_off, ramp = images
    yield fall_off.ljust(pad_to_four(len(fall_off)), b"\0")
    yield octagon_triangles(layout.largest).astype("<u4").tobytes()
    if options.ids:
        yield np.tile(np.arange(SIDES, dtype="<f4"), layout.largest).tobytes()
    yield ramp.ljust(pad_to_four(len(ramp)), b"\0")
    for chunk in chunks:
        batch = soup.batch(chunk)
        yield from _chunk_data(batch, options)
        corners = batch.corners_world.reshape(-1, 3)
        bounds.append((corners.min(axis=0).tolist(), corners.max(axis=0).tolist()))


def _chunk_data(batch: OctagonBatch, options: ExportOptions) -> Iterator[bytes]:
    """Yield the attributes of one chunk, in the order of the layout, all multiples of four bytes."""
    lit = options.light_up is not None
    yield batch.corners_world.astype("<f4").tobytes()
    rgb = np.clip(batch.channels[ALBEDO], 0.0, 1.0) if lit else srgb_to_linear(batch.rgb_srgb)
    yield _per_corner(np.concatenate([rgb, batch.opacities[:, None]], axis=1)).tobytes()
    yield batch.uv.astype("<f4").tobytes()
    if lit:
        yield _per_corner(batch.normals_world).tobytes()
        yield _per_corner(material_ramp_uv(batch.channels[METALLIC], batch.channels[ROUGHNESS])).tobytes()
    if options.ids:
        yield _per_corner(batch.ids[:, None]).tobytes()
    for attribute in channel_attributes(batch.channels.widths, widest=1):
        yield _per_corner(batch.channels[attribute.channel][:, attribute.part]).tobytes()


def _per_corner(values: Float32[np.ndarray, "n c"] | Int[np.ndarray, "n c"]) -> Float32[np.ndarray, "m c"]:
    return np.repeat(values.astype("<f4"), SIDES, axis=0)


def write_for_viewers(gaussians: FlatGaussians, path: Path, options: ExportOptions) -> tuple[Path, ...]:
    """Write the octagons with solid middles beneath, without numbers for edits and without named channels.

    Raises:
        SceneFileError, OSError: as :func:`write_octagons`.
    """
    cores = CORES_OF_CHUNKS if options.cores is None else options.cores
    options = options.model_copy(update={"ids": False, "cores": cores, "opaque": False, "light_up": None})
    return write_octagons(replace(gaussians, channels=Channels()), path, options)


register(
    Exporter(
        "glb",
        ("*.glb",),
        "octagon mesh as GLB with opacity, fall-off and Gaussian numbers, for editing",
        write_octagons,
        holds_channels=True,
        holds_origin=True,
    )
)
register(
    Exporter(
        VIEWER_FORMAT,
        ("viewer.glb", "*.viewer.glb", "*_viewer.glb", "*-viewer.glb"),
        "octagon mesh as GLB that looks right in glTF viewers; a run's shows what was photographed",
        write_for_viewers,
        holds_origin=True,
    )
)
register(MeshReader("glb", ("*.glb",), read, read_with_materials))
register(SurfaceWriter("glb", ("*.glb",), write_surface, textured=True, lit=True))

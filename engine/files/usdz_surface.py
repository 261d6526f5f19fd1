"""Surfaces as USDZ: a mesh with a material and its textures, as AR viewers such as iOS Quick Look take it.

The package is a zip file without compression whose entries begin at multiples of 64 bytes, the layer first.
Colors with their light in them are sent out by the surface itself, which reflects nothing; with materials the
surface is lit. Needs the package usd-core (the extra ``usd``).
"""

import io
import zipfile
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Float64, UInt8

from octasplat.engine.core.color import srgb_to_linear
from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.core.local_origin import is_set
from octasplat.engine.core.partial_folders import partial_folder
from octasplat.engine.core.writing import atomic_replace
from octasplat.engine.files.glb_container import light_rotation
from octasplat.engine.files.glb_place import HALF_TURN_ABOUT_X, rotation_of
from octasplat.engine.files.registry import SurfaceWriter, register
from octasplat.engine.files.textures import png_bytes
from octasplat.engine.files.usd_stage import (
    ROOT,
    import_usd,
    missing_usd,
    place_in_georeference,
    set_transform,
)
from octasplat.engine.geometry.triangle_mesh import TriangleMesh

MESH, MATERIAL = f"{ROOT}/surface", f"{ROOT}/materials/surface"
ALIGNMENT = 64
MAX_BYTES = 2_000_000_000
"""Of all entries: near 2 GiB the zip file would get records of ZIP64, which USD does not read."""
_HEADER_BYTES, _EXTRA_HEADER_BYTES = 30, 4
_PADDING_ID = 0x1986
"""Of the extra field that fills a header up; the one that USD's own tools write."""
_MODULES = ("Gf", "Sdf", "Usd", "UsdGeom", "UsdShade", "Vt")


def write_surface(
    mesh: TriangleMesh, path: Path, turn_xyzw: Sequence[float] | None = None
) -> tuple[Path, ...]:
    """Write a surface with normals and with textures or the colors of its vertices.

    Args:
        mesh: the surface.
        path: the file.
        turn_xyzw: rotation that turns the scene upright, y up; None is a half turn about x. Of what is lit it
            is the one of its light, and a georeference knows up itself.

    Raises:
        SceneFileError: usd-core is missing, or more than the 2 GB that a package can hold.
        OSError: the file cannot be written.
    """
    pxr = import_usd(path, _MODULES)
    textures: dict[str, UInt8[np.ndarray, "h w 3"]] = {}
    if mesh.texture_srgb is not None and mesh.uv is not None:
        textures["surface.png"] = mesh.texture_srgb
        if mesh.materials is not None:
            textures["materials.png"] = mesh.materials.occlusion_roughness_metallic
            textures["normals.png"] = mesh.materials.normals
    entries = [("surface.usdc", _layer(pxr, mesh, path, turn_xyzw))]
    entries += [(name, png_bytes(pixels)) for name, pixels in textures.items()]
    needed = sum(len(data) for _, data in entries)
    if needed > MAX_BYTES:
        raise SceneFileError(
            f"{path}: not written; the surface needs {needed:,} bytes, and a USDZ of ours holds at most "
            f"{MAX_BYTES:,}. Decimate it with --max-triangles, or name a .ply."
        )
    with atomic_replace(path) as temporary:
        temporary.write_bytes(_package(entries))
    return (path,)


def _package(entries: Sequence[tuple[str, bytes]]) -> bytes:
    """Return a zip file as USDZ wants it; the same entries give the same bytes."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED, allowZip64=False) as archive:
        for name, data in entries:
            header = zipfile.ZipInfo(name)  # of a fixed date
            begin = buffer.tell() + _HEADER_BYTES + len(name.encode()) + _EXTRA_HEADER_BYTES
            padding = -begin % ALIGNMENT
            field = _PADDING_ID.to_bytes(2, "little") + padding.to_bytes(2, "little")
            header.extra = field + bytes(padding)
            archive.writestr(header, data)
    return buffer.getvalue()


def _layer(
    pxr: dict[str, ModuleType], mesh: TriangleMesh, path: Path, turn_xyzw: Sequence[float] | None
) -> bytes:
    """Return the binary layer, which is written beside ``path`` first."""
    geom = pxr["UsdGeom"]
    with partial_folder(path) as folder:
        file = folder / "surface.usdc"
        stage = pxr["Usd"].Stage.CreateNew(str(file))
        geom.SetStageUpAxis(stage, geom.Tokens.y)
        root = geom.Xform.Define(stage, ROOT)
        stage.SetDefaultPrim(root.GetPrim())
        if mesh.georeference is not None:
            place_in_georeference(pxr, stage, root, mesh.georeference, mesh.origin_world, np.eye(4))
        else:
            geom.SetStageMetersPerUnit(stage, 1.0)
            set_transform(pxr, root, _upright(mesh, turn_xyzw))
        _write_mesh(pxr, stage, mesh)
        stage.GetRootLayer().Save()
        return file.read_bytes()


def _upright(mesh: TriangleMesh, turn_xyzw: Sequence[float] | None) -> Float64[np.ndarray, "4 4"]:
    """Return the transform from the scene to y up."""
    if mesh.materials is not None:
        turn_xyzw = light_rotation(mesh.materials.light_frame)
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_of(HALF_TURN_ABOUT_X if turn_xyzw is None else turn_xyzw)
    if is_set(mesh.origin_world):
        matrix[:3, 3] = matrix[:3, :3] @ np.array(mesh.origin_world)
    return matrix


def _write_mesh(pxr: dict[str, ModuleType], stage: Any, mesh: TriangleMesh) -> None:
    geom, vt, kinds = pxr["UsdGeom"], pxr["Vt"], pxr["Sdf"].ValueTypeNames
    prim = geom.Mesh.Define(stage, MESH)
    prim.CreateSubdivisionSchemeAttr(geom.Tokens.none)
    prim.CreateDoubleSidedAttr(True)
    prim.CreatePointsAttr(_vectors(vt.Vec3fArray, mesh.vertices_world))
    prim.CreateFaceVertexCountsAttr(vt.IntArray.FromNumpy(np.full(len(mesh.faces), 3, np.int32)))
    prim.CreateFaceVertexIndicesAttr(
        vt.IntArray.FromNumpy(np.ascontiguousarray(mesh.faces, np.int32).reshape(-1))
    )
    prim.CreateNormalsAttr(_vectors(vt.Vec3fArray, mesh.vertex_normals()))
    prim.SetNormalsInterpolation(geom.Tokens.vertex)
    bounds = np.stack([mesh.vertices_world.min(axis=0), mesh.vertices_world.max(axis=0)])
    prim.CreateExtentAttr(_vectors(vt.Vec3fArray, bounds))
    if mesh.texture_srgb is not None and mesh.uv is not None:
        # USD's images begin below, ours above
        st = np.stack([mesh.uv[:, 0], 1.0 - mesh.uv[:, 1]], axis=1)
        primvar = geom.PrimvarsAPI(prim).CreatePrimvar("st", kinds.TexCoord2fArray, geom.Tokens.vertex)
        primvar.Set(_vectors(vt.Vec2fArray, st))
    elif mesh.rgb_srgb is not None:
        colors = prim.CreateDisplayColorPrimvar(geom.Tokens.vertex)
        colors.Set(_vectors(vt.Vec3fArray, srgb_to_linear(np.clip(mesh.rgb_srgb, 0.0, 1.0))))
    _bind_material(pxr, stage, prim, mesh)


def _vectors(kind: Any, values: np.ndarray) -> Any:
    return kind.FromNumpy(np.ascontiguousarray(values, np.float32))


def _bind_material(pxr: dict[str, ModuleType], stage: Any, prim: Any, mesh: TriangleMesh) -> None:
    """Give the mesh its material: what it shines by itself, or how it is lit."""
    shade, kinds, gf = pxr["UsdShade"], pxr["Sdf"].ValueTypeNames, pxr["Gf"]
    pxr["UsdGeom"].Scope.Define(stage, f"{ROOT}/materials")
    material = shade.Material.Define(stage, MATERIAL)
    surface = shade.Shader.Define(stage, f"{MATERIAL}/preview")
    surface.CreateIdAttr("UsdPreviewSurface")
    material.CreateSurfaceOutput().ConnectToSource(surface.ConnectableAPI(), "surface")
    shade.MaterialBindingAPI.Apply(prim.GetPrim()).Bind(material)

    def number(name: str, value: float) -> None:
        surface.CreateInput(name, kinds.Float).Set(value)

    if mesh.texture_srgb is not None and mesh.uv is not None:
        reader = shade.Shader.Define(stage, f"{MATERIAL}/st")
        reader.CreateIdAttr("UsdPrimvarReader_float2")
        reader.CreateInput("varname", kinds.String).Set("st")
        reader.CreateOutput("result", kinds.Float2)
    elif mesh.rgb_srgb is not None:
        reader = shade.Shader.Define(stage, f"{MATERIAL}/colors")
        reader.CreateIdAttr("UsdPrimvarReader_float3")
        reader.CreateInput("varname", kinds.String).Set("displayColor")
        reader.CreateOutput("result", kinds.Float3)
    else:
        return

    def texture(name: str, file: str, space: str) -> Any:
        shader = shade.Shader.Define(stage, f"{MATERIAL}/{name}")
        shader.CreateIdAttr("UsdUVTexture")
        shader.CreateInput("file", kinds.Asset).Set(pxr["Sdf"].AssetPath(file))
        shader.CreateInput("st", kinds.Float2).ConnectToSource(reader.ConnectableAPI(), "result")
        shader.CreateInput("wrapS", kinds.Token).Set("clamp")
        shader.CreateInput("wrapT", kinds.Token).Set("clamp")
        shader.CreateInput("sourceColorSpace", kinds.Token).Set(space)
        return shader

    def connect(name: str, kind: Any, shader: Any, output: str, output_kind: Any) -> None:
        shader.CreateOutput(output, output_kind)
        surface.CreateInput(name, kind).ConnectToSource(shader.ConnectableAPI(), output)

    if mesh.materials is None:
        surface.CreateInput("diffuseColor", kinds.Color3f).Set(gf.Vec3f(0.0))
        number("metallic", 0.0)
        number("roughness", 1.0)
        number("ior", 1.0)  # nothing is reflected
        if mesh.texture_srgb is None:
            connect("emissiveColor", kinds.Color3f, reader, "result", kinds.Float3)
        else:
            colors = texture("color", "surface.png", "sRGB")
            connect("emissiveColor", kinds.Color3f, colors, "rgb", kinds.Float3)
        return
    connect("diffuseColor", kinds.Color3f, texture("color", "surface.png", "sRGB"), "rgb", kinds.Float3)
    packed = texture("numbers", "materials.png", "raw")
    for name, channel in (("occlusion", "r"), ("roughness", "g"), ("metallic", "b")):
        connect(name, kinds.Float, packed, channel, kinds.Float)
    normals = texture("normals", "normals.png", "raw")
    normals.CreateInput("scale", kinds.Float4).Set(gf.Vec4f(2.0, 2.0, 2.0, 1.0))
    normals.CreateInput("bias", kinds.Float4).Set(gf.Vec4f(-1.0, -1.0, -1.0, 0.0))
    connect("normal", kinds.Normal3f, normals, "rgb", kinds.Float3)


register(
    SurfaceWriter(
        "usdz", ("*.usdz",), write_surface, textured=True, lit=True, missing_requirement=missing_usd
    )
)

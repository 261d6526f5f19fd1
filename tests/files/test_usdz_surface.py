"""Surfaces as USDZ: what usd-core reads back, its validators, and the zip file itself."""

import io
import struct
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from octasplat.engine.core.errors import ConfigError, SceneFileError
from octasplat.engine.core.georeference import Georeference, matrix_rows
from octasplat.engine.files import check_surface_path, exporter_for, usdz_surface, write_surface
from octasplat.engine.files.usdz_surface import write_surface as write_usdz
from octasplat.engine.geometry.triangle_mesh import MaterialMaps, TriangleMesh

usd = pytest.importorskip(
    "pxr.Usd", reason="usd-core is not installed (pip install -c constraints.txt -e '.[usd]')"
)
VERTICES = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]], np.float32)
FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]], np.int32)
UV = np.array([[0, 0], [1, 0], [0, 0.25], [0.5, 1]], np.float32)


def textured() -> TriangleMesh:
    image = np.random.default_rng(0).integers(0, 256, (32, 48, 3), dtype=np.uint8)
    return TriangleMesh(VERTICES, FACES, uv=UV, texture_srgb=image)


def lit() -> TriangleMesh:
    mesh = textured()
    numbers, normals = np.random.default_rng(1).integers(0, 256, (2, 32, 48, 3), dtype=np.uint8)
    tangents = np.tile(np.array([1, 0, 0, 1], np.float32), (4, 1))
    return replace(mesh, materials=MaterialMaps(numbers, normals, tangents, np.eye(3)))


def colored() -> TriangleMesh:
    return TriangleMesh(VERTICES, FACES, rgb_srgb=np.array([[0, 0.5, 1]] * 4, np.float32))


def image_in(path: Path, name: str) -> np.ndarray:
    with zipfile.ZipFile(path) as archive:
        return np.array(Image.open(io.BytesIO(archive.read(name))))


def placed_points(stage: Any) -> np.ndarray:
    """Positions in metres, in the axes of the file."""
    from pxr import UsdGeom

    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/octasplat/surface"))
    matrix = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(mesh.GetPrim()))
    points = np.array(mesh.GetPointsAttr().Get(), np.float64)
    return (points @ matrix[:3, :3] + matrix[3, :3]) * UsdGeom.GetStageMetersPerUnit(stage)


def source_of(stage: Any, name: str) -> Any:
    """The shader that an input of the material comes from."""
    from pxr import UsdShade

    shader = UsdShade.Shader(stage.GetPrimAtPath("/octasplat/materials/surface/preview"))
    source, output, _ = shader.GetInput(name).GetConnectedSource()
    return UsdShade.Shader(source.GetPrim()), str(output)


def test_mesh_texture_and_frame_are_read_back(tmp_path: Path) -> None:
    from pxr import UsdGeom

    mesh, path = textured(), tmp_path / "a.usdz"
    assert write_surface(mesh, path) == (path,)
    stage = usd.Stage.Open(str(path))
    assert UsdGeom.GetStageUpAxis(stage) == "Y" and UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert str(stage.GetDefaultPrim().GetPath()) == "/octasplat"
    read = UsdGeom.Mesh(stage.GetPrimAtPath("/octasplat/surface"))
    np.testing.assert_array_equal(np.array(read.GetFaceVertexIndicesAttr().Get()), FACES.reshape(-1))
    assert list(read.GetFaceVertexCountsAttr().Get()) == [3] * 4
    assert read.GetSubdivisionSchemeAttr().Get() == "none"
    np.testing.assert_allclose(np.array(read.GetNormalsAttr().Get()), mesh.vertex_normals())
    # y is up in the file and down in the scene
    np.testing.assert_allclose(placed_points(stage), VERTICES * [1, -1, -1], atol=1e-12)
    st = np.array(UsdGeom.PrimvarsAPI(read).GetPrimvar("st").Get())
    np.testing.assert_allclose(st, np.stack([UV[:, 0], 1 - UV[:, 1]], axis=1))
    texture, output = source_of(stage, "emissiveColor")
    assert output == "rgb" and texture.GetInput("file").Get().path == "surface.png"
    assert texture.GetInput("sourceColorSpace").Get() == "sRGB"
    np.testing.assert_array_equal(image_in(path, "surface.png"), mesh.texture_srgb)


def test_materials_are_read_back(tmp_path: Path) -> None:
    mesh, path = lit(), tmp_path / "a.usdz"
    write_surface(mesh, path)
    stage = usd.Stage.Open(str(path))
    assert source_of(stage, "diffuseColor")[0].GetInput("file").Get().path == "surface.png"
    outputs = {name: source_of(stage, name) for name in ("occlusion", "roughness", "metallic")}
    assert [output for _, output in outputs.values()] == ["r", "g", "b"]
    assert {shader.GetInput("sourceColorSpace").Get() for shader, _ in outputs.values()} == {"raw"}
    assert source_of(stage, "normal")[0].GetInput("file").Get().path == "normals.png"
    assert mesh.materials is not None
    np.testing.assert_array_equal(
        image_in(path, "materials.png"), mesh.materials.occlusion_roughness_metallic
    )
    np.testing.assert_array_equal(image_in(path, "normals.png"), mesh.materials.normals)


def test_colors_of_vertices_are_linear(tmp_path: Path) -> None:
    from pxr import UsdGeom

    write_surface(colored(), tmp_path / "a.usdz")
    stage = usd.Stage.Open(str(tmp_path / "a.usdz"))
    prim = UsdGeom.Gprim(stage.GetPrimAtPath("/octasplat/surface"))
    colors = np.array(prim.GetDisplayColorPrimvar().Get())
    np.testing.assert_allclose(colors, [[0.0, 0.214041, 1.0]] * 4, atol=1e-6)


@pytest.mark.parametrize("make", [textured, lit, colored])
def test_package_passes_usd_validators(tmp_path: Path, make: Any) -> None:
    from pxr import UsdValidation

    path = tmp_path / "a.usdz"
    write_surface(make(), path)
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    names = {validator.GetMetadata().name.split(":")[-1] for validator in validators}
    assert {"UsdzPackageValidator", "NormalMapTextureValidator", "RootPackageValidator"} <= names
    context = UsdValidation.ValidationContext(validators)
    errors = [f"{e.GetName()}: {e.GetMessage()}" for e in context.Validate(usd.Stage.Open(str(path)))]
    assert errors == []


def test_package_is_aligned_stored_and_reproducible(tmp_path: Path) -> None:
    paths = [tmp_path / name for name in ("a.usdz", "b.usdz")]
    for path in paths:
        write_surface(lit(), path)
    data = paths[0].read_bytes()
    assert data == paths[1].read_bytes()
    with zipfile.ZipFile(paths[0]) as archive:
        entries = archive.infolist()
        assert archive.testzip() is None
    assert [entry.filename for entry in entries] == [
        "surface.usdc", "surface.png", "materials.png", "normals.png"
    ]  # fmt: skip
    for entry in entries:
        assert entry.compress_type == zipfile.ZIP_STORED
        name, extra = struct.unpack("<HH", data[entry.header_offset + 26 : entry.header_offset + 30])
        assert (entry.header_offset + 30 + name + extra) % 64 == 0


def test_package_is_read_by_usd_or_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # zip files have records of ZIP64 above this limit; all as for packages that are 100,000 times as large
    monkeypatch.setattr("zipfile.ZIP64_LIMIT", (1 << 31) // 100_000)
    monkeypatch.setattr(usdz_surface, "MAX_BYTES", usdz_surface.MAX_BYTES // 100_000)
    points, refused = np.random.default_rng(2).random((3000, 3), np.float32), []
    for count in range(100, 2000, 100):
        path = tmp_path / f"{count}.usdz"
        try:
            write_surface(TriangleMesh(points[:count], FACES), path)
        except SceneFileError as error:
            assert "Decimate it with --max-triangles" in str(error) and not path.exists()
            refused.append(count)
            continue
        assert usd.Stage.Open(str(path)).GetPrimAtPath("/octasplat/surface")
    assert 0 < len(refused) < 15 and refused[-1] == 1900


def test_scene_is_turned_upright_about_its_origin(tmp_path: Path) -> None:
    quarter = [float(np.sqrt(0.5)), 0.0, 0.0, float(np.sqrt(0.5))]  # about x: y becomes z
    write_usdz(replace(textured(), origin_world=(10.0, 20.0, 30.0)), tmp_path / "a.usdz", quarter)
    x, y, z = (VERTICES + np.array([10, 20, 30])).T
    expected = np.stack([x, -z, y], axis=1)
    np.testing.assert_allclose(placed_points(usd.Stage.Open(str(tmp_path / "a.usdz"))), expected, atol=1e-9)


def test_georeference_gives_metres_and_up(tmp_path: Path) -> None:
    from pxr import UsdGeom

    # 2 m a unit; east, north, up are x, z, -y of the scene, 5 m above the anchor
    matrix = np.array([[2.0, 0, 0, 1], [0, 0, 2, 2], [0, -2, 0, 5], [0, 0, 0, 1]])
    place = Georeference(crs="EPSG:32633", anchor=(5e5, 5e6, 100.0), matrix=matrix_rows(matrix))
    write_surface(replace(textured(), georeference=place), tmp_path / "a.usdz")
    stage = usd.Stage.Open(str(tmp_path / "a.usdz"))
    assert UsdGeom.GetStageMetersPerUnit(stage) == pytest.approx(2.0) and UsdGeom.GetStageUpAxis(stage) == "Y"
    east, north, up = (VERTICES @ matrix[:3, :3].T + matrix[:3, 3]).T
    np.testing.assert_allclose(placed_points(stage), np.stack([east, up, -north], axis=1), atol=1e-9)
    known = stage.GetRootLayer().customLayerData["octasplat_georeference"]
    assert known["crs"] == "EPSG:32633" and tuple(known["anchor"]) == (5e5, 5e6, 100.0)


def test_format_is_chosen_by_name() -> None:
    assert exporter_for(Path("surface.usdz")).name == exporter_for(Path("a.surface.usdz")).name
    assert exporter_for(Path("surface.usdz")).name == "surface-usdz"
    assert exporter_for(Path("scene.usdz")).name == "usd"


def test_missing_usd_is_told_before_and_while_writing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "pxr", None)
    monkeypatch.setattr("importlib.util.find_spec", lambda _name: None)
    with pytest.raises(SceneFileError, match=r"a\.usdz: needs the package usd-core; .*pip install 'usd-core"):
        write_surface(textured(), tmp_path / "a.usdz")
    assert list(tmp_path.iterdir()) == []
    check_surface_path(Path("a.usdz"), textured=True, is_written_here=False)
    with pytest.raises(ConfigError, match=r"a\.usdz: needs the package usd-core"):
        check_surface_path(Path("a.usdz"), textured=True)

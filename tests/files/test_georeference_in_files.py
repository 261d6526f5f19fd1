"""A georeference goes through every format that has a place for it and comes back."""

from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.core.georeference import Georeference, matrix_rows
from octasplat.engine.files import ExportOptions, dropped_on_export, export_scene, read_metadata
from octasplat.engine.files.glb_container import GlbFile
from octasplat.engine.gaussians.scene_metadata import SceneMetadata

ORIGIN = (512_345.0, 5_403_210.0, 310.0)


def georeference(*, anchored: bool = True, origin=(0.0, 0.0, 0.0)) -> Georeference:
    matrix = np.eye(4)
    matrix[:3, :3] = 3.0 * np.array([[0.6, 0, -0.8], [0.8, 0, 0.6], [0, -1, 0]])
    matrix[:3, 3] = (5.0, -4.0, 2.0) - matrix[:3, :3] @ np.array(origin)
    place = {"crs": "EPSG:32632", "anchor": (691_600.0, 5_334_760.0, 520.0)} if anchored else {}
    return Georeference(matrix=matrix_rows(matrix), **place)


@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), ORIGIN], ids=["near", "far"])
@pytest.mark.parametrize("anchored", [True, False])
@pytest.mark.parametrize("name", ["a.ply", "a.mesh.ply", "a.compressed.ply", "a.splats.glb", "a.glb"])
def test_formats_hold_a_georeference(make_scene, tmp_path, name, anchored, origin):
    given = georeference(anchored=anchored, origin=origin)
    facts = SceneMetadata(origin_world=origin, georeference=given)
    export_scene(make_scene(20), tmp_path / name, ExportOptions(facts=facts))
    found = read_metadata(tmp_path / name)
    assert found.origin_world == pytest.approx(origin)
    held = found.georeference
    assert held is not None and (held.crs, held.anchor) == (given.crs, given.anchor)
    np.testing.assert_allclose(held.metres_from_scene, given.metres_from_scene, rtol=1e-12, atol=1e-9)


def test_matrix_of_a_glb_takes_its_own_positions_to_metres(make_scene, tmp_path):
    scene, given = make_scene(20), georeference(origin=ORIGIN)
    facts = SceneMetadata(origin_world=ORIGIN, georeference=given)
    export_scene(scene, tmp_path / "a.splats.glb", ExportOptions(facts=facts))
    file = GlbFile(tmp_path / "a.splats.glb")
    (node,) = file.document["nodes"]
    matrix = np.array(node["extras"]["octasplat_georeference"]["matrix"]).reshape(4, 4).T
    primitive = file.document["meshes"][0]["primitives"][0]
    own = file.array(primitive["attributes"]["POSITION"], np.float64) + node["translation"]
    metres = own @ matrix[:3, :3].T + matrix[:3, 3]
    user = scene.means_world.astype(np.float64) + ORIGIN
    expected = user @ given.metres_from_scene[:3, :3].T + given.metres_from_scene[:3, 3]
    np.testing.assert_allclose(metres, expected, atol=1e-6)


@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), ORIGIN], ids=["near", "far"])
def test_usd_stands_upright_in_metres_about_the_anchor(make_scene, tmp_path, origin):
    usd = pytest.importorskip("pxr.Usd")
    from pxr import UsdGeom

    scene, given = make_scene(20), georeference(origin=origin)
    facts = SceneMetadata(origin_world=origin, georeference=given)
    export_scene(scene, tmp_path / "a.usda", ExportOptions(facts=facts))
    stage = usd.Stage.Open(str(tmp_path / "a.usda"))
    metres_per_unit = UsdGeom.GetStageMetersPerUnit(stage)
    assert metres_per_unit == pytest.approx(3.0) and UsdGeom.GetStageUpAxis(stage) == "Y"
    (prim,) = (prim for prim in stage.Traverse() if prim.GetTypeName() == "ParticleField")
    placed = np.array(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(0))
    own = np.array(prim.GetAttribute("positions").Get(), np.float64)
    at = metres_per_unit * (own @ placed[:3, :3] + placed[3, :3])
    user = scene.means_world.astype(np.float64) + origin
    east, north, up = (user @ given.metres_from_scene[:3, :3].T + given.metres_from_scene[:3, 3]).T
    np.testing.assert_allclose(at, np.stack([east, up, -north], axis=1), atol=1e-6)
    known = stage.GetRootLayer().customLayerData["octasplat_georeference"]
    assert known["crs"] == "EPSG:32632" and list(known["anchor"]) == list(given.anchor)


def test_files_without_a_georeference_say_none(make_scene, tmp_path: Path):
    for name in ("a.ply", "a.splats.glb", "a.glb", "a.obj", "a.usda"):
        export_scene(make_scene(5), tmp_path / name)
        assert b"georeference" not in (tmp_path / name).read_bytes()
    lost = dropped_on_export(
        make_scene(5), [tmp_path / "a.spz"], facts=SceneMetadata(georeference=georeference())
    )
    assert any("no place for the georeference: 1 unit is 3 m" in text for text in lost)


def test_damaged_comments_are_refused(make_scene, tmp_path):
    from octasplat.engine.core.errors import SceneFileError

    facts = SceneMetadata(georeference=georeference())
    export_scene(make_scene(5), tmp_path / "a.ply", ExportOptions(facts=facts))
    data = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "b.ply").write_bytes(
        data.replace(b"georeference_crs EPSG:32632", b"georeference_crs EPSG:x2632")
    )
    with pytest.raises(SceneFileError, match=r"b\.ply: its comments of a georeference are damaged"):
        read_metadata(tmp_path / "b.ply")

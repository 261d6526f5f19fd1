"""Runs with a georeference: what lies beside the scene, what the report says, and what moves along."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import octasplat as osp
from octasplat.engine.core.errors import ConfigError
from octasplat.engine.core.georeference import read_georeference
from octasplat.engine.files import read_metadata
from octasplat.engine.operations import transform
from tests.support.located_scene import SCALE, apply, camera_centres, metres_about, truth_matrix, write_gps
from tests.support.small_run import RUN_OPTIONS
from tests.support.tiny_dataset import make_tiny_dataset

OPTIONS = {**RUN_OPTIONS, "exports": ["viewer.glb", "surface.glb", "octagons.obj", "small.spz"]}


@pytest.fixture(scope="module")
def plain(tmp_path_factory) -> Path:
    return make_tiny_dataset(tmp_path_factory)


@pytest.fixture(scope="module")
def scene(plain) -> Path:
    root = Path(shutil.copytree(plain, plain.with_name("located")))
    centres = camera_centres(root)
    metres = apply(truth_matrix(), np.stack(list(centres.values())))
    write_gps(root, dict(zip(centres, metres, strict=True)))
    return root


@pytest.fixture(scope="module")
def run(scene, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("located") / "run"
    osp.reconstruct(scene, folder, **OPTIONS)
    return folder


@pytest.mark.exhaustive
def test_run_states_where_it_lies(run):
    found = read_georeference(run / "georeference.json")
    assert found is not None and found.crs == "EPSG:4979" and found.method == "GPS"
    about = metres_about(found.metres_from_scene, found.anchor)
    np.testing.assert_allclose(about, truth_matrix(), atol=1e-6 * SCALE)
    assert json.loads((run / "metrics.json").read_text())["georeference"]["crs"] == "EPSG:4979"
    report = (run / "report.html").read_text()
    assert "georeference by GPS: 1 unit is 12.5 m" in report and "RMSE" in report
    assert read_metadata(run).georeference == found == read_metadata(run / "scene.ply").georeference


@pytest.mark.exhaustive
def test_scene_has_the_bytes_of_a_run_without_and_off_says_nothing(run, scene, plain, tmp_path):
    osp.reconstruct(plain, tmp_path / "plain", **OPTIONS)
    osp.reconstruct(scene, tmp_path / "off", **OPTIONS, georeference="off")
    for folder in (tmp_path / "plain", tmp_path / "off"):
        assert not (folder / "georeference.json").exists()
        assert (folder / "scene.ply").read_bytes() == (run / "scene.ply").read_bytes()
        for name in OPTIONS["exports"]:
            assert b"georeference" not in (folder / name).read_bytes()
    assert "georeference" not in json.loads((tmp_path / "off" / "metrics.json").read_text())


@pytest.mark.parametrize("name", ["viewer.glb", "surface.glb"])
def test_files_of_a_run_hold_the_place(run, name):
    found = read_georeference(run / "georeference.json")
    held = read_metadata(run / name).georeference
    assert held is not None and (held.crs, held.anchor) == (found.crs, found.anchor)
    np.testing.assert_allclose(held.metres_from_scene, found.metres_from_scene, atol=1e-6 * SCALE)


def test_formats_without_a_place_are_named(run):
    rows = [json.loads(line) for line in (run / "events.jsonl").read_text().splitlines()]
    texts = [str(row) for row in rows]
    assert any("spz has no place for the georeference" in text for text in texts)
    assert any("Georeference by GPS" in text for text in texts)
    assert b"# georeference_crs EPSG:4979" in (run / "octagons.obj").read_bytes()


def test_transform_moves_the_place_along(run, tmp_path):
    before = read_georeference(run / "georeference.json")
    request = transform.TransformRequest(
        source=run, output=tmp_path / "moved", scale=2.0, rotate=(("x", 30.0),), translate=(1.0, 2.0, 3.0)
    )
    rows = transform.run(request).matrix
    after = read_georeference(tmp_path / "moved" / "georeference.json")
    points = np.random.default_rng(0).normal(size=(5, 3))
    moved = apply(np.array(rows), points)
    np.testing.assert_allclose(
        apply(after.metres_from_scene, moved), apply(before.metres_from_scene, points), atol=1e-6
    )
    assert after.metres_per_unit == pytest.approx(SCALE / 2, rel=1e-6)
    assert b"georeference" not in (tmp_path / "moved" / "scene.ply").read_bytes()[:2000]


def test_uneven_transform_leaves_the_place_out_with_a_word(run, tmp_path):
    said = []
    (tmp_path / "m.txt").write_text("2 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")
    request = transform.TransformRequest(source=run, output=tmp_path / "uneven", matrix=tmp_path / "m.txt")
    transform.run(request, progress=lambda event: said.append(str(event)))
    assert any("georeference is left out" in text for text in said)
    assert not (tmp_path / "uneven" / "georeference.json").exists()


def test_edits_keep_the_place_and_merges_only_a_common_one(run, tmp_path):
    osp.crop(run, tmp_path / "part", box=(-9, -9, -9, 9, 9, 9))
    assert read_georeference(tmp_path / "part" / "georeference.json") == read_georeference(
        run / "georeference.json"
    )
    osp.transform(run, tmp_path / "moved", translate=(1.0, 0.0, 0.0))
    osp.merge(run, tmp_path / "same.ply", [tmp_path / "part" / "scene.ply"])
    osp.merge(run, tmp_path / "other.ply", [tmp_path / "moved"])
    assert read_metadata(tmp_path / "same.ply").georeference is not None
    assert read_metadata(tmp_path / "other.ply").georeference is None


def test_refused_control_points_leave_no_run(plain, tmp_path):
    (plain / "wrong.csv").write_text("name,x,y,z\nnobody,1,2,3\n")
    with pytest.raises(ConfigError, match="nobody has no mark"):
        osp.reconstruct(plain, tmp_path / "run", **OPTIONS, control_points="wrong.csv")
    assert not (tmp_path / "run" / "config.json").exists()
    (plain / "wrong.csv").unlink()

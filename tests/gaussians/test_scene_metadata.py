"""Metadata of merged scenes."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from octasplat.engine.core.georeference import Georeference, Residuals, matrix_rows
from octasplat.engine.files import ExportOptions, export_scene, read_metadata
from octasplat.engine.files.gaussian_ply import write_gaussian_ply
from octasplat.engine.gaussians.scene_metadata import SceneMetadata, merge_metadata

PLACE = Georeference(
    method="GPS",
    crs="EPSG:4979",
    anchor=(48.137222, 11.575556, 520.0),
    matrix=((2.0, 0.0, 0.0, 1.0), (0.0, 2.0, 0.0, 2.0), (0.0, 0.0, 2.0, 3.0)),
    residuals=Residuals(given=5, used=5, rmse_m=0.1, worst="a.jpg", worst_m=0.2),
)


@pytest.mark.parametrize("is_first", [True, False])
def test_scene_of_a_run_and_a_file_of_it_have_one_georeference(make_gaussians, tmp_path, is_first):
    gaussians = make_gaussians(3)
    write_gaussian_ply(gaussians, tmp_path / "part.ply", facts=SceneMetadata(georeference=PLACE))
    parts = [SceneMetadata(georeference=PLACE), read_metadata(tmp_path / "part.ply")]
    merged = merge_metadata([(gaussians, facts) for facts in (parts if is_first else parts[::-1])])
    assert merged.georeference is not None and merged.georeference.matrix == PLACE.matrix
    assert merged.georeference.residuals == (PLACE.residuals if is_first else None)


def test_scenes_elsewhere_have_no_common_georeference(make_gaussians):
    gaussians = make_gaussians(3)
    elsewhere = PLACE.model_copy(update={"anchor": (48.0, 11.0, 520.0)})
    facts = [SceneMetadata(georeference=place) for place in (PLACE, elsewhere)]
    assert merge_metadata([(gaussians, each) for each in facts]).georeference is None
    known = [SceneMetadata(), SceneMetadata(georeference=PLACE)]
    assert merge_metadata([(gaussians, each) for each in known]).georeference == PLACE


def test_scenes_of_one_place_keep_it_where_a_file_rounds_its_matrix(make_gaussians, tmp_path):
    gaussians = make_gaussians(3)
    turn = np.array([0.6931, -0.1, 0.05, 0.71])
    turn /= np.linalg.norm(turn)
    rotation = Rotation.from_euler("zyx", (20, 30, 50), degrees=True).as_matrix()
    matrix = np.vstack([np.column_stack([2.7 * rotation, (1.1, 2.2, 3.3)]), (0, 0, 0, 1)])
    place = PLACE.model_copy(update={"matrix": matrix_rows(matrix)})
    facts = SceneMetadata(georeference=place)
    options = ExportOptions(facts=facts, turn_xyzw=turn.tolist())
    export_scene(gaussians, tmp_path / "a.viewer.glb", options)
    turned = read_metadata(tmp_path / "a.viewer.glb")
    assert turned.georeference is not None and turned.georeference.matrix != place.matrix
    assert merge_metadata([(gaussians, facts), (gaussians, turned)]).georeference == place
    moved = place.model_copy(update={"matrix": matrix_rows(matrix + np.eye(4)[0][:, None] * 1e-6)})
    other = SceneMetadata(georeference=moved)
    assert merge_metadata([(gaussians, facts), (gaussians, other)]).georeference is None

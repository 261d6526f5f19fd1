"""3D Tiles as results of an export job: index and tiles, placed by the georeference of the source job."""

import json
from pathlib import Path

import numpy as np

from octasplat.engine.core.earth_frame import geocentric_from_metres
from octasplat.engine.core.georeference import (
    GEOREFERENCE_FILE,
    WGS84,
    Georeference,
    matrix_rows,
    write_georeference,
)
from octasplat.engine.files.gaussian_ply import write_gaussian_ply
from octasplat.workers.storage.local import LocalStorage
from octasplat.workers.storage.trees import store_tree
from octasplat.workers.worker.handlers import run_operation
from octasplat.workers.worker.job_kinds import get_job_kind
from octasplat.workers.worker.media_types import media_type
from octasplat.workers.worker.task import RESULTS_FOLDER, RUN_FOLDER, SCENE_FILE, Task
from tests.support.shell_scene import shell_scene


def test_export_job_publishes_index_and_tiles_at_their_place(tmp_path: Path) -> None:
    run = tmp_path / RUN_FOLDER
    run.mkdir()
    write_gaussian_ply(shell_scene(), run / SCENE_FILE)
    matrix = np.diag([3.0, 3.0, 3.0, 1.0])
    place = Georeference(matrix=matrix_rows(matrix), crs=WGS84, anchor=(48.137222, 11.575556, 520.0))
    write_georeference(run / GEOREFERENCE_FILE, place)
    kind = get_job_kind("export")
    assert GEOREFERENCE_FILE in kind.source_files  # the worker fetches it with the scene
    options = kind.resolve({"files": ["tileset.json"]}).model_dump(mode="json")
    run_operation(Task(tmp_path, options, threads=1, kind="export"))

    stored = store_tree(LocalStorage(tmp_path / "store", floor_bytes=0), tmp_path, below=RESULTS_FOLDER)
    index, *tiles = sorted((file.path for file in stored.files), key=lambda path: path != "tileset.json")
    root = json.loads((tmp_path / RESULTS_FOLDER / index).read_text())["root"]
    frame = geocentric_from_metres(place)
    assert frame is not None
    np.testing.assert_allclose(np.array(root["transform"]).reshape(4, 4).T[:3, 3], frame[:3, 3], atol=1e-3)
    assert root["content"]["uri"] in tiles and all(path.startswith("tiles/") for path in tiles)
    assert {media_type(path) for path in tiles} == {"model/gltf-binary"}

"""Whether the photographs that a surface's colors are fitted to are those of its scene."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageOps

from octasplat.engine.core.errors import DatasetError, OutputError
from octasplat.engine.core.events import Event, Noted, Warned
from octasplat.engine.dataset import Dataset
from octasplat.engine.dataset.synthetic import SyntheticDatasetConfig, write_synthetic_dataset
from octasplat.engine.dataset.views_file import read_views, write_views
from octasplat.engine.runs import surface_inputs
from octasplat.engine.runs.config import resolve_config
from octasplat.engine.runs.surface_inputs import training_photographs

TURN = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A run's folder, as far as it matters here, and its photographs in ``scene``."""
    scene, run = tmp_path / "scene", tmp_path / "run"
    write_synthetic_dataset(
        scene, SyntheticDatasetConfig(views=8, width_px=32, height_px=24, samples_per_side=1, points=100)
    )
    run.mkdir()
    config = resolve_config("fast")
    content = {"scene": str(scene), "reconstruction": config.model_dump(mode="json")}
    (run / "config.json").write_text(json.dumps(content))
    write_views(run / "views.json", Dataset.open(scene, run / "cache").views_record)
    shutil.rmtree(run / "cache")
    return tmp_path


def turned(run: Path) -> None:
    """Make the run one of a world turned by a right angle, as its photographs are not."""
    write_views(run / "views.json", read_views(run / "views.json").transformed(1.0, TURN, np.zeros(3)))


def test_photographs_of_the_run_are_taken_wherever_they_are(folder: Path) -> None:
    events: list[Event] = []
    train = sum(not view.held_out for view in read_views(folder / "run" / "views.json").views)
    assert len(training_photographs(folder / "run", None, 1, events.append)) == train
    (folder / "scene").rename(folder / "elsewhere")
    assert len(training_photographs(folder / "run", folder / "elsewhere", 1, events.append)) == train
    assert not [event for event in events if isinstance(event, Warned | Noted)]
    assert training_photographs(folder / "run", None, 1, events.append) == ()
    (note,) = (event.message for event in events if isinstance(event, Noted))
    assert "not on this machine" in note


def test_photographs_developed_anew_stand_where_their_own_model_says(folder: Path) -> None:
    content = json.loads((folder / "run" / "config.json").read_text())
    content["reconstruction"]["model"] = "sparse/7"  # of the several that the run had the choice of
    (folder / "run" / "config.json").write_text(json.dumps(content))
    for path in (folder / "scene" / "images").iterdir():
        ImageOps.invert(Image.open(path).convert("RGB")).save(path)
    train = sum(not view.held_out for view in read_views(folder / "run" / "views.json").views)
    (folder / "scene").rename(folder / "elsewhere")
    assert len(training_photographs(folder / "run", folder / "elsewhere", 1, lambda _event: None)) == train


def test_photographs_of_another_model_are_refused_or_left_out_with_a_word(folder: Path) -> None:
    turned(folder / "run")
    with pytest.raises(DatasetError, match="other names or poses"):
        training_photographs(folder / "run", folder / "scene", 1, lambda _event: None)
    events: list[Event] = []
    assert training_photographs(folder / "run", None, 1, events.append) == ()
    (warning,) = (event.message for event in events if isinstance(event, Warned))
    assert "Colors are those that the scene shows" in warning and "other names or poses" in warning


def test_full_disk_stops_cache_of_photographs(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_arguments: object, **_options: object) -> None:
        raise OutputError("no room")

    monkeypatch.setattr(surface_inputs, "open_run_dataset", full)
    with pytest.raises(OutputError, match="no room"):
        training_photographs(folder / "run", None, 1, lambda _event: None)

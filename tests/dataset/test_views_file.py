"""``views.json`` of a run that somebody else sent."""

import json
from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.dataset.views_file import read_views


def views_json(path: Path, name: str) -> Path:
    eye = np.eye(3).tolist()
    camera = {"model": "PINHOLE", "params": [8.0, 8.0, 4.0, 3.0], "width_px": 8, "height_px": 6}
    view = {
        "name": name, "camera": 0, "rotation_cam_from_world": eye,
        "translation_cam_from_world": [0.0, 0.0, 0.0], "width_px": 8, "height_px": 6,
        "photograph_width_px": 8, "photograph_height_px": 6, "photograph_sha256": "", "mask_sha256": None,
        "held_out": False,
    }  # fmt: skip
    content = {"format": 1, "extent_world": 1.0, "points_sha256": "", "cameras": [camera], "views": [view]}
    path.write_text(json.dumps(content), encoding="utf-8")
    return path


@pytest.mark.parametrize("name", ["0001.jpg", "left/0001.jpg", "a..b.jpg", "..jpg", "ä ö/ü.png"])
def test_names_below_the_photographs_are_read(tmp_path: Path, name: str) -> None:
    record = read_views(views_json(tmp_path / "views.json", name))
    assert record.viewpoints(None).views[0].name == name


@pytest.mark.parametrize(
    "name",
    [
        "../../x",
        "a/../../x.jpg",
        "/tmp/x.jpg",
        "..",
        "",
        ".",
        "C:\\x.jpg",
        "C:x.jpg",
        "..\\x.jpg",
        "\\x",
        "a\0b",
    ],
)
def test_view_names_outside_folder_are_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(ConfigError, match=r"views\.json cannot be read .*no path below"):
        read_views(views_json(tmp_path / "views.json", name))


def test_moved_views_are_in_another_world(tmp_path: Path) -> None:
    record = read_views(views_json(tmp_path / "views.json", "a.jpg"))
    eye, still = np.eye(3), np.zeros(3)
    slightly = np.array([[np.cos(0.02), -np.sin(0.02), 0], [np.sin(0.02), np.cos(0.02), 0], [0, 0, 1]])
    assert not record.is_of_another_world(record)
    assert not record.is_of_another_world(record.transformed(1.0, slightly, np.array([0.02, 0, 0])))
    assert record.is_of_another_world(record.transformed(1.0, eye, np.array([0.5, 0, 0])))
    assert record.is_of_another_world(record.transformed(1.0, slightly @ eye[[1, 2, 0]], still))
    others = read_views(views_json(tmp_path / "views.json", "b.jpg"))
    assert not record.is_of_another_world(others.transformed(1.0, eye, np.array([0.5, 0, 0])))

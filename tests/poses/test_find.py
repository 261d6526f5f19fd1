"""Poses found from photographs alone, compared with those they were taken from."""

import json
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from jaxtyping import Float64

from engine.errors import Cancelled, DatasetError
from engine.events import Event, StageFinished, StageProgress, StageStarted
from engine.poses import find_poses
from engine.poses.find import PosesConfig
from engine.render.images import write_png
from engine.scene.generated import GeneratedSceneConfig, write_generated_scene

pytestmark = pytest.mark.heavy


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("poses") / "scene"
    config = GeneratedSceneConfig(views=24, width_px=480, height_px=360, samples_per_side=2, points=300)
    write_generated_scene(root, config)
    return root


def centres(model: Path) -> dict[str, Float64[np.ndarray, "3"]]:
    images = pycolmap.Reconstruction(str(model)).images.values()
    return {image.name: image.projection_center() for image in images if image.has_pose}


def aligned(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """``found`` after the similarity that brings it closest to ``truth`` (Umeyama 1991)."""
    a, b = found - found.mean(0), truth - truth.mean(0)
    u, s, vt = np.linalg.svd(b.T @ a)
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    scale = (s * np.diag(flip)).sum() / (a**2).sum()
    moved: np.ndarray = scale * a @ (u @ flip @ vt).T + truth.mean(0)
    return moved


def test_poses_are_those_of_the_cameras(scene: Path, tmp_path: Path) -> None:
    events: list[Event] = []
    model = find_poses(scene / "images", tmp_path, threads=2, listener=events.append)
    assert model == tmp_path / "sparse" / "0" and not (tmp_path / "work").exists()
    found, truth = centres(model), centres(scene / "sparse" / "0")
    assert len(found) >= 0.8 * len(truth) and found.keys() <= truth.keys()
    names = sorted(found)
    a, b = np.stack([found[n] for n in names]), np.stack([truth[n] for n in names])
    errors = np.linalg.norm(aligned(a, b) - b, axis=1)
    assert np.median(errors) < 0.015 * np.linalg.norm(b - b.mean(0), axis=1).mean()
    wanted = [("features", 24), ("matches", 24 * 23 // 2), ("poses", 24)]
    begun = [event for event in events if isinstance(event, StageStarted)]
    assert [(event.stage, event.total_steps) for event in begun] == wanted
    assert [event.stage for event in events if isinstance(event, StageFinished)] == [
        name for name, _ in wanted
    ]
    for stage, total in wanted:
        steps = [e.step for e in events if isinstance(e, StageProgress) and e.stage == stage]
        assert steps == sorted(steps) and steps[-1] == total
    events.clear()
    assert find_poses(scene / "images", tmp_path, listener=events.append) == model and events == []


def test_photographs_of_nothing_are_refused(tmp_path: Path) -> None:
    images = tmp_path / "images"
    rng = np.random.default_rng(3)
    for number in range(4):
        write_png(images / f"{number}.png", rng.random((96, 128, 3)).astype(np.float32))
    with pytest.raises(DatasetError, match=r"overlap"):
        find_poses(images, tmp_path / "out", threads=1)
    assert not (tmp_path / "out" / "sparse").exists()


def test_too_few_photographs_are_refused(tmp_path: Path) -> None:
    write_png(tmp_path / "images" / "only.png", np.zeros((8, 8, 3), np.float32))
    with pytest.raises(DatasetError, match="1 photographs"):
        find_poses(tmp_path / "images", tmp_path / "out")


def test_most_photographs_must_be_placed(scene: Path, tmp_path: Path) -> None:
    images = tmp_path / "images"
    images.mkdir()
    for path in sorted((scene / "images").iterdir())[:7]:
        (images / path.name).hardlink_to(path)
    rng = np.random.default_rng(5)
    for number in range(3):
        write_png(images / f"noise{number}.png", rng.random((192, 256, 3)).astype(np.float32))
    with pytest.raises(DatasetError, match=r"photographs could be placed|No poses"):
        find_poses(images, tmp_path / "out", config=PosesConfig(min_share=1.0), threads=2)


def test_stops_when_asked(scene: Path, tmp_path: Path) -> None:
    asked = iter(range(1000))
    with pytest.raises(Cancelled):
        find_poses(scene / "images", tmp_path, threads=1, should_stop=lambda: next(asked) >= 1)
    assert not (tmp_path / "work").exists() and not (tmp_path / "sparse").exists()


def test_settings_are_json() -> None:
    assert PosesConfig.model_validate(json.loads(PosesConfig().model_dump_json())) == PosesConfig()

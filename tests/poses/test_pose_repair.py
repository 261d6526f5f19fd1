"""Photographs that stand in the wrong place of a given model are found and moved, and no others."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from octasplat.engine.core.errors import DatasetError
from octasplat.engine.core.events import Event, PhaseFinished, PhaseStarted, Warned
from octasplat.engine.dataset.load import load_dataset_model
from octasplat.engine.dataset.synthetic import SyntheticDatasetConfig, write_synthetic_dataset
from octasplat.engine.pipeline import reconstruct
from octasplat.engine.poses.config import GivenModel, PosesConfig
from octasplat.engine.poses.find_poses import repair_poses
from octasplat.engine.runs.config import resolve_config
from tests.support.stopped_run import reconstruct_until

pytestmark = pytest.mark.heavy

SWAPPED = ("view_003.png", "view_010.png")
INNOCENT = "view_006.png"
VIEWS = 24
SETTINGS = (
    "iterations=1000",
    "rays_per_batch=512",
    "max_gaussians=500",
    "probe_rays=256",
    "repair_poses=true",
)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A generated scene in which two photographs have each other's poses."""
    root = tmp_path_factory.mktemp("swapped") / "scene"
    write_synthetic_dataset(
        root,
        SyntheticDatasetConfig(views=VIEWS, width_px=480, height_px=360, samples_per_side=1, points=1500),
    )
    one, other = (root / "images" / name for name in SWAPPED)
    first = one.read_bytes()
    one.write_bytes(other.read_bytes())
    other.write_bytes(first)
    return root


def poses(model: Path) -> dict[str, np.ndarray]:
    images = pycolmap.Reconstruction(str(model)).images.values()
    return {image.name: image.cam_from_world().matrix() for image in images}


def assert_swapped(before: dict[str, np.ndarray], after: dict[str, np.ndarray]) -> None:
    """The two stand where the other one was said to be, and everybody else where they were."""
    for name, other in (SWAPPED, SWAPPED[::-1]):
        away = np.linalg.norm(before[name][:, 3] - before[other][:, 3])
        np.testing.assert_allclose(after[name][:, :3], before[other][:, :3], atol=0.01)
        assert np.linalg.norm(after[name][:, 3] - before[other][:, 3]) < 0.02 * away
    for name in before.keys() - set(SWAPPED):
        np.testing.assert_allclose(after[name], before[name], atol=1e-12)


@pytest.mark.exhaustive
def test_pose_repair_moves_contradicted_photographs(scene: Path, tmp_path: Path) -> None:
    model = scene / "sparse" / "0"
    before = poses(model)
    names = tuple(sorted(before))
    doubtful = tuple(names.index(name) for name in (*SWAPPED, INNOCENT))
    given = GivenModel(model=model, names=names, doubtful=doubtful)
    events: list[Event] = []
    found = tmp_path / "found"
    moved = repair_poses(scene / "images", names, given, found, threads=2, progress=events.append)
    assert moved == SWAPPED
    assert_swapped(before, poses(found))
    begun = [(event.stage, event.total_steps) for event in events if isinstance(event, PhaseStarted)]
    assert begun == [("features", VIEWS), ("matches", 3 * (VIEWS - 3)), ("placing", 2)]
    observed = pycolmap.Reconstruction(str(found))
    for image in observed.images.values():
        if image.name in SWAPPED:
            assert image.num_points3D == 0
    again = tmp_path / "again"
    repair_poses(scene / "images", names, given, again, threads=1)
    for path in found.iterdir():
        assert (again / path.name).read_bytes() == path.read_bytes()


@pytest.mark.exhaustive
def test_pose_repair_without_errors_writes_nothing(scene: Path, tmp_path: Path) -> None:
    model = scene / "sparse" / "0"
    names = tuple(sorted(poses(model)))
    given = GivenModel(model=model, names=names, doubtful=(names.index(INNOCENT),))
    config = PosesConfig(first_witnesses=8)
    assert repair_poses(scene / "images", names, given, tmp_path / "none", config=config) == ()
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("spelling", [str.upper, lambda name: name.removesuffix(".png")])
def test_photographs_are_found_in_a_model_that_spells_them_otherwise(
    tmp_path: Path, spelling: Callable[[str], str]
) -> None:
    root = tmp_path / "scene"
    write_synthetic_dataset(
        root, SyntheticDatasetConfig(views=8, width_px=120, height_px=90, samples_per_side=1, points=200)
    )
    model = pycolmap.Reconstruction(str(root / "sparse" / "0"))
    for image in model.images.values():
        image.name = spelling(image.name)
    model.write_binary(str(root / "sparse" / "0"))
    views = load_dataset_model(root).views
    names = tuple(view.name for view in views)
    assert names != tuple(sorted(poses(root / "sparse" / "0")))
    files = [view.image_path.relative_to(root / "images").as_posix() for view in views]
    given = GivenModel(model=root / "sparse" / "0", names=names, doubtful=(0,))
    assert repair_poses(root / "images", files, given, tmp_path / "none", threads=1) == ()


@pytest.mark.exhaustive
def test_pose_repair_unreadable_model_is_refused(scene: Path, tmp_path: Path) -> None:
    given = GivenModel(model=tmp_path / "gone", names=("view_000.png", "view_001.png"), doubtful=(0,))
    with pytest.raises(DatasetError, match=r"gone.cameras.txt cannot be read"):
        repair_poses(scene / "images", given.names, given, tmp_path / "none")
    assert not any(tmp_path.iterdir())


def stages_until(last: str, scene: Path, output: Path, *settings: str) -> list[str]:
    """Begin a run or go on with one, and stop it in the stage ``last``; returns those that had begun."""
    config = resolve_config("fast", settings={"exports": ()}, assignments=[*SETTINGS, *settings])
    return reconstruct_until(last, scene, output, config)


@pytest.mark.exhaustive
def test_pose_repair_runs_during_reconstruction(scene: Path, tmp_path: Path) -> None:
    output = tmp_path / "run"
    assert stages_until("check", scene, output) == ["load", "check"]
    asked = ["check", "features", "matches", "placing"]
    assert stages_until("matches", scene, output) == ["load", *asked[:3]]
    events: list[Event] = []
    config = resolve_config("fast", settings={"exports": ()}, assignments=SETTINGS)
    reconstruct(scene, output, config, resume=True, progress=events.append)
    stages = [event.stage for event in events if isinstance(event, PhaseFinished)]
    assert stages == ["load", *asked, "load", "train", "evaluate", "export"]
    told = [event.message for event in events if isinstance(event, Warned)]
    assert any("did not stand where" in text and all(name in text for name in SWAPPED) for text in told)
    assert_swapped(poses(scene / "sparse" / "0"), poses(output / "poses"))
    metrics = json.loads((output / "metrics.json").read_text())
    assert metrics["poses"] == {"moved": list(SWAPPED)}
    assert not set(metrics["training_views"]["misfits"]) & set(SWAPPED)

    # Where the poses are there already, nothing is asked again.
    (output / "scene.ply").unlink()
    shutil.rmtree(output / "checkpoints")
    assert stages_until("train", scene, output) == ["load", "train"]
    as_given = tmp_path / "given"
    assert stages_until("train", scene, as_given, "repair_poses=false") == ["load", "train"]
    assert not (as_given / "poses").exists()

"""Models that are found beside the one that is taken: kept, told, and taken in its place."""

import json
import shutil
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest

from octasplat.engine.core import versions
from octasplat.engine.core.errors import ConfigError, DatasetError
from octasplat.engine.core.events import Event, Warned
from octasplat.engine.core.writing import restore_folder
from octasplat.engine.operations.estimate import estimate_scene
from octasplat.engine.operations.photograph_sizes import photograph_sizes
from octasplat.engine.pipeline import reconstruct
from octasplat.engine.pipeline.start_scene import keep_found_models
from octasplat.engine.poses.found_models import (
    choose_found_model,
    describe_other_models,
    keep_other_models,
    other_models,
    parse_found_model,
    read_pose_record,
    write_other_models,
)
from octasplat.engine.poses.linking_pairs import LINKS_PER_PHOTOGRAPH, propose_links
from octasplat.engine.poses.model_selection import distinct_models
from octasplat.engine.poses.pair_proposals import propose_pairs
from octasplat.engine.poses.photographs import photographs_of_scene, photographs_sha256
from octasplat.engine.render.image_files import write_png
from octasplat.engine.runs.config import ReconstructionConfig
from octasplat.engine.runs.run_poses import find_missing_poses, tell_of_former_poses, warn_of_other_models
from octasplat.engine.settings.refusals import InvalidSettingsError
from octasplat.workers.worker.job_kinds.reconstruct_kinds import ReconstructKind
from tests.support.killed_rename import killed_before_rename

NAMES = [f"{k}.jpg" for k in range(9)]
PLACED = {0: NAMES[:4], 1: NAMES[3:7], 2: NAMES[6:]}
"""Photographs of each model: the second and third each share one with the one before."""


@dataclass(frozen=True)
class StubModel:
    """What the choice asks a model for."""

    images: tuple[int, ...]
    points: int = 500
    error_px: float = 0.7

    def reg_image_ids(self) -> tuple[int, ...]:
        return self.images

    def num_points3D(self) -> int:  # noqa: N802 - COLMAP's name
        return self.points

    def compute_mean_reprojection_error(self) -> float:
        return self.error_px


def write_found(poses: Path, **shared: Any) -> None:
    """Write a folder of three found models, whose files hold the number of the model."""
    for number, placed in PLACED.items():
        folder = poses / str(number) if number else poses
        folder.mkdir(parents=True, exist_ok=True)
        for name in ("cameras.bin", "images.bin", "points3D.bin"):
            (folder / name).write_text(str(number))
        left_out = [name for name in NAMES if name not in placed]
        record = {"photographs": len(NAMES), "placed": len(placed), "left_out": left_out}
        (folder / "poses.json").write_text(json.dumps({**record, **({} if number else shared)}))
    write_other_models(poses)


def write_photographs(scene: Path) -> str:
    """Write three photographs, and return their digest."""
    for k in range(3):
        write_png(scene / "images" / f"{k}.png", np.full((4, 4, 3), k / 4, np.float32))
    return photographs_sha256(scene / "images", photographs_of_scene(scene))


def test_models_without_photographs_of_their_own_or_trust_are_not_kept() -> None:
    first = StubModel(tuple(range(1, 11)))
    second = StubModel((9, 10, 11, 12, 13))
    inside, of_two = StubModel((3, 4, 5)), StubModel((10, 20, 21))
    known = StubModel((11, 12, 13, 20, 21))  # the one before has three of them
    few_points, coarse = StubModel((30, 31, 32), points=50), StubModel((30, 31, 32), error_px=4.0)
    assert distinct_models([first, second, inside, of_two, known, few_points, coarse]) == [first, second]
    assert distinct_models([]) == []


def test_other_models_are_named_with_what_the_taken_one_lacks(tmp_path: Path) -> None:
    write_found(tmp_path / "poses")
    told = describe_other_models(tmp_path / "poses")
    assert told is not None
    assert "3 models" in told and "that of 4 photographs is taken" in told
    first = tmp_path / "poses" / "1"
    assert f"{first} of 4 photographs, 3 of them not in that one (4.jpg, 5.jpg, 6.jpg)" in told
    assert f"--model {first}" in told
    assert read_pose_record(tmp_path / "poses")["other_models"] == [
        {"folder": "1", "placed": 4, "not_in_taken": NAMES[4:7]},
        {"folder": "2", "placed": 3, "not_in_taken": NAMES[6:]},
    ]


def test_record_of_former_searches_has_no_other_models(tmp_path: Path) -> None:
    (tmp_path / "poses.json").write_text('{"photographs": 8, "placed": 7, "left_out": ["a.jpg"]}')
    assert other_models(tmp_path) == [] and describe_other_models(tmp_path) is None
    choose_found_model(tmp_path, 0)
    assert read_pose_record(tmp_path) == {"photographs": 8, "placed": 7, "left_out": ["a.jpg"]}
    assert describe_other_models(tmp_path / "none") is None


def test_another_model_is_taken_and_the_first_again(tmp_path: Path) -> None:
    poses = tmp_path / "poses"
    write_found(poses, photographs_sha256="known")
    before = {path.relative_to(poses): path.read_bytes() for path in poses.rglob("*.*")}
    choose_found_model(poses, 2)
    assert (poses / "images.bin").read_text() == "2"
    assert [model.number for model in other_models(poses)] == [0, 1]
    assert (poses / "0" / "images.bin").read_text() == "0"
    record = read_pose_record(poses)
    assert (record["number"], record["placed"], record["photographs_sha256"]) == (2, 3, "known")
    assert record["other_models"][0] == {"folder": "0", "placed": 4, "not_in_taken": NAMES[:4]}
    told = describe_other_models(poses)
    assert told is not None and "that of 3 photographs is taken" in told and "in the first" not in told
    assert [path.name for path in tmp_path.iterdir()] == ["poses"]
    choose_found_model(poses, 0)
    after = {path.relative_to(poses): path.read_bytes() for path in poses.rglob("*.bin")}
    assert after.items() <= before.items() and read_pose_record(poses)["placed"] == 4
    with pytest.raises(DatasetError, match=r"no model poses/3; poses/0, poses/1, poses/2 are there"):
        choose_found_model(poses, 3)


@pytest.mark.parametrize("renames", range(11))
def test_run_killed_while_it_chooses_a_model_goes_on_with_its_search(tmp_path: Path, renames: int) -> None:
    scene, output = tmp_path / "scene", tmp_path / "run"
    sha256 = write_photographs(scene)
    write_found(output / "poses", photographs_sha256=sha256)
    config = ReconstructionConfig(poses="auto", model="poses/1")
    with killed_before_rename(renames):
        choose_found_model(output / "poses", 1)
    restore_folder(output / "poses")
    find_missing_poses(scene, output, config, 1, lambda _event: None, lambda: False)
    assert (output / "poses" / "images.bin").read_text() == "1"
    assert [model.number for model in other_models(output / "poses")] == [0, 2]
    assert [path.name for path in output.iterdir()] == ["poses"]


@pytest.mark.parametrize("renames", range(1, 12))
def test_run_killed_while_it_chooses_among_copied_models_does_not_copy_them_again(
    tmp_path: Path, renames: int
) -> None:
    scene, source, output = (tmp_path / name for name in ("scene", "source", "run"))
    write_found(source / "poses", photographs_sha256=write_photographs(scene))
    config = ReconstructionConfig(model=str(source / "poses" / "1"))
    with killed_before_rename(renames), suppress(DatasetError):  # these models cannot be opened
        reconstruct(scene, output, config)
    # on another host that has only the folder of the run
    shutil.rmtree(source)
    with pytest.raises(DatasetError):
        reconstruct(scene, output, config, resume=True)
    assert (output / "poses" / "images.bin").read_text() == "1"
    assert [model.number for model in other_models(output / "poses")] == [0, 2]
    assert not (output / ".poses.former").exists()


def test_other_models_stay_where_lenses_are_adjusted(tmp_path: Path) -> None:
    write_found(tmp_path / "poses")
    (tmp_path / "new").mkdir()
    keep_other_models(tmp_path / "poses", tmp_path / "new")
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == ["1", "2"]


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("poses/1", (None, 1)), ("runs/a/poses/12/", (Path("runs/a"), 12)), ("/poses/0", (Path("/"), 0)),
        ("a\\poses\\2", (Path("a"), 2)), ("sparse/1", None), ("1", None), ("my-poses/1", None), (None, None),
    ],
)  # fmt: skip
def test_names_of_found_models(name: str | None, expected: tuple[Path | None, int] | None) -> None:
    assert parse_found_model(name) == expected


def test_run_takes_the_model_that_is_named(tmp_path: Path) -> None:
    scene = tmp_path / "scene"
    sha256 = write_photographs(scene)
    first, other, third = (tmp_path / name for name in ("first", "other", "third"))
    write_found(first / "poses", photographs_sha256=sha256)
    named = ReconstructionConfig(model=str(first / "poses" / "1"))
    assert named.with_poses_decided(True).poses == "auto"  # though the scene holds a model
    config, found_by = named.without_run_of_model()
    assert (config.model, found_by) == ("poses/1", first)
    sizes = photograph_sizes(scene)
    assert not estimate_scene(scene, named, sizes).finds_poses  # a run has found them
    assert estimate_scene(scene, config, sizes).finds_poses
    for output in (other, third):
        output.mkdir()
    keep_found_models(scene, other, found_by)
    find_missing_poses(scene, other, config, 1, lambda _event: None, lambda: False)
    assert (other / "poses" / "images.bin").read_text() == "1"
    events: list[Event] = []
    warn_of_other_models(other, events.append)
    (warning,) = events
    assert isinstance(warning, Warned) and str(other / "poses" / "0") in warning.message
    # The same folder without the name takes the model of most photographs again.
    find_missing_poses(
        scene, other, ReconstructionConfig(poses="auto"), 1, lambda _event: None, lambda: False
    )
    assert (other / "poses" / "images.bin").read_text() == "0"
    # A scene that a run begins with stands in the world of one model.
    (other / "start").mkdir()
    with pytest.raises(DatasetError, match="leave --model or --start-from out"):
        find_missing_poses(scene, other, config, 1, lambda _event: None, lambda: False)
    with pytest.raises(ConfigError, match="no poses that a search has found"):
        keep_found_models(scene, third, tmp_path)
    write_png(scene / "images" / "another.png", np.zeros((4, 4, 3), np.float32))
    with pytest.raises(ConfigError, match="other photographs"):
        keep_found_models(scene, third, first)
    assert not any(third.iterdir())


def test_job_names_a_found_model_without_a_folder() -> None:
    kind = ReconstructKind()
    assert kind.resolve({"model": "poses/1"}).model == "poses/1"
    with pytest.raises(InvalidSettingsError, match="such as poses/1"):
        kind.resolve({"model": "/var/lib/other/poses/1"})


def located_database(path: Path, places: dict[int, tuple[float, float]]) -> None:
    with pycolmap.Database.open(path) as database:
        camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", 500.0, 640, 480)
        database.write_camera(camera, use_camera_id=True)
        for k, (latitude, longitude) in places.items():
            image = pycolmap.Image(name=f"{k:03d}.jpg", camera_id=1, image_id=k + 1)
            database.write_image(image, use_image_id=True)
            prior = pycolmap.PosePrior()
            prior.pose_prior_id = k + 1
            prior.corr_data_id = pycolmap.data_t(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, 1), k + 1)
            prior.position = [latitude, longitude, 100.0]
            prior.coordinate_system = pycolmap.PosePriorCoordinateSystem.WGS84
            database.write_pose_prior(prior, use_pose_prior_id=True)


def test_photographs_left_out_are_linked_to_the_nearest_with_poses(tmp_path: Path) -> None:
    count = 100
    located_database(tmp_path / "a.db", {k: (48.0, 11.0 + 0.001 * k) for k in range(count)})
    rest = [40, 41]
    posed = set(range(count)) - set(rest)
    matched = [(39, 40), (40, 42)]
    links = propose_links(tmp_path / "a.db", count, rest, posed, matched, seed=0)
    assert links == sorted(links) and not set(links) & {*matched, (40, 41)}
    of_first = sorted({*a} - {40} for a in links if 40 in a)
    assert len(of_first) == LINKS_PER_PHOTOGRAPH and len(links) == 2 * LINKS_PER_PHOTOGRAPH
    nearest = sorted(posed - {39, 42}, key=lambda k: abs(k - 40))[: LINKS_PER_PHOTOGRAPH - 1]
    assert set(nearest) <= set().union(*of_first)


def test_gps_of_zero_is_none_and_photographs_without_it_are_proposed_by_look(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[Sequence[int]] = []

    def by_look(_small: Path, _count: int, queries: Sequence[int], _most: int, *, seed: int) -> list[Any]:
        asked.append(list(queries))
        return [(number, [1]) for number in queries if number > 1]

    monkeypatch.setattr("octasplat.engine.poses.pair_proposals.alike_by_vocabulary", by_look)
    nowhere = dict.fromkeys(range(30), (0.0, 0.0))
    located_database(tmp_path / "zero.db", nowhere)
    propose_pairs(tmp_path / "zero.db", tmp_path / "none.db", 30, seed=0, threads=1)
    located_database(tmp_path / "some.db", {k: (48.0, 11.0 + 0.001 * k) for k in range(28)} | {28: (0, 0)})
    found = propose_pairs(tmp_path / "some.db", tmp_path / "none.db", 30, seed=0, threads=1)
    assert asked == [list(range(1, 31)), [29, 30]]
    assert {(0, 28), (0, 29)} <= set(found)


@pytest.mark.parametrize("results", [versions.RESULTS_VERSION, versions.RESULTS_VERSION - 1, None])
def test_new_run_tells_of_poses_that_a_former_version_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, results: int | None
) -> None:
    monkeypatch.setattr(versions, "UNSTATED_RESULTS", versions.RESULTS_VERSION)
    stated = {} if results is None else {"results": results}
    write_found(tmp_path / "poses", photographs_sha256="known", **stated)
    choose_found_model(tmp_path / "poses", 1)  # the record is of the search, whatever model is taken
    events: list[Event] = []
    tell_of_former_poses(tmp_path, events.append)
    assert len(events) == (results != versions.RESULTS_VERSION)
    assert all(isinstance(event, Warned) and "found anew" in event.message for event in events)

"""What a worker stores of a search for poses, and what another one begins with."""

import itertools
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from uuid import uuid4

import pytest

from octasplat.engine.core.writing import replace_folder
from octasplat.engine.pipeline.block_request import BlockRequest, keep_request
from octasplat.engine.poses.stored_search import STORED_DATABASE, STORED_MAPPINGS, STORED_SEARCH_FILES
from octasplat.workers.db.rows import Job
from octasplat.workers.storage.local import LocalStorage
from octasplat.workers.worker.checkpoint import Checkpoint
from octasplat.workers.worker.workspace import Workspace

SEARCH = "run/.poses.work"
BEFORE_MAPPING = tuple(name for name in STORED_SEARCH_FILES if name != STORED_MAPPINGS)


def make_job(attempt: int) -> Job:
    given: dict[str, Any] = dict.fromkeys(Job.__dataclass_fields__)
    given |= {"id": uuid4(), "kind": "reconstruct", "options": {}, "attempt": attempt, "fresh_after": 0}
    return Job(**{**given, "created_at": datetime.now(UTC)})


def test_state_of_a_search_is_restored_until_poses_are_there(tmp_path: Path) -> None:
    storage = LocalStorage(tmp_path / "store", floor_bytes=0)
    first = Workspace(tmp_path / "work", make_job(1), storage)
    first.open()
    work = first.folder / SEARCH
    work.mkdir(parents=True)
    (work / "search.json").write_text("{}")
    (work / "database.db").write_bytes(b"is being written")
    assert first.store_checkpoint("features", 50) is None
    (work / STORED_DATABASE).write_bytes(b"features")
    for name in ("pairs.json", "vocabulary.bin", "vocabulary.json"):
        (work / name).write_text("[]")
    stored = first.store_checkpoint("features", 100)
    assert stored is not None and {file.path for file in stored.files} == {
        f"{SEARCH}/{name}" for name in BEFORE_MAPPING
    }
    second = Workspace(tmp_path / "work", make_job(2), storage)
    second.open()
    second.restore(Checkpoint.from_row(stored.as_row()))
    there = second.folder / SEARCH
    assert {path.name for path in there.iterdir()} == set(BEFORE_MAPPING)
    assert (there / STORED_DATABASE).read_bytes() == b"features"
    with (there / STORED_DATABASE).open("ab") as file:  # it is gone on with, and the stored one stays
        file.write(b" and matches")
    again = Workspace(tmp_path / "work", make_job(3), storage)
    again.open()
    again.restore(stored)
    assert (again.folder / SEARCH / STORED_DATABASE).read_bytes() == b"features"
    (second.folder / "run" / "poses").mkdir()
    (second.folder / "run" / "poses" / "images.bin").write_bytes(b"poses")
    found = second.store_checkpoint("poses", 0)
    assert found is not None and [file.path for file in found.files] == ["run/poses/images.bin"]
    for workspace in (first, second, again):
        workspace.close()


def test_state_of_a_search_for_blocks_is_stored(tmp_path: Path) -> None:
    workspace = Workspace(tmp_path / "work", make_job(1), LocalStorage(tmp_path / "store", floor_bytes=0))
    workspace.open()
    keep_request(workspace.folder / "run", BlockRequest(), is_new=True)
    work = workspace.folder / SEARCH
    work.mkdir()
    for name in STORED_SEARCH_FILES:
        (work / name).write_text("{}")
    stored = workspace.store_checkpoint("matches", 7)
    assert stored is not None and {file.path for file in stored.files} == {
        "run/blocks/request.json", *(f"{SEARCH}/{name}" for name in STORED_SEARCH_FILES)
    }  # fmt: skip
    workspace.close()


@pytest.mark.parametrize("files", [BEFORE_MAPPING, ("search.json", "pairs.json")])
def test_search_that_is_done_twice_keeps_its_state_until_poses_are_there(
    tmp_path: Path, files: tuple[str, ...]
) -> None:
    workspace = Workspace(tmp_path / "work", make_job(2), LocalStorage(tmp_path / "store", floor_bytes=0))
    workspace.open()
    keep_request(workspace.folder / "run", BlockRequest(), is_new=True)
    work = workspace.folder / SEARCH
    work.mkdir()
    for name in files:  # an attempt that goes on has made the stored database its own
        (work / name).write_text("{}")
    assert workspace.store_checkpoint("poses", 0) is None
    workspace.close()


def test_state_of_a_mapping_is_stored_with_what_was_matched(tmp_path: Path) -> None:
    workspace = Workspace(tmp_path / "work", make_job(1), LocalStorage(tmp_path / "store", floor_bytes=0))
    workspace.open()
    work = workspace.folder / SEARCH
    work.mkdir(parents=True)
    for name in STORED_SEARCH_FILES:
        (work / name).write_text("{}")
    stored = workspace.store_checkpoint("poses", 307)
    assert stored is not None and stored.is_of_pose_search
    assert {file.path for file in stored.files} == {f"{SEARCH}/{name}" for name in STORED_SEARCH_FILES}
    assert stored.is_after(Checkpoint(1, "matches", 2000, ())) and not stored.is_after(
        Checkpoint(1, "poses", 2000, ())  # as many photographs as the found poses are of
    )
    workspace.close()


def write_poses(folder: Path, model: str) -> None:
    """Write two found models whose files say which one is taken."""
    for name in ("0/images.bin", "cameras.bin", "images.bin", "poses.json"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(model)


@pytest.mark.parametrize("stored_before", range(5))
def test_poses_that_are_exchanged_while_they_are_stored_are_those_of_one_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stored_before: int
) -> None:
    storage = LocalStorage(tmp_path / "store", floor_bytes=0)
    workspace = Workspace(tmp_path / "work", make_job(1), storage)
    workspace.open()
    keep_request(workspace.folder / "run", BlockRequest(), is_new=True)
    poses, new = workspace.folder / "run" / "poses", workspace.folder / "run" / ".poses.chosen"
    write_poses(poses, "first")
    write_poses(new, "second")
    opened, open_writer = itertools.count(), storage.open_writer

    def exchange_then_open(*, max_bytes: int | None) -> Any:
        if next(opened) == stored_before:
            replace_folder(poses, new)
        return open_writer(max_bytes=max_bytes)

    monkeypatch.setattr(storage, "open_writer", exchange_then_open)
    stored = workspace.store_checkpoint("poses", 9)
    assert stored is not None
    again = Workspace(tmp_path / "work", make_job(2), storage)
    again.open()
    again.restore(stored)
    found = [path.read_text() for path in (again.folder / "run" / "poses").rglob("*.*")]
    assert found == ["second"] * 4
    for each in (workspace, again):
        each.close()


@pytest.mark.parametrize("waits", [1, 99])
def test_poses_are_not_missing_while_they_are_exchanged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, waits: int
) -> None:
    workspace = Workspace(tmp_path / "work", make_job(1), LocalStorage(tmp_path / "store", floor_bytes=0))
    workspace.open()
    keep_request(workspace.folder / "run", BlockRequest(), is_new=True)
    run = workspace.folder / "run"
    write_poses(run / ".poses.former", "first")
    write_poses(run / ".poses.chosen", "second")
    waited = itertools.count(1)

    def wait(_seconds: float) -> None:
        if next(waited) == waits:
            (run / ".poses.chosen").rename(run / "poses")

    monkeypatch.setattr("octasplat.workers.worker.workspace.time.sleep", wait)
    stored = workspace.store_checkpoint("poses", 9)
    if waits > 1:  # the process was killed: what was stored before stays
        assert stored is None
    else:
        assert stored is not None and "run/poses/0/images.bin" in {file.path for file in stored.files}
    workspace.close()


def test_states_of_a_search_come_before_its_poses() -> None:
    order = [
        Checkpoint(1, stage, step, ())
        for stage, step in (("features", 40), ("features", 90), ("matches", 5), ("poses", 0), ("train", 1))
    ]
    for before, after in itertools.pairwise(order):
        assert after.is_after(before) and not before.is_after(after)

"""Folders of attempts on disks that fail, and their removal while workers remove them."""

import errno
import os
import shutil
import time
import uuid
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from octasplat.workers.db.rows import DatasetFile
from octasplat.workers.storage.errors import StorageFullError, StorageUnavailableError
from octasplat.workers.storage.local import LocalStorage
from octasplat.workers.storage.trees import TreeFile
from octasplat.workers.worker import workspace_locks
from octasplat.workers.worker.dataset_folder import FILLED_BY_NEED
from octasplat.workers.worker.path_redaction import PathRedactor
from octasplat.workers.worker.stored_frames import StoredFrames
from octasplat.workers.worker.task import FRAMES_FOLDER, RUN_FOLDER
from octasplat.workers.worker.workspace import Workspace
from octasplat.workers.worker.workspace_locks import LOCK_FILE, sweep_workspaces


def make_workspace(folder: Path) -> Workspace:
    job: Any = SimpleNamespace(id=uuid.uuid4(), attempt=1, kind="unknown", options={}, role=None)
    return Workspace(folder / "work", job, LocalStorage(folder / "store", floor_bytes=0))


def full(*_arguments: object, **_named: object) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_photographs_on_failing_disk_raise_errors_of_storage(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset = uuid.uuid4()
    for where, name in ((Path, "rename"), (os, "utime")):
        workspace = make_workspace(tmp_path)
        with monkeypatch.context() as patch:
            patch.setattr(where, name, full)
            with pytest.raises(StorageFullError):
                workspace.fetch_dataset(dataset, [], "d")
        workspace.close()
    workspace = make_workspace(tmp_path)
    place = workspace.fetch_dataset(dataset, [], "d")
    assert place.is_dir() and [path.name for path in place.parent.iterdir() if path != place] == [LOCK_FILE]
    workspace.close()
    shutil.rmtree(tmp_path / "work" / "datasets")
    (tmp_path / "work" / "datasets").touch()
    with pytest.raises(StorageUnavailableError):
        workspace.fetch_dataset(dataset, [], "d")


def test_photographs_are_fetched_once_a_host_and_only_those_needed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    storage = LocalStorage(tmp_path / "store", floor_bytes=0)
    files, now = [], datetime.now(UTC)
    dataset = uuid.uuid4()
    for number in range(5):
        with storage.open_writer() as writer:
            writer.write(bytes([number]) * 10)
            blob = writer.commit()
        files.append(DatasetFile(dataset, f"images/{number}.png", blob.sha256, blob.size_bytes, {}, now))
    fetched: list[str] = []
    original = LocalStorage.materialise

    def record(self: LocalStorage, sha256: str, target: Path, *, writable: bool = False) -> None:
        fetched.append(sha256)
        original(self, sha256, target, writable=writable)

    monkeypatch.setattr(LocalStorage, "materialise", record)

    def fill(*numbers: int) -> dict[int, bytes]:
        workspace = make_workspace(tmp_path)
        needed = {f"images/{number}.png" for number in numbers} if numbers else None
        place = workspace.fetch_dataset(dataset, files, "d", needed)
        workspace.close()
        there = {int(path.stem): path.read_bytes() for path in place.glob("images/*")}
        assert sorted(there) == [0, 1, 2, 3, 4]
        return {number: content for number, content in there.items() if content}

    assert sorted(fill(0, 1)) == [0, 1]
    with ThreadPoolExecutor(2) as pool:  # two at a time, which need the same
        list(pool.map(lambda last: fill(1, 2, last), (2, 3)))
    assert fill() == {number: bytes([number]) * 10 for number in range(5)}
    assert sorted(fetched) == sorted(file.sha256 for file in files)
    # An earlier version beside this one would take a folder called by the id for complete.
    (left,) = (tmp_path / "work" / "datasets").iterdir()
    assert left.name == f"{dataset}{FILLED_BY_NEED}"
    assert {path.name for path in left.iterdir()} == {"d", LOCK_FILE}


def test_stored_frames_on_failing_disk_raise_errors_of_storage(tmp_path: Path) -> None:
    storage = LocalStorage(tmp_path / "store", floor_bytes=0)
    with storage.open_writer() as writer:
        writer.write(b"a frame")
        blob = writer.commit()
    frame = TreeFile(
        path=f"{RUN_FOLDER}/{FRAMES_FOLDER}/0.png", sha256=blob.sha256, size_bytes=blob.size_bytes
    )
    (tmp_path / RUN_FOLDER).touch()
    with pytest.raises(StorageUnavailableError):
        StoredFrames(tmp_path, are_removed=True).adopt([frame], storage)


def test_sweep_goes_on_after_folder_that_its_worker_removes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("a", "b", "c"):
        (tmp_path / "attempts" / name).mkdir(parents=True)
        os.utime(tmp_path / "attempts" / name, (time.time() - 3600,) * 2)
    removed: list[str] = []

    def open_locked(path: Path, *, create: bool) -> None:
        if not removed:
            removed.append(path.parent.name)
            shutil.rmtree(path.parent)
        raise FileNotFoundError(path)

    monkeypatch.setattr(workspace_locks, "open_locked", open_locked)
    assert sweep_workspaces(tmp_path) == 2
    assert list((tmp_path / "attempts").iterdir()) == []


def test_sentences_of_earlier_attempts_name_no_folder(tmp_path: Path) -> None:
    job, source = uuid.uuid4(), uuid.uuid4()
    redactor = PathRedactor(tmp_path / "attempts" / f"{job}.2", tmp_path)
    for work in (tmp_path, Path("/of/another/machine")):
        for attempt in (1, 2):
            noted = f"{work}/attempts/{job}.{attempt}"
            told = redactor.redact(
                f"{noted}/job {source} was trained on views; {noted}/run/scene.ply is large"
            )
            assert told == f"job {source} was trained on views; scene.ply is large"


def test_trained_scene_is_stored_with_the_light_that_it_is_measured_by(tmp_path: Path) -> None:
    workspace = make_workspace(tmp_path)
    workspace.open()
    run = workspace.folder / RUN_FOLDER
    (run / "checkpoints").mkdir(parents=True)
    names = {"scene.ply", "training.json", "background.exr", "environment.exr", "environment.hdr"}
    for name in (*names, "checkpoints/best.npz", "mesh.ply"):
        (run / name).write_bytes(name.encode())
    stored = workspace.store_checkpoint("evaluate", 0)
    assert stored is not None and {file.path for file in stored.files} == {f"run/{name}" for name in names}
    workspace.close()

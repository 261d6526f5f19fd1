"""What is told of a process in which COLMAP works."""

import json
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import IO, Any

import numpy as np
import pytest

from octasplat.engine.core.errors import CancelledError, ColmapCrashError, DiskFullError
from octasplat.engine.core.events import Event, PhaseFinished, PhaseProgress, PhaseStarted, Warned
from octasplat.engine.core.writing import restore_folder, write_json
from octasplat.engine.pipeline.output_folder import claim_output, release_on_refusal
from octasplat.engine.poses import find_poses as module
from octasplat.engine.poses import running_colmap
from octasplat.engine.poses.config import (
    DEFAULT_CONFIG,
    FOUND_FOLDER,
    RECORD_FILE,
    GivenModel,
    PoseSearchRequest,
)
from octasplat.engine.poses.found_models import read_pose_record
from octasplat.engine.poses.photographs import photographs_of_scene, photographs_sha256
from octasplat.engine.render.image_files import write_png
from octasplat.engine.runs.config import ReconstructionConfig
from octasplat.engine.runs.run_poses import find_missing_poses
from tests.support.killed_rename import killed_before_rename
from tests.support.small_disk import small_disk

DONE = {"kind": "done"}


def lines_of(*events: Event, end: Mapping[str, object] = DONE) -> bytes:
    lines = [event.as_dict() for event in events]
    return "".join(json.dumps(line) + "\n" for line in [*lines, end]).encode()


def fake_process(
    monkeypatch: pytest.MonkeyPatch,
    record: dict[str, Any],
    *events: Event,
    end: Mapping[str, object] = DONE,
) -> None:
    """Let a process that tells these events leave a model with that record."""

    @contextmanager
    def start(request: PoseSearchRequest, _stderr_log: IO[bytes]) -> Iterator[Any]:
        (request.work / FOUND_FOLDER).mkdir()
        (request.work / FOUND_FOLDER / RECORD_FILE).write_text(json.dumps(record))
        read, write = os.pipe()
        os.write(write, lines_of(*events, end=end))
        os.close(write)
        with os.fdopen(read, "rb") as stdout:
            yield SimpleNamespace(stdout=stdout, wait=lambda: 0)

    monkeypatch.setattr(running_colmap, "start_process", start)


def find(images: Path, output: Path, progress: Callable[[Event], None]) -> None:
    module.find_poses(images, output, names=["a.png"], progress=progress)


def repair(images: Path, output: Path, progress: Callable[[Event], None]) -> None:
    given = GivenModel(model=images, names=("a.png",), doubtful=(0,))
    module.repair_poses(images, ["a.png"], given, output, progress=progress)


def adjust(images: Path, output: Path, progress: Callable[[Event], None]) -> None:
    module.adjust_principal_points(images, output, progress=progress)


@pytest.mark.parametrize(
    ("last", "record", "work"),
    [
        ("poses", {"placed": 1}, find),
        ("placing", {"moved": ["a.png"]}, repair),
        ("lenses", {"lenses": {"reprojection_px": 1.0}}, adjust),
    ],
)
def test_last_stage_ends_when_the_model_is_in_its_place(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    last: str,
    record: dict[str, Any],
    work: Callable[[Path, Path, Callable[[Event], None]], None],
) -> None:
    (tmp_path / "a.png").write_bytes(b"a photograph")
    told = [
        PhaseStarted("features", 1), PhaseFinished("features", 1.0),
        PhaseStarted(last, 1), PhaseFinished(last, 1.0), Warned("One is left out."),
    ]  # fmt: skip
    fake_process(monkeypatch, record, *told)
    output, heard = tmp_path / "poses", dict[str, bool]()

    def hear(event: Event) -> None:
        if isinstance(event, PhaseFinished):
            heard[event.stage] = (output / RECORD_FILE).exists()

    work(tmp_path, output, hear)
    assert heard == {"features": False, last: True}


@pytest.mark.parametrize("renames", range(3))
def test_run_killed_while_lenses_are_adjusted_keeps_its_poses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, renames: int
) -> None:
    scene, output = tmp_path / "scene", tmp_path / "run"
    for name in ("a.png", "b.png", "c.png"):
        write_png(scene / "images" / name, np.zeros((4, 4, 3), np.float32))
    sha256 = photographs_sha256(scene / "images", photographs_of_scene(scene))
    former = {"photographs_sha256": sha256, "placed": 1}
    write_json(output / "poses" / RECORD_FILE, former)
    facts = {"reprojection_px": 1.0}
    fake_process(monkeypatch, {"lenses": facts})
    with killed_before_rename(renames):
        module.adjust_principal_points(output / "poses", output / "poses")
    config = ReconstructionConfig(poses="auto")
    restore_folder(output / "poses")
    find_missing_poses(scene, output, config, 1, lambda _event: None, lambda: False)
    expected = former if renames < 2 else {**former, "lenses": facts}
    assert read_pose_record(output / "poses") == expected
    assert [path.name for path in output.iterdir()] == ["poses"]


def test_first_of_two_searches_ends_before_the_second(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a.png").write_bytes(b"a photograph")
    stages = ("poses", "features", "poses")
    both = [event for name in stages for event in (PhaseStarted(name, 1), PhaseFinished(name, 1.0))]
    fake_process(monkeypatch, {"placed": 1}, *both)
    heard = list[Event]()
    find(tmp_path, tmp_path / "poses", heard.append)
    assert heard == both


@pytest.mark.parametrize(
    ("told", "repeated"),
    [
        ([PhaseStarted("poses", 9)], PhaseProgress("poses", 0, 9)),
        ([PhaseProgress("matches", 4, 9), Warned("It rains.")], PhaseProgress("matches", 4, 9)),
        ([PhaseProgress("poses", 8, 9), PhaseFinished("poses", 1.0)], PhaseProgress("poses", 8, 9)),
    ],
)
def test_long_steps_are_told_to_be_alive_wherever_they_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, told: list[Event], repeated: Event
) -> None:
    monkeypatch.setattr(running_colmap, "_HEARTBEAT_SECONDS", -1.0)
    monkeypatch.setattr(running_colmap, "_POLL_SECONDS", 0.0)
    request = PoseSearchRequest(images=tmp_path, names=(), work=tmp_path, config=DEFAULT_CONFIG, threads=1)
    asked, heard = iter((False, True)), list[Event]()
    process = running_colmap.ColmapProcess(request, heard.append, lambda: next(asked))
    for line in lines_of(*told).splitlines()[:-1]:
        process._handle_line(line)
    read, write = os.pipe()
    with os.fdopen(read, "rb"), os.fdopen(write, "wb"), pytest.raises(CancelledError):
        process._read_chunk(read)
    assert heard[-1] == repeated


@pytest.mark.parametrize(
    ("stage", "doing"),
    [("", "starting"), ("read", "reading photographs"), ("matches", "matching"), ("poses", "placing photo")],
)
def test_crash_names_what_was_done(tmp_path: Path, stage: str, doing: str) -> None:
    message = running_colmap.crash_message(-9, stage, tmp_path / "log.txt")
    assert message.startswith(f"COLMAP was ended by SIGKILL while {doing}")


def test_search_on_a_full_disk_goes_on_when_there_is_space(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a.png").write_bytes(b"a photograph")
    full = {"kind": "error", "message": "No space left.", "is_disk_full": True}
    fake_process(monkeypatch, {"placed": 1}, end=full)
    with pytest.raises(DiskFullError, match="No space left"):
        find(tmp_path, tmp_path / "poses", lambda _event: None)
    assert (tmp_path / ".poses.work" / "search.json").exists()


def test_crash_on_a_full_disk_is_put_down_to_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.png").write_bytes(b"a photograph")
    fake_process(monkeypatch, {"placed": 1}, end={"kind": "stage_started", "stage": "features"})
    with small_disk(tmp_path / "disk", 1) as disk:
        with pytest.raises(DiskFullError, match="free space there"):
            find(tmp_path, disk / "poses", lambda _event: None)
        assert (disk / ".poses.work" / "search.json").exists()


@pytest.mark.parametrize(("kept_from", "is_kept"), [(1, True), (2, False)])
def test_what_a_long_search_has_found_stays_after_a_crash(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kept_from: int, is_kept: bool
) -> None:
    (tmp_path / "a.png").write_bytes(b"a photograph")
    monkeypatch.setattr(module, "STORED_FROM", kept_from)
    fake_process(monkeypatch, {"placed": 1}, end={"kind": "stage_started", "stage": "poses"})
    with pytest.raises(ColmapCrashError):
        find(tmp_path, tmp_path / "poses", lambda _event: None)
    assert (tmp_path / ".poses.work" / "search.json").exists() == is_kept


def test_same_command_goes_after_a_crash(tmp_path: Path) -> None:
    output = tmp_path / "out"
    for _ in range(2):
        is_new = claim_output(tmp_path, output, ReconstructionConfig(), resume=False)
        with pytest.raises(ColmapCrashError), release_on_refusal(output, is_new=is_new, is_made=True):
            raise ColmapCrashError("COLMAP died; run the same command again.")
    assert not output.exists()

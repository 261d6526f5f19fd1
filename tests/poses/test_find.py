"""Poses found from photographs alone, compared with those they were taken from."""

import json
import shutil
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psutil
import pycolmap
import pytest
from jaxtyping import Float64

from octasplat.engine.core import versions
from octasplat.engine.core.errors import CancelledError, ColmapCrashError, DatasetError
from octasplat.engine.core.events import (
    CheckpointWritten,
    Event,
    PhaseFinished,
    PhaseProgress,
    PhaseStarted,
    Warned,
)
from octasplat.engine.core.writing import write_json
from octasplat.engine.poses import incremental_mapping, stored_search
from octasplat.engine.poses.find_poses import PosesConfig, find_poses
from octasplat.engine.poses.photographs import photographs_sha256
from octasplat.engine.poses.search import PoseSearch
from octasplat.engine.poses.stored_search import (
    SEARCH_FILE,
    STORED_MAPPINGS,
    STORED_SEARCH_FILES,
    search_folder,
    search_record,
)
from octasplat.engine.render.image_files import write_png
from tests.support.neighbouring_photographs import write_neighbours

pytestmark = pytest.mark.heavy


COUNT = 16
"""The whole ring: without its end there would be nothing to hold the focal length."""


CONFINED = """
import os, sys
from pathlib import Path
from octasplat.engine.poses.find_poses import find_poses
from octasplat.workers.sandbox.confinement import confine

photographs, output = Path(sys.argv[1]), Path(sys.argv[2])
os.environ["TMPDIR"] = str(output)
confine(writable=[output], may_start_processes=True)
find_poses(photographs, output / "poses", threads=2)
"""


@dataclass(frozen=True)
class Photographs:
    """Photographs of one thing, and where they were taken from."""

    folder: Path
    centres_world: dict[str, Float64[np.ndarray, "3"]]


@pytest.fixture(scope="module")
def taken(tmp_path_factory: pytest.TempPathFactory) -> Photographs:
    folder = tmp_path_factory.mktemp("poses") / "images"
    return Photographs(folder, write_neighbours(folder, COUNT))


@dataclass(frozen=True)
class Found:
    """A search that nothing stopped, on two threads.

    Attributes:
        model: the folder that it wrote.
        events: what it told.
        written: names of what is in the folder that it wrote into.
    """

    model: Path
    events: list[Event]
    written: list[str]


@pytest.fixture(scope="module")
def found_at_once(taken: Photographs, tmp_path_factory: pytest.TempPathFactory) -> Found:
    folder, events = tmp_path_factory.mktemp("found"), list[Event]()
    find_poses(taken.folder, folder / "poses", threads=2, progress=events.append)
    return Found(folder / "poses", events, [path.name for path in folder.iterdir()])


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


def test_poses_are_those_of_the_cameras(taken: Photographs, found_at_once: Found) -> None:
    model, events = found_at_once.model, found_at_once.events
    assert found_at_once.written == ["poses"]
    found, truth = centres(model), taken.centres_world
    assert len(found) >= 0.8 * len(truth) and found.keys() <= truth.keys()
    names = sorted(found)
    a, b = np.stack([found[n] for n in names]), np.stack([truth[n] for n in names])
    errors = np.linalg.norm(aligned(a, b) - b, axis=1)
    # Of so few pixels; the focal length is found with them, which processors round differently.
    assert np.median(errors) < 0.03 * np.linalg.norm(b - b.mean(0), axis=1).mean()
    wanted = [("read", COUNT), ("features", COUNT), ("matches", COUNT * (COUNT - 1) // 2), ("poses", COUNT)]
    begun = [event for event in events if isinstance(event, PhaseStarted)]
    assert [(event.stage, event.total_steps) for event in begun] == wanted
    assert [event.stage for event in events if isinstance(event, PhaseFinished)] == [
        name for name, _ in wanted
    ]
    for stage, total in wanted:
        steps = [e.step for e in events if isinstance(e, PhaseProgress) and e.stage == stage]
        assert steps == sorted(steps) and steps[-1] == (len(found) if stage == "poses" else total)
    record = json.loads((model / "poses.json").read_text())
    assert (record["placed"], record["photographs"]) == (len(found), COUNT)
    assert set(record["left_out"]) == truth.keys() - found.keys()
    again: list[Event] = []
    find_poses(taken.folder, model, progress=again.append)
    assert again == []


@pytest.mark.exhaustive
def test_poses_are_found_by_a_confined_job(
    taken: Photographs, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    images = tmp_path_factory.mktemp("confined") / "images"
    shutil.copytree(taken.folder, images)
    for path in sorted(images.iterdir())[10:]:
        path.unlink()
    done = subprocess.run(
        [sys.executable, "-c", CONFINED, images, tmp_path],
        stderr=subprocess.PIPE,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert len(centres(tmp_path / "poses")) >= 0.8 * 10


def test_find_poses_without_features_is_refused(tmp_path: Path) -> None:
    images = tmp_path / "images"
    rng = np.random.default_rng(3)
    for number in range(4):
        write_png(images / f"{number}.png", rng.random((96, 128, 3)).astype(np.float32))
    with pytest.raises(DatasetError, match=r"overlap"):
        find_poses(images, tmp_path / "out", threads=1)
    assert [path.name for path in tmp_path.iterdir()] == ["images"]


def test_too_few_photographs_are_refused(tmp_path: Path) -> None:
    write_png(tmp_path / "images" / "only.png", np.zeros((8, 8, 3), np.float32))
    with pytest.raises(DatasetError, match="1 photographs"):
        find_poses(tmp_path / "images", tmp_path / "out")


@pytest.mark.exhaustive
def test_find_poses_too_few_registered_is_refused(taken: Photographs, tmp_path: Path) -> None:
    images = tmp_path / "images"
    images.mkdir()
    for path in sorted((taken.folder).iterdir())[:7]:
        (images / path.name).hardlink_to(path)
    rng = np.random.default_rng(5)
    for number in range(3):
        write_png(images / f"noise{number}.png", rng.random((192, 256, 3)).astype(np.float32))
    with pytest.raises(DatasetError, match=r"photographs could be placed|No poses"):
        find_poses(images, tmp_path / "out", config=PosesConfig(min_share=1.0), threads=2)


def test_find_poses_should_stop_cancels(taken: Photographs, tmp_path: Path) -> None:
    asked = iter(range(1000))
    with pytest.raises(CancelledError):
        find_poses(taken.folder, tmp_path / "out", threads=1, should_stop=lambda: next(asked) >= 1)
    assert [path.name for path in tmp_path.iterdir()] == [".out.work"]


@pytest.mark.parametrize("results", [versions.RESULTS_VERSION, versions.RESULTS_VERSION - 1, None])
def test_stopped_search_of_another_version_begins_anew(
    taken: Photographs, tmp_path: Path, results: int | None
) -> None:
    events = list[Event]()

    def stop() -> None:
        with pytest.raises(CancelledError):
            find_poses(taken.folder, tmp_path / "out", progress=events.append, should_stop=lambda: True)

    stop()
    work = search_folder(tmp_path / "out")
    record = json.loads((work / SEARCH_FILE).read_text())
    (work / "found").write_text("features")
    of_version = {} if results is None else {"results": results}
    left = {name: value for name, value in record.items() if name != "results"} | of_version
    (work / SEARCH_FILE).write_text(json.dumps(left))
    stop()
    is_same = results == versions.RESULTS_VERSION
    assert (work / "found").exists() == is_same
    warnings = [event.message for event in events if isinstance(event, Warned)]
    assert len(warnings) == (not is_same) and all("begins anew" in message for message in warnings)
    assert json.loads((work / SEARCH_FILE).read_text()) == record


@pytest.mark.exhaustive
def test_stopped_search_goes_on_with_its_features_and_matches(
    taken: Photographs, found_at_once: Found, tmp_path: Path
) -> None:
    stopped = tmp_path / "stopped"

    def stop_in(stage: str, least: int) -> tuple[list[PhaseProgress], Callable[[], bool]]:
        """Return what was counted, and a question that is answered with yes in that stage."""
        seen: list[PhaseProgress] = []
        return seen, lambda: any(event.stage == stage and event.step >= least for event in seen)

    def first_count(seen: list[PhaseProgress], stage: str) -> int:
        return next(event.step for event in seen if event.stage == stage and event.step)

    for stage, least in (("features", 4), ("matches", 64), ("poses", 3)):
        seen, should_stop = stop_in(stage, least)

        def keep(event: Event, seen: list[PhaseProgress] = seen) -> None:
            if isinstance(event, PhaseProgress):
                seen.append(event)

        with pytest.raises(CancelledError, match="goes on where it was"):
            find_poses(taken.folder, stopped, threads=1, progress=keep, should_stop=should_stop)
    assert first_count(seen, "features") == COUNT
    assert first_count(seen, "matches") == 64  # as many as the second attempt had matched
    find_poses(taken.folder, stopped, threads=1)
    assert {path.name: path.read_bytes() for path in stopped.iterdir()} == {
        path.name: path.read_bytes() for path in found_at_once.model.iterdir()
    }
    assert [path.name for path in tmp_path.iterdir()] == ["stopped"]


@pytest.mark.exhaustive
def test_search_goes_on_in_another_folder_from_what_was_stored(
    taken: Photographs, found_at_once: Found, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stored_search, "STORED_FROM", 2)
    names = tuple(sorted(taken.centres_world))
    work = tmp_path / "work"
    work.mkdir()
    stored: list[int] = []

    def store(event: Event) -> None:
        """Copy the files that another host would be given."""
        if isinstance(event, CheckpointWritten):
            elsewhere = tmp_path / f"poses{len(stored)}"
            search_folder(elsewhere).mkdir()
            for name in STORED_SEARCH_FILES:
                if (work / name).exists():
                    shutil.copyfile(work / name, search_folder(elsewhere) / name)
            record = search_record(photographs_sha256(taken.folder, names), PosesConfig())
            write_json(search_folder(elsewhere) / SEARCH_FILE, record)
            stored.append(event.iteration)

    PoseSearch(taken.folder, names, work, PosesConfig(), 1, store).run(tmp_path / "found")
    assert stored == [COUNT, COUNT * (COUNT - 1) // 2]
    for number, counted in enumerate(({"features": COUNT}, {"features": COUNT, "matches": stored[1]})):
        events: list[Event] = []
        find_poses(taken.folder, tmp_path / f"poses{number}", threads=2, progress=events.append)
        first: dict[str, int] = {}
        for event in events:
            if isinstance(event, PhaseProgress) and event.step:
                first.setdefault(event.stage, event.step)
        assert "read" not in first and counted.items() <= first.items()
        assert {path.name: path.read_bytes() for path in (tmp_path / f"poses{number}").iterdir()} == {
            path.name: path.read_bytes() for path in found_at_once.model.iterdir()
        }


class _KilledError(Exception):
    """The process is killed."""


@pytest.mark.exhaustive
def test_large_capture_that_is_stopped_while_it_is_mapped_gives_the_same_bytes(
    taken: Photographs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(incremental_mapping, "_MIN_SEGMENT", 6)
    names, large = tuple(sorted(taken.centres_world)), PosesConfig(exhaustive_up_to=6, quick_look_up_to=10)

    def search(work: Path, *, kills: bool) -> bool:
        """Search in a folder; return whether it was killed at the first state of a mapping."""
        work.mkdir(exist_ok=True)

        def listen(event: Event) -> None:
            if kills and isinstance(event, CheckpointWritten) and event.path.endswith(STORED_MAPPINGS):
                raise _KilledError

        try:
            PoseSearch(taken.folder, names, work, large, 1, listen).run(work / "found")
        except _KilledError:
            return True
        return False

    assert not search(tmp_path / "at_once", kills=False)
    work, kills = tmp_path / "work_0", 0
    while search(work, kills=True):
        kills += 1
        other = tmp_path / f"work_{kills}"  # of another host, which gets what was stored
        other.mkdir()
        for name in STORED_SEARCH_FILES:
            if (work / name).exists():
                shutil.copyfile(work / name, other / name)
        work = other
    assert kills >= 3
    once, stopped = (
        {path.name: path.read_bytes() for path in (folder / "found").iterdir() if path.is_file()}
        for folder in (tmp_path / "at_once", work)
    )
    assert once == stopped and "images.bin" in once


@pytest.mark.exhaustive
def test_search_that_was_killed_while_it_changed_matches_gives_the_same_bytes(
    taken: Photographs, found_at_once: Found, tmp_path: Path
) -> None:
    names = tuple(sorted(taken.centres_world))

    def kill(event: Event) -> None:
        if isinstance(event, PhaseStarted) and event.stage == "poses":
            raise _KilledError

    with pytest.raises(_KilledError):
        PoseSearch(taken.folder, names, tmp_path, PosesConfig(), 1, kill).run(tmp_path / "found")
    killed = tmp_path / "killed"
    killed.mkdir()
    shutil.copyfile(tmp_path / "database.db", killed / "mapping.db")
    with closing(sqlite3.connect(killed / "mapping.db")) as left_open:  # its changes are in a file beside it
        left_open.execute("UPDATE two_view_geometries SET rows = 0, data = NULL WHERE pair_id % 2 = 0")
        left_open.commit()
        for path in killed.iterdir():
            shutil.copyfile(path, tmp_path / path.name)
    PoseSearch(taken.folder, names, tmp_path, PosesConfig(), 1, lambda _event: None).run(tmp_path / "found")
    for path in found_at_once.model.glob("*.bin"):
        assert (tmp_path / "found" / path.name).read_bytes() == path.read_bytes()


@pytest.mark.exhaustive
def test_stopped_search_with_other_settings_begins_anew(taken: Photographs, tmp_path: Path) -> None:
    counted: list[int] = []

    def count(event: Event) -> None:
        if isinstance(event, PhaseProgress) and event.stage == "features":
            counted.append(event.step)

    for config in (PosesConfig(), PosesConfig(seed=1)):
        counted.clear()
        with pytest.raises(CancelledError):
            find_poses(
                taken.folder, tmp_path / "out", config=config, threads=1, progress=count,
                should_stop=lambda: bool(counted and counted[-1] >= 8),
            )  # fmt: skip
        assert counted[0] < 8


@pytest.mark.exhaustive
def test_pose_search_is_deterministic(taken: Photographs, tmp_path: Path) -> None:
    images = tmp_path / "images"
    images.mkdir()
    for number, path in enumerate(sorted((taken.folder).iterdir())[:10]):
        (images / f"view {number}.png").hardlink_to(path)  # a name with a space
    quick = PosesConfig(exhaustive_up_to=5, partners=4)  # pairs are chosen
    for threads in (1, 2):
        find_poses(images, tmp_path / f"poses{threads}", config=quick, threads=threads)
    one, two = (
        {path.name: path.read_bytes() for path in (tmp_path / f"poses{threads}").iterdir()}
        for threads in (1, 2)
    )
    assert one == two and {"cameras.bin", "images.bin", "points3D.bin", "poses.json"} <= one.keys()
    assert {name.startswith("view ") for name in centres(tmp_path / "poses1")} == {True}


def test_pose_result_of_other_photographs_is_refused(taken: Photographs, tmp_path: Path) -> None:
    images = tmp_path / "images"
    shutil.copytree(taken.folder, images)
    (tmp_path / "poses").mkdir()
    record = {"photographs": COUNT, "placed": COUNT, "photographs_sha256": "another"}
    (tmp_path / "poses" / "poses.json").write_text(json.dumps(record))
    with pytest.raises(DatasetError, match="other photographs"):
        find_poses(images, tmp_path / "poses")


def unreadable(kind: str, good: Path) -> tuple[str, bytes]:
    """Suffix and content of a file that COLMAP, or nobody, can read as a photograph."""
    if kind == "truncated JPEG":
        return ".jpg", b"\xff\xd8\xff\xe0\x00\x10JFIF\x00" + good.read_bytes()[:40]
    if kind == "TIFF of nothing":
        return ".tif", b"II*\x00" + b"nothing at all" * 4
    return ".png", b""


@pytest.mark.parametrize("kind", ["truncated JPEG", "TIFF of nothing", "empty file"])
@pytest.mark.parametrize("place", range(4))
def test_unreadable_file_takes_no_image_id(taken: Photographs, tmp_path: Path, kind: str, place: int) -> None:
    images = tmp_path / "images"
    images.mkdir()
    good = sorted(taken.folder.iterdir())[:3]
    for number, path in enumerate(good):
        (images / f"{number}b.png").hardlink_to(path)
    suffix, content = unreadable(kind, good[0])
    bad = f"{place - 1}c{suffix}" if place else f"0a{suffix}"
    (images / bad).write_bytes(content)
    names = sorted(path.name for path in images.iterdir())
    assert names.index(bad) == place
    (tmp_path / "work").mkdir()
    events: list[Event] = []
    PoseSearch(images, names, tmp_path / "work", PosesConfig(), 1, events.append)
    (warning,) = (event.message for event in events if isinstance(event, Warned))
    assert warning.startswith("1 of 4 photographs cannot be read") and bad in warning
    # COLMAP numbers the links by their names.
    links = sorted((tmp_path / "work" / "photographs").iterdir())
    assert [link.resolve().name for link in links] == ["0b.png", "1b.png", "2b.png"]


@pytest.mark.exhaustive
def test_poses_go_to_the_photographs_they_are_of(taken: Photographs, tmp_path: Path) -> None:
    images = tmp_path / "images"
    shutil.copytree(taken.folder, images)
    names = sorted(path.name for path in images.iterdir())
    for kind, after in (("empty file", ""), ("TIFF of nothing", names[4]), ("truncated JPEG", names[9])):
        suffix, content = unreadable(kind, images / names[0])
        (images / f"{after or '0'}x{suffix}").write_bytes(content)
    find_poses(images, tmp_path / "poses", threads=2)
    found, truth = centres(tmp_path / "poses"), taken.centres_world
    assert len(found) >= 0.8 * len(truth) and found.keys() <= truth.keys()
    posed = sorted(found)
    a, b = np.stack([found[n] for n in posed]), np.stack([truth[n] for n in posed])
    errors = np.linalg.norm(aligned(a, b) - b, axis=1)
    assert np.median(errors) < 0.03 * np.linalg.norm(b - b.mean(0), axis=1).mean()
    record = json.loads((tmp_path / "poses" / "poses.json").read_text())
    assert record["photographs"] == COUNT + 3 and len(record["left_out"]) == COUNT + 3 - len(found)


def test_find_poses_colmap_crash_is_reported(taken: Photographs, tmp_path: Path) -> None:
    # Tests of pages before this one leave their browser running.
    others = set(psutil.Process().children())

    def kill(event: Event) -> None:
        if isinstance(event, PhaseStarted) and event.stage == "features":
            (child,) = set(psutil.Process().children()) - others
            child.send_signal(signal.SIGSEGV)

    with pytest.raises(
        ColmapCrashError, match=r"SIGSEGV while looking for features.*run the same command again"
    ):
        find_poses(taken.folder, tmp_path / "poses", threads=1, progress=kill)
    assert list(tmp_path.iterdir()) == []


def test_poses_config_round_trips_json() -> None:
    assert PosesConfig.model_validate(json.loads(PosesConfig().model_dump_json())) == PosesConfig()

"""What a child said reaches the journal whole, whenever the end comes."""

import asyncio
import contextlib
import uuid
from collections.abc import AsyncIterator
from types import SimpleNamespace
from typing import Any

import pytest

from octasplat.workers.db.live_scenes import LiveScene
from octasplat.workers.db.quotas import QuotaExceededError
from octasplat.workers.storage.errors import StorageError
from octasplat.workers.storage.trees import TreeFile
from octasplat.workers.worker import reporter
from octasplat.workers.worker.checkpoint import Checkpoint
from octasplat.workers.worker.reporter import Reporter


class SlowJournal:
    """An attempt whose database takes its time for each event."""

    def __init__(self) -> None:
        self.told: list[str] = []
        self.telling = asyncio.Event()

    async def add_event(self, kind: str, data: dict[str, Any]) -> None:
        self.telling.set()
        await asyncio.sleep(0.05)
        self.told.append(f"{kind} {data.get('stage', '')}".strip())

    async def set_progress(self, **_progress: object) -> None:
        await asyncio.sleep(0)

    async def add_log_lines(self, _lines: tuple[str, ...]) -> None:
        await asyncio.sleep(0)


async def test_reporter_finish_during_flush_writes_each_line_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reporter, "FLUSH_SECONDS", 0.01)

    journal = SlowJournal()
    child = Reporter(journal, workspace=None)  # type: ignore[arg-type]
    for stage in ("load", "evaluate", "export"):
        child.on_event({"kind": "stage_started", "stage": stage, "total_steps": 0})
        child.on_event({"kind": "stage_finished", "stage": stage, "seconds": 1.0})
    await journal.telling.wait()  # the first event is being written, five more were taken
    child.on_event({"kind": "run_finished", "outputs": [], "seconds": 3.0})
    await child.finish()
    told = journal.told

    stages = [
        f"stage_{what} {stage}"
        for stage in ("load", "evaluate", "export")
        for what in ("started", "finished")
    ]
    assert told == [*stages, "run_finished"]


async def test_reporter_logs_progress_at_intervals(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reporter, "PROGRESS_LINE_SECONDS", 0.0)

    class Log(SlowJournal):
        def __init__(self) -> None:
            super().__init__()
            self.lines: list[str] = []

        async def add_log_lines(self, lines: tuple[str, ...]) -> None:
            self.lines += lines

    journal = Log()
    child = Reporter(journal, workspace=None)  # type: ignore[arg-type]
    child.on_event({"kind": "stage_started", "stage": "train", "total_steps": 900})
    progress = {
        "iteration": 450, "total_iterations": 900, "loss": 0.1, "psnr": 24.13, "gaussians": 32000,
        "rays_per_second": 310_400, "hits_per_ray": 5.0, "seconds": 41.0, "seconds_left": 41.0,
    }  # fmt: skip
    measured = {"iteration": 450, "psnr": 23.04, "gaussians": 32000, "seconds": 41.0}
    child.on_event({"kind": "held_out_measured", **measured})
    child.on_event({"kind": "training_progress", **progress})
    child.on_event({"kind": "warning", "message": "It rains."})
    for number in range(3 * reporter.MAX_LOG_LINES):
        child.log(f"noise {number}")
    child.on_event({"kind": "error", "type": "x", "message": "x", "cause": ["Caused by rain"]})
    await child.finish()
    told = [line for line in journal.lines if "noise" not in line and "(More" not in line]

    state = "training 24.1 dB, held out 23.0 dB, 32,000 Gaussians, 310k rays/s"
    assert told == [
        "Training",
        f"  450/900: {state}, 0:41 left",
        "Warning: It rains.",
        "Caused by rain",
    ]


async def test_reporter_keeps_progress_until_the_training_goes_on() -> None:
    """As of a job whose blocks are trained, which reads its photographs before it goes on behind them."""

    class Log(SlowJournal):
        def __init__(self) -> None:
            super().__init__()
            self.seen: list[tuple[object, object]] = []

        async def set_progress(self, **progress: object) -> None:
            self.seen.append((progress["stage"], progress["step"]))

    journal = Log()
    child = Reporter(journal, workspace=None)  # type: ignore[arg-type]
    child.record_resume(Checkpoint(1, "train", 5, ()), keeps_progress=True)
    trained = {"total_iterations": 900, "loss": 0.1, "psnr": 24.1, "gaussians": 1, "rays_per_second": 1.0,
               "hits_per_ray": 5.0, "seconds": 1.0, "seconds_left": 1.0}  # fmt: skip
    for event in (
        {"kind": "stage_started", "stage": "load", "total_steps": 0},
        {"kind": "stage_progress", "stage": "load", "step": 3, "total_steps": 7},
        {"kind": "stage_finished", "stage": "load", "seconds": 1.0},
        {"kind": "stage_started", "stage": "train", "total_steps": 200},
        {"kind": "training_progress", "iteration": 700, **trained},
        {"kind": "stage_started", "stage": "evaluate", "total_steps": 4},
    ):
        child.on_event(event)
        await child._flush()
    await child.finish()
    assert journal.seen == [("train", 700), ("evaluate", 0)]


async def test_reporter_says_which_file_was_not_stored(monkeypatch: pytest.MonkeyPatch) -> None:
    class Log(SlowJournal):
        pool = None
        job = SimpleNamespace(id="j")

        def __init__(self) -> None:
            super().__init__()
            self.lines: list[str] = []

        async def add_log_lines(self, lines: tuple[str, ...]) -> None:
            self.lines += lines

    class Workspace:
        storage = None

        def __init__(self) -> None:
            self.checkpoints = 0

        def store_checkpoint(self, _stage: str, _step: int) -> None:
            self.checkpoints += 1

        def store_file(self, name: str) -> str:
            raise StorageError(f"{name} is gone.")

    @contextlib.asynccontextmanager
    async def no_lease(*_: object) -> AsyncIterator[None]:
        yield None

    monkeypatch.setattr(reporter, "storage_lease", no_lease)
    journal, workspace = Log(), Workspace()
    child = Reporter(journal, workspace)  # type: ignore[arg-type]
    child.on_event({"kind": "stage_finished", "stage": "poses", "seconds": 1.0})
    child.on_event({"kind": "preview_written", "path": "preview.jpg", "step": 1, "view": "a"})
    await asyncio.sleep(0.1)
    await child.finish()
    child = Reporter(journal, workspace)  # type: ignore[arg-type]
    child.on_event({"kind": "live_scene_written", "path": "l.ply", "views": "v", "step": 1, "gaussians": 1})
    await asyncio.sleep(0.1)
    await child.finish()
    told = [line for line in journal.lines if "could not be stored" in line]
    assert [line[line.index("Warning") :] for line in told] == [
        f"Warning: a {what} could not be stored: run/{name} is gone."
        for what, name in (("preview", "preview.jpg"), ("live scene", "l.ply"))
    ]
    assert workspace.checkpoints == 1


async def test_reporter_says_that_the_state_at_the_end_was_not_stored(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Log(SlowJournal):
        pool = None
        job = SimpleNamespace(id="j")

        def __init__(self) -> None:
            super().__init__()
            self.lines: list[str] = []

        async def add_log_lines(self, lines: tuple[str, ...]) -> None:
            self.lines += lines

        async def record_checkpoint(self, *_: object, **__: object) -> None:
            raise QuotaExceededError("bytes", "All bytes are taken.")

    class Workspace:
        storage = None

        def store_checkpoint(self, stage: str, step: int) -> Checkpoint:
            database = TreeFile(path="run/.poses.work/stored.db", sha256="0" * 64, size_bytes=8)
            return Checkpoint(1, stage, step, (database,))

    @contextlib.asynccontextmanager
    async def no_lease(*_: object) -> AsyncIterator[None]:
        yield None

    monkeypatch.setattr(reporter, "storage_lease", no_lease)
    journal = Log()
    child = Reporter(journal, Workspace())  # type: ignore[arg-type]
    child.on_event({"kind": "stage_started", "stage": "matches", "total_steps": 9})
    child.on_event({"kind": "checkpoint_written", "iteration": 4, "path": "stored.db"})
    await child.finish()
    assert journal.lines[-1] == (
        "Warning: the state of the search for poses is not kept: All bytes are taken."
    )


async def test_reporter_records_how_many_gaussians_are_of_each_block(monkeypatch: pytest.MonkeyPatch) -> None:
    class Recorder(SlowJournal):
        pool = None
        job = SimpleNamespace(id=uuid.uuid4())

        def __init__(self) -> None:
            super().__init__()
            self.scenes: list[LiveScene] = []

        async def record_live_scene(self, scene: LiveScene, _lease: None) -> None:
            self.scenes.append(scene)

    @contextlib.asynccontextmanager
    async def no_lease(*_: object) -> AsyncIterator[None]:
        yield None

    monkeypatch.setattr(reporter, "storage_lease", no_lease)
    journal = Recorder()
    workspace = SimpleNamespace(storage=None, store_file=lambda name: name)
    child = Reporter(journal, workspace)  # type: ignore[arg-type]
    said: list[Any] = [[3, 0, 2], (), [3, 1], [6, -1], ["x"], 5, [2.0, 3.0]]
    for counts in said:
        live = {"path": "l.ply", "views": "v", "step": 7, "gaussians": 5, "block_gaussians": counts}
        child.on_event({"kind": "live_scene_written", **live})
        while child._live_scene is not None or not journal.scenes:
            await asyncio.sleep(0.01)
        await asyncio.sleep(0.02)
    await child.finish()
    assert [scene.block_gaussians for scene in journal.scenes] == [[3, 0, 2], *[None] * 5, [2, 3]]
    assert {(scene.step, scene.gaussians) for scene in journal.scenes} == {(7, 5)}

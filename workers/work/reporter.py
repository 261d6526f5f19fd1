"""What a child says, as rows of the database: progress, events, log, checkpoints and pictures.

Hearing never waits for the database. What cannot be written is dropped, but for checkpoints; a verdict at the
end does not depend on any of it.
"""

import asyncio
import contextlib
import logging
from collections import deque
from collections.abc import Sequence
from typing import Any

import psycopg
from psycopg_pool import PoolTimeout

from octasplat.engine.events import Warned
from octasplat.workers.ending import end
from octasplat.workers.queue.attempts import Attempt, Fenced
from octasplat.workers.queue.storing import storing
from octasplat.workers.records.quotas import QuotaExceeded
from octasplat.workers.store.errors import StorageError
from octasplat.workers.telling.events import journal_progress, told_event
from octasplat.workers.telling.lines import PlainLines
from octasplat.workers.telling.pace import Pace
from octasplat.workers.work.task import RUN
from octasplat.workers.work.workspace import Checkpoint, Workspace

logger = logging.getLogger(__name__)

FLUSH_SECONDS = 0.5
MAX_LOG_LINES = 15_000
"""Lines of an attempt's libraries."""
MAX_TOLD_LINES = 4_000
"""Lines of an attempt on its stages, pace, warnings and errors."""
PACE_SECONDS = 30.0
"""How often the log says how far the job is."""
_WAITING_LINES = 2_000
_WAITING_EVENTS = 1_000
_STORED_KINDS = ("stage_started", "stage_finished", "held_out_measured", "warning", "run_finished")
_IGNORED = (psycopg.Error, PoolTimeout, TimeoutError, OSError)


class Reporter:
    """Tells the database what a child says.

    Args:
        attempt: the job.
        workspace: where the child writes.
    """

    def __init__(self, attempt: Attempt, workspace: Workspace) -> None:
        self._attempt = attempt
        self._workspace = workspace
        self._events: deque[tuple[str, dict[str, Any]]] = deque(maxlen=_WAITING_EVENTS)
        self._lines: list[str] = []
        self._lines_seen = 0
        self._lines_told = 0
        self._pace = PlainLines(self.note, PACE_SECONDS)
        self._progress: dict[str, Any] | None = None
        self._stage = ""
        self._stages: tuple[str, ...] = ()
        self._left = Pace()
        self._steps = 0
        self._wanted: tuple[str, int] | None = None
        self._preview: dict[str, Any] | None = None
        self._kept: Checkpoint | None = None
        self._keeps = True
        self._wake = asyncio.Event()
        self._flushing = asyncio.Lock()
        self._tasks = [asyncio.create_task(self._flush_forever()), asyncio.create_task(self._keep_forever())]

    @property
    def kept_bytes(self) -> int:
        """What the newest checkpoint takes in the store."""
        return sum(file.size_bytes for file in self._kept.files) if self._kept is not None else 0

    def expect(self, stages: Sequence[str]) -> None:
        """Say which stages there will be."""
        self._stages = tuple(stages)
        self._events.append(("stages", {"stages": list(stages)}))

    def resumed_from(self, checkpoint: Checkpoint) -> None:
        """Say what the attempt goes on from; only what is beyond it is progress."""
        self._kept = checkpoint
        self.note(f"Goes on from step {checkpoint.step} of {checkpoint.stage}")

    def log(self, line: str) -> None:
        """Take a line that the child's libraries wrote."""
        self._lines_seen += 1
        if self._lines_seen <= MAX_LOG_LINES:
            if len(self._lines) < _WAITING_LINES:
                self._lines.append(line)
        elif self._lines_seen == MAX_LOG_LINES + 1:
            self._lines.append(f"(More than {MAX_LOG_LINES} lines; the rest is left out.)")

    def note(self, line: str) -> None:
        """Put a line into the log that is not lost among those of libraries."""
        self._lines_told += 1
        if self._lines_told <= MAX_TOLD_LINES:
            self._lines.append(line)

    def hear(self, event: dict[str, Any]) -> None:
        """Take an event of the child."""
        kind = event["kind"]
        told = told_event(kind, event)
        if isinstance(told, Warned):
            self.note(f"Warning: {told.message}")
        elif told is not None:
            self._pace(told)
        elif kind == "error":
            for line in event.get("cause", ()):
                self.note(str(line))
        if kind == "stage_started":
            self._stage, self._left = event["stage"], Pace()
            self._steps = int(event["total_steps"])
            self._progress = {"stage": self._stage, "step": 0, "total_steps": self._steps or None}
        elif kind == "stage_progress":
            self._count(event)
        elif kind == "training_progress":
            self._steps = int(event["total_iterations"])  # which a time decides, and an early end changes
            self._progress = {
                "stage": self._stage,
                "step": event["iteration"],
                "total_steps": self._steps,
                "seconds_left": event["seconds_left"],
                "training_psnr": event["psnr"],
                "event": journal_progress(event),
            }
        elif kind == "checkpoint_written":
            self._want_checkpoint(event["iteration"])
        elif kind == "stage_finished":
            # The last step comes before the end in the journal too, and is not lost to the next first one.
            if self._progress is not None and "event" in self._progress:
                self._events.append(("progress", self._progress.pop("event")))
            if event["stage"] in ("poses", "placing", "lenses", "train"):
                self._want_checkpoint(self._steps if event["stage"] == "train" else 0)
        elif kind == "preview_written":
            self._preview = event
            self._wake.set()
        if kind in _STORED_KINDS:
            self._events.append((kind, {key: value for key, value in event.items() if key != "kind"}))

    async def finish(self) -> None:
        """Write everything that is left, the last checkpoint included."""
        async with self._flushing:  # a flush that is under way would lose what it has taken
            for task in self._tasks:
                task.cancel()
        await end(self._tasks)
        with contextlib.suppress(*_IGNORED):
            await self._flush()
        await self._keep()

    async def close(self) -> None:
        """Stop, leaving what is left."""
        await end(self._tasks)

    def _count(self, event: dict[str, Any]) -> None:
        step, total = int(event["step"]), int(event["total_steps"])
        self._progress = {
            "stage": event["stage"],
            "step": step,
            "total_steps": total,
            "seconds_left": self._left.left(step + float(event.get("part", 0.0)), total),
            "event": {key: value for key, value in event.items() if key != "kind"},
        }

    def _want_checkpoint(self, step: int) -> None:
        self._wanted = (self._stage, step)
        self._wake.set()

    async def _flush_forever(self) -> None:
        while True:
            await asyncio.sleep(FLUSH_SECONDS)
            try:
                async with self._flushing:
                    await self._flush()
            except Fenced:
                return
            except _IGNORED as error:
                logger.info("progress of job %s was not written: %s", self._attempt.job.id, error)
            except Exception:
                logger.exception("progress of job %s was not written", self._attempt.job.id)

    async def _flush(self) -> None:
        progress, self._progress = self._progress, None
        events, self._events = tuple(self._events), deque(maxlen=_WAITING_EVENTS)
        lines, self._lines = tuple(self._lines), []
        for kind, data in events:
            await self._attempt.tell(kind, data)
        if progress is not None:
            await self._attempt.progress(**progress)
        if lines:
            await self._attempt.log(lines)

    async def _keep_forever(self) -> None:
        while True:
            await self._wake.wait()
            self._wake.clear()
            try:
                await self._keep()
            except Fenced:
                return
            except Exception:
                logger.exception("a checkpoint of job %s was not kept", self._attempt.job.id)

    async def _keep(self) -> None:
        """Store the newest checkpoint and picture, if there are new ones."""
        wanted, self._wanted = self._wanted, None
        preview, self._preview = self._preview, None
        try:
            if wanted is not None:
                await self._keep_checkpoint(*wanted)
            if preview is not None:
                async with storing(self._attempt.pool, self._workspace.storage) as note:
                    sha256 = await asyncio.to_thread(self._workspace.store_file, f"{RUN}/{preview['path']}")
                    row = {"sha256": sha256, "step": preview["step"], "view": preview["view"]}
                    await self._attempt.keep_preview(row, note)
        except asyncio.CancelledError:
            self._wanted, self._preview = self._wanted or wanted, self._preview or preview
            raise
        except (StorageError, *_IGNORED) as error:
            logger.warning("checkpoint of job %s was not stored: %s", self._attempt.job.id, error)
            self.note(f"Warning: a checkpoint could not be stored: {error}")
            self._wanted = self._wanted or wanted

    async def _keep_checkpoint(self, stage: str, step: int) -> None:
        if not self._keeps:
            return
        async with storing(self._attempt.pool, self._workspace.storage) as note:
            checkpoint = await asyncio.to_thread(self._workspace.keep, stage, step)
            if checkpoint is None:
                return
            advances = checkpoint.is_beyond(self._kept)
            try:
                await self._attempt.keep_checkpoint(checkpoint.as_row(), advances=advances, note=note)
            except QuotaExceeded as error:
                # No more of them, as each would lie in the store for a while although nothing names it.
                self._keeps = False
                self.note(f"Warning: from here on no checkpoints are kept: {error}")
                return
            self._kept = checkpoint

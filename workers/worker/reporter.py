"""Reports of a child process as rows of the database: progress, events, log, checkpoints and previews.

Receiving never waits for the database. A row that cannot be written is dropped, except for checkpoints; the
final outcome does not depend on any of them.
"""

import asyncio
import contextlib
import logging
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import psycopg
from psycopg_pool import PoolTimeout

from octasplat.engine.core.events import Warned
from octasplat.workers.cancellation import cancel_and_wait
from octasplat.workers.db.live_scenes import LiveScene
from octasplat.workers.db.quotas import QuotaExceededError
from octasplat.workers.queue.attempts import Attempt, FencedError
from octasplat.workers.queue.storage_leases import storage_lease
from octasplat.workers.reporting.event_lines import EventLines
from octasplat.workers.reporting.events import decode_event, encode_training_progress
from octasplat.workers.reporting.time_left import TimeLeftEstimator, work_of_stage
from octasplat.workers.storage.trees import TREE_ERRORS
from octasplat.workers.worker.checkpoint import Checkpoint
from octasplat.workers.worker.task import (
    RUN_FOLDER,
    BlocksPlanned,
    read_block_gaussians,
    read_block_positions,
    read_planned_blocks,
)
from octasplat.workers.worker.workspace import Workspace

logger = logging.getLogger(__name__)

FLUSH_SECONDS = 0.5
MAX_LOG_LINES = 15_000
"""Lines of an attempt's libraries."""
MAX_NOTE_LINES = 4_000
"""Lines of an attempt on its stages, pace, warnings and errors."""
PROGRESS_LINE_SECONDS = 30.0
"""How often the log says how far the job is."""
_MAX_PENDING_LINES = 2_000
_MAX_PENDING_EVENTS = 1_000
_STORED_EVENT_KINDS = ("stage_started", "stage_finished", "held_out_measured", "warning", "run_finished")
_IGNORED_ERRORS = (psycopg.Error, PoolTimeout, TimeoutError, OSError)


class Reporter:
    """Writes the reports of a child process to the database.

    Args:
        attempt: the job.
        workspace: where the child writes.
    """

    def __init__(self, attempt: Attempt, workspace: Workspace) -> None:
        self._attempt = attempt
        self._workspace = workspace
        self._events: deque[tuple[str, dict[str, Any]]] = deque(maxlen=_MAX_PENDING_EVENTS)
        self._lines: list[str] = []
        self._log_line_count = 0
        self._note_count = 0
        self._progress_lines = EventLines(self.add_note, PROGRESS_LINE_SECONDS)
        self._progress: dict[str, Any] | None = None
        self._stage = ""
        self._stages: tuple[str, ...] = ()
        self._time_left = TimeLeftEstimator()
        self._steps = 0
        self._keeps_progress = False
        self._wanted_checkpoint: tuple[str, int] | None = None
        self._preview: dict[str, Any] | None = None
        self._live_scene: dict[str, Any] | None = None
        self._checkpoint: Checkpoint | None = None
        self._stores_checkpoints = True
        self.blocks_planned: BlocksPlanned | None = None
        """The blocks that the program has planned, if it ended with that."""
        self._wake = asyncio.Event()
        self._flushing = asyncio.Lock()
        self._tasks = [asyncio.create_task(self._flush_forever()), asyncio.create_task(self._store_forever())]

    @property
    def checkpoint_bytes(self) -> int:
        """Return the size of the newest checkpoint in the storage."""
        return sum(file.size_bytes for file in self._checkpoint.files) if self._checkpoint is not None else 0

    def set_stages(self, stages: Sequence[str]) -> None:
        """Set the stages that there will be."""
        self._stages = tuple(stages)
        self._events.append(("stages", {"stages": list(stages)}))

    def record_resume(self, checkpoint: Checkpoint, *, keeps_progress: bool = False) -> None:
        """Record what the attempt resumes from; only what is beyond it is progress.

        Args:
            checkpoint: is resumed from.
            keeps_progress: leave the job as far as its row says until its training goes on behind that.
        """
        self._checkpoint, self._keeps_progress = checkpoint, keeps_progress
        self.add_note(f"Goes on from step {checkpoint.step} of {checkpoint.stage}")

    def log(self, line: str) -> None:
        """Add a line that the child's libraries wrote."""
        self._log_line_count += 1
        if self._log_line_count <= MAX_LOG_LINES:
            if len(self._lines) < _MAX_PENDING_LINES:
                self._lines.append(line)
        elif self._log_line_count == MAX_LOG_LINES + 1:
            self._lines.append(f"(More than {MAX_LOG_LINES} lines; the rest is left out.)")

    def add_note(self, line: str) -> None:
        """Add a line to the log that is kept apart from those of libraries."""
        self._note_count += 1
        if self._note_count <= MAX_NOTE_LINES:
            self._lines.append(line)

    def on_event(self, event: dict[str, Any]) -> None:
        """Handle an event of the child."""
        kind = event["kind"]
        decoded = decode_event(kind, event)
        if isinstance(decoded, Warned):
            self.add_note(f"Warning: {decoded.message}")
        elif decoded is not None:
            self._progress_lines(decoded)
        elif kind == "error":
            for line in event.get("cause", ()):
                self.add_note(str(line))
        if kind == "stage_started":
            self._stage, self._time_left = event["stage"], TimeLeftEstimator()
            self._steps = int(event["total_steps"])
            self._set_progress({"stage": self._stage, "step": 0, "total_steps": self._steps or None})
        elif kind == "kernels_compiled":
            self._time_left.leave_out(float(event["seconds"]))
        elif kind == "stage_progress":
            self._on_stage_progress(event)
        elif kind == "training_progress":
            self._steps = int(event["total_iterations"])  # which a time decides, and an early end changes
            self._keeps_progress = False
            self._set_progress(
                {
                    "stage": self._stage,
                    "step": event["iteration"],
                    "total_steps": self._steps,
                    # what follows is a stage of its own
                    "seconds_left": event["seconds_left"] - event.get("seconds_after", 0.0),
                    "training_psnr": event["psnr"],
                    "event": encode_training_progress(event),
                }
            )
        elif kind == "checkpoint_written":
            self._want_checkpoint(event["iteration"])
        elif kind == "stage_finished":
            # The last step comes before the end in the event log too, and is not lost to the next first one.
            if self._progress is not None and "event" in self._progress:
                self._events.append(("progress", self._progress.pop("event")))
            self._keeps_progress = self._keeps_progress and event["stage"] != "train"
            if event["stage"] in ("poses", "placing", "lenses", "train", "residual"):
                self._want_checkpoint(self._steps if event["stage"] in ("poses", "train", "residual") else 0)
        elif kind == BlocksPlanned.kind:
            self.blocks_planned = read_planned_blocks(event)
        elif kind == "preview_written":
            self._preview = event
            self._wake.set()
        elif kind == "live_scene_written":
            self._live_scene = event
            self._wake.set()
        if kind in _STORED_EVENT_KINDS:
            self._events.append((kind, {key: value for key, value in event.items() if key != "kind"}))

    async def finish(self) -> None:
        """Write everything that is pending, including the last checkpoint."""
        async with self._flushing:  # a flush that is under way would lose what it has taken
            for task in self._tasks:
                task.cancel()
        await cancel_and_wait(self._tasks)
        with contextlib.suppress(*_IGNORED_ERRORS):
            await self._flush()
        await self._store_pending()
        with contextlib.suppress(*_IGNORED_ERRORS):  # what could not be stored is told, too
            await self._flush()

    async def close(self) -> None:
        """Stop without writing what is pending."""
        await cancel_and_wait(self._tasks)

    def _set_progress(self, progress: dict[str, Any]) -> None:
        if not self._keeps_progress:
            self._progress = progress

    def _on_stage_progress(self, event: dict[str, Any]) -> None:
        step, total = int(event["step"]), int(event["total_steps"])
        self._set_progress(
            {
                "stage": event["stage"],
                "step": step,
                "total_steps": total,
                "seconds_left": self._time_left.seconds_left(
                    *work_of_stage(step, total, float(event.get("part", 0.0)), event.get("work_done"))
                ),
                "event": {key: value for key, value in event.items() if key != "kind"},
            }
        )

    def _want_checkpoint(self, step: int) -> None:
        self._wanted_checkpoint = (self._stage, step)
        self._wake.set()

    async def _flush_forever(self) -> None:
        while True:
            await asyncio.sleep(FLUSH_SECONDS)
            try:
                async with self._flushing:
                    await self._flush()
            except FencedError:
                # Another attempt has the job, and nothing of this one may be written any more.
                return
            except _IGNORED_ERRORS as error:
                logger.info("progress of job %s was not written: %s", self._attempt.job.id, error)
            except Exception:
                logger.exception("progress of job %s was not written", self._attempt.job.id)

    async def _flush(self) -> None:
        # Taken before the writes: what cannot be written is dropped and does not delay what follows.
        progress, self._progress = self._progress, None
        events, self._events = tuple(self._events), deque(maxlen=_MAX_PENDING_EVENTS)
        lines, self._lines = tuple(self._lines), []
        for kind, data in events:
            await self._attempt.add_event(kind, data)
        if progress is not None:
            await self._attempt.set_progress(**progress)
        if lines:
            await self._attempt.add_log_lines(lines)

    async def _store_forever(self) -> None:
        while True:
            await self._wake.wait()
            self._wake.clear()
            try:
                await self._store_pending()
            except FencedError:
                return
            except Exception:
                logger.exception("what job %s has reached was not stored", self._attempt.job.id)

    async def _store_pending(self) -> None:
        """Store the newest checkpoint and picture, if there are new ones."""
        pending, self._wanted_checkpoint = self._wanted_checkpoint, None
        preview, self._preview = self._preview, None
        live_scene, self._live_scene = self._live_scene, None
        what = "checkpoint"
        try:
            if pending is not None:
                await self._store_checkpoint(*pending)
                pending = None
            what = "preview"
            if preview is not None:
                await self._store_preview(preview)
                preview = None
            what = "live scene"
            if live_scene is not None:
                await self._store_live_scene(live_scene)
        except asyncio.CancelledError:
            # Pending again, so that finish() stores what was interrupted.
            self._wanted_checkpoint = self._wanted_checkpoint or pending
            self._preview = self._preview or preview
            self._live_scene = self._live_scene or live_scene
            raise
        except (*TREE_ERRORS, *_IGNORED_ERRORS) as error:
            logger.warning("a %s of job %s was not stored: %s", what, self._attempt.job.id, error)
            self.add_note(f"Warning: a {what} could not be stored: {error}")
            # A checkpoint is tried again with the next wish to store, unless that is for a newer checkpoint.
            self._wanted_checkpoint = self._wanted_checkpoint or pending

    async def _store_preview(self, event: Mapping[str, Any]) -> None:
        async with storage_lease(self._attempt.pool, self._workspace.storage) as note:
            sha256 = await asyncio.to_thread(self._workspace.store_file, f"{RUN_FOLDER}/{event['path']}")
            row = {"sha256": sha256, "step": event["step"], "view": event["view"]}
            await self._attempt.record_preview(row, note, block_positions=read_block_positions(event))

    async def _store_live_scene(self, event: Mapping[str, Any]) -> None:
        async with storage_lease(self._attempt.pool, self._workspace.storage) as note:
            sha256, views_sha256 = [
                await asyncio.to_thread(self._workspace.store_file, f"{RUN_FOLDER}/{event[name]}")
                for name in ("path", "views")
            ]
            scene = LiveScene(
                self._attempt.job.id,
                sha256,
                views_sha256,
                int(event["step"]),
                int(event["gaussians"]),
                read_block_gaussians(event),
            )
            await self._attempt.record_live_scene(scene, note)

    async def _store_checkpoint(self, stage: str, step: int) -> None:
        if not self._stores_checkpoints:
            return
        async with storage_lease(self._attempt.pool, self._workspace.storage) as note:
            checkpoint = await asyncio.to_thread(self._workspace.store_checkpoint, stage, step)
            if checkpoint is None:
                return
            advances = checkpoint.is_after(self._checkpoint)
            try:
                await self._attempt.record_checkpoint(checkpoint.as_row(), is_progress=advances, lease=note)
            except QuotaExceededError as error:
                if checkpoint.is_of_pose_search:  # which is much larger than what comes of it
                    self.add_note(f"Warning: the state of the search for poses is not kept: {error}")
                    return
                # No more of them, as each would lie in the store for a while although nothing names it.
                self._stores_checkpoints = False
                self.add_note(f"Warning: from here on no checkpoints are kept: {error}")
                return
            self._checkpoint = checkpoint
        # Not earlier: until the row names them, a later attempt could not fetch the frames.
        await asyncio.to_thread(self._workspace.stored_frames.remove_files)

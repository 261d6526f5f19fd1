"""Plays the part of a worker: takes a queued job and tells of a finished run folder as if it happened now."""

import asyncio
import json
import uuid
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from octasplat.workers.db.connections import open_pool
from octasplat.workers.db.events_and_logs import add_event
from octasplat.workers.db.live_scenes import LiveScene, put_live_scene
from octasplat.workers.queue.attempts import Attempt
from octasplat.workers.queue.claims import claim
from octasplat.workers.queue.job_results import ResultFile
from octasplat.workers.queue.jobs import get_job
from octasplat.workers.reporting.events import encode_training_progress
from octasplat.workers.storage.local import LocalStorage
from octasplat.workers.worker.media_types import media_type

IGNORED_EVENTS = ("checkpoints", "cache")


class RunReplay:
    """A worker of the test's own.

    Args:
        conninfo: of the database.
        store: folder of the store.
    """

    def __init__(self, conninfo: str, store: Path) -> None:
        self._conninfo = conninfo
        self._storage = LocalStorage(store, floor_bytes=0)

    def store(self, path: Path) -> str:
        """Put a file into the store; its digest."""
        data = path.read_bytes()
        with self._storage.open_writer(size_bytes=len(data)) as writer:
            writer.write(data)
            return writer.commit().sha256

    def run(
        self, job_id: uuid.UUID, run: Path, *, until: int | None = None,
        preview: Mapping[str, Any] | None = None, error: Mapping[str, Any] | None = None,
    ) -> None:  # fmt: skip
        """Begin an attempt, tell of the run's events, and end it.

        Args:
            job_id: a queued job.
            run: folder of a finished run.
            until: stop telling at this iteration and leave the job running.
            preview: ``path``, ``view`` and ``step`` of a picture.
            error: end as failed with this.
        """
        asyncio.run(self._run(job_id, run, until, preview, error))

    def show_live(self, job_id: uuid.UUID, scene: Path, views: Path, *, step: int, gaussians: int) -> None:
        """Tell of a state of the training of a job that was left running."""
        row = LiveScene(job_id, self.store(scene), self.store(views), step, gaussians)
        asyncio.run(self._show_live(row))

    def show_progress(
        self, job_id: uuid.UUID, event: Mapping[str, Any], *, stage: str, seconds_left: float | None = None
    ) -> None:
        """Tell of a step of a job that was left running, and set its row.

        Args:
            job_id: the job.
            event: of the engine, as JSON.
            stage: that the step is of.
            seconds_left: of this stage.
        """
        is_training = event["kind"] == "training_progress"
        step, total = ("iteration", "total_iterations") if is_training else ("step", "total_steps")
        told = {key: value for key, value in event.items() if key != "kind"}
        told = encode_training_progress(event) if is_training else told
        row = (stage, event[step], event[total], seconds_left)
        asyncio.run(self._tell(job_id, row, [("progress", told)]))

    def begin_stage(self, job_id: uuid.UUID, former: str, stage: str, *, seconds: float, steps: int) -> None:
        """Tell of a job that was left running that a stage has ended, and the next begins."""
        finished = ("stage_finished", {"stage": former, "seconds": seconds})
        started = ("stage_started", {"stage": stage, "total_steps": steps})
        asyncio.run(self._tell(job_id, (stage, 0, steps, None), [finished, started]))

    async def _tell(
        self,
        job_id: uuid.UUID,
        row: tuple[str, int, int, float | None],
        events: Sequence[tuple[str, Mapping[str, Any]]],
    ) -> None:
        async with (
            open_pool(self._conninfo, max_size=1, wait_seconds=10) as pool,
            pool.connection() as connection,
        ):
            job = await get_job(connection, job_id)
            assert job is not None and job.state == "running"
            await connection.execute(
                "UPDATE jobs SET stage = %s, step = %s, total_steps = %s, seconds_left = %s WHERE id = %s",
                [*row, job_id],
            )
            for kind, told in events:
                await add_event(connection, job_id, job.attempt, kind, told)

    async def _show_live(self, row: LiveScene) -> None:
        async with (
            open_pool(self._conninfo, max_size=1, wait_seconds=10) as pool,
            pool.connection() as connection,
        ):
            await put_live_scene(connection, row)
            told = {"step": row.step, "gaussians": row.gaussians}
            await add_event(connection, row.job_id, 1, "live_scene", told)

    async def _run(
        self, job_id: uuid.UUID, run: Path, until: int | None, preview: Mapping[str, Any] | None,
        error: Mapping[str, Any] | None,
    ) -> None:  # fmt: skip
        async with open_pool(self._conninfo, max_size=2, wait_seconds=10) as pool:
            async with pool.connection() as connection:
                job = await get_job(connection, job_id)
            assert job is not None and job.slip is not None
            attempt = await claim(pool, job_id, job.slip, "a-worker")
            assert attempt is not None
            await attempt.add_log_lines(["engine starts", f"reading {job.options.get('preset')} settings"])
            stage = "load"
            for line in (run / "events.jsonl").read_text().splitlines():
                event = json.loads(line)
                kind = event.pop("kind")
                event.pop("time", None)
                if kind == "stage_started":
                    stage = event["stage"]
                if kind == "training_progress":
                    if until is not None and event["iteration"] > until:
                        break
                    await attempt.set_progress(
                        stage=stage, step=event["iteration"], total_steps=event["total_iterations"],
                        seconds_left=event["seconds_left"], training_psnr=event["psnr"],
                        event=encode_training_progress(event),
                    )  # fmt: skip
                elif kind in (
                    "stage_started",
                    "stage_finished",
                    "held_out_measured",
                    "warning",
                    "run_finished",
                ):
                    await attempt.add_event(kind, event)
            if preview is not None:
                row = {**preview, "sha256": self.store(Path(preview["path"]))}
                del row["path"]
                await attempt.record_preview(row)
            if error is not None:
                await attempt.fail(error)
            elif until is None:
                await self._publish(attempt, run)

    async def _publish(self, attempt: Attempt, run: Path) -> None:
        results = []
        for path in sorted(run.rglob("*")):
            name = path.relative_to(run)
            if path.is_file() and name.parts[0] not in IGNORED_EVENTS and not name.name.startswith("."):
                sha256 = self.store(path)
                results.append(
                    ResultFile(name.as_posix(), sha256, path.stat().st_size, media_type(name.as_posix()))
                )
        await attempt.succeed(results)

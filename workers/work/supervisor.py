"""One attempt at a job: the child at work, the heartbeat beside it, and a verdict at the end."""

import asyncio
import logging
import math
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from enum import Enum
from pathlib import Path
from typing import Any, TypeVar

import psycopg

from octasplat.engine import versions
from octasplat.engine.errors import ConfigError, OctasplatError
from octasplat.workers.ending import end
from octasplat.workers.isolation.confining import MOST_PROCESSES
from octasplat.workers.queue.attempts import Attempt, Fenced
from octasplat.workers.queue.jobs import artifacts_of
from octasplat.workers.queue.limits import seconds_spent
from octasplat.workers.records.datasets import files_of, get_dataset
from octasplat.workers.store.errors import BlobMissing, DigestMismatch, StorageError, StorageFull
from octasplat.workers.work.child_process import ChildProcess
from octasplat.workers.work.contact import DATABASE_ERRORS, Contact
from octasplat.workers.work.kinds import JobKind, kind_named
from octasplat.workers.work.places import Places, shown_in
from octasplat.workers.work.reporter import Reporter
from octasplat.workers.work.surroundings import LostDatabase, Surroundings
from octasplat.workers.work.task import EXIT_REFUSED, EXIT_STOPPED, EXIT_UNEXPECTED, NO_SPACE
from octasplat.workers.work.verdicts import Verdicts
from octasplat.workers.work.workspace import Checkpoint, Workspace

logger = logging.getLogger(__name__)
T = TypeVar("T")

CANCEL_SECONDS = 10.0
_EYE = ThreadPoolExecutor(1, "watch")
"""A thread for watching children; the common ones may all be waiting for a store that is cut off as well."""


class End(Enum):
    """Why a child was stopped before its time."""

    FENCED = "the job has gone on without this worker"
    LOST = "the database was lost"
    CANCELED = "its owner cancelled it"
    LEAVING = "its worker is stopping"
    SILENT = "its program said nothing for too long"
    TIME = "it ran for longer than allowed"
    MEMORY = "its program needed more memory than allowed"
    PROCESSES = "it started more processes than allowed"
    DISK = "its folder took more than allowed"
    ROOM = "it took room that is reserved"


class Supervisor:
    """Runs one attempt.

    Args:
        attempt: the claimed job.
        around: the worker.
        since: when the claim was asked for, by ``time.monotonic()``.

    """

    def __init__(self, attempt: Attempt, around: Surroundings, since: float) -> None:
        self._workspace = Workspace(around.settings.work_folder, attempt.job, around.storage)
        others = (Path(around.settings.storage_address), around.settings.data)
        places = Places(self._workspace.folder, around.settings.work_folder, others)
        self._attempt = attempt = replace(
            attempt, shown=lambda value: shown_in(value, places), quota=around.quota
        )
        self._around = around
        self._settings = around.settings
        self._job = attempt.job
        self._reporter = Reporter(attempt, self._workspace)
        self._child: ChildProcess | None = None
        self._end: End | None = None
        self._kill_at = math.inf
        self._news = asyncio.Event()
        self._contact = Contact(attempt, around.settings, since)
        self._verdicts = Verdicts(
            attempt, around, self._workspace, self._reporter, self._contact, _program(attempt.job.kind)
        )
        self._time_up = math.inf

    async def run(self) -> None:
        """Work until the job is over, handed back or lost.

        Raises:
            LostDatabase: the database did not answer for too long.
        """
        watches = [
            asyncio.create_task(watch())
            for watch in (self._watch_contact, self._watch_clock, self._watch_leaving)
        ]
        try:
            await self._work()
        except Fenced:
            logger.warning("attempt %d of job %s is over: others have it", self._job.attempt, self._job.id)
        except psycopg.DataError as error:
            await self._verdicts.refuse(error)
        except DATABASE_ERRORS as error:
            raise LostDatabase(str(error)) from error
        finally:
            if self._child is not None:
                self._child.kill()
            await end(watches)
            await self._reporter.close()
            await asyncio.to_thread(self._workspace.close)
            self._around.taken_bytes.pop(self._job.id, None)

    async def _work(self) -> None:
        try:
            await asyncio.to_thread(self._workspace.open)
            earlier = await asyncio.to_thread(self._workspace.published_before)
            if earlier is not None:
                await self._verdicts.succeed(earlier)
                return
            kind = kind_named(self._job.kind)
            task = await self._prepare(kind)
        except OctasplatError as error:
            await self._verdicts.give_up(error)
            return
        if self._end is not None:
            await self._after_stop(self._end)
            return
        try:
            self._child = await ChildProcess.start(task, self._reporter.hear, self._reporter.log)
        except OSError as error:
            what = f"The job's program cannot be started ({error.strerror or error})."
            await self._verdicts.blame(what)
            return
        code = await self._wait_for_child(self._child)
        if self._end not in (End.FENCED, End.LOST):
            await self._reporter.finish()
        # A program that was done before it heard of the wish to stop has succeeded.
        if code == 0 and self._end in (None, End.CANCELED, End.LEAVING):
            await self._verdicts.publish()
        elif self._end is not None:
            await self._after_stop(self._end)
        elif self._child.is_ready:
            await self._after_exit(self._child, code)
        else:
            said = self._child.error["message"] if self._child.error is not None else f"code {code}"
            await self._verdicts.blame(f"The job's program ended before it began: {said}")

    async def _prepare(self, kind: JobKind) -> dict[str, Any]:
        """Fill the workspace; returns the child's task."""
        job, settings = self._job, self._settings
        options = kind.options.model_validate(job.options)
        scene, title = None, ""
        async with self._attempt.pool.connection() as connection:
            dataset = await get_dataset(connection, job.dataset_id) if job.dataset_id else None
            files = await files_of(connection, job.dataset_id) if job.dataset_id else []
            artifacts = await artifacts_of(connection, job.source_id) if job.source_id else []
            named = await files_of(connection, job.files_id) if job.files_id else []
            left = 3600 * settings.max_job_hours - await seconds_spent(connection, job)
        self._time_up = time.monotonic() + left
        checkpoint = None if job.checkpoint is None else Checkpoint.from_row(job.checkpoint)
        copied = sum(a.size_bytes for a in artifacts if a.name in kind.source_files)
        copied += sum(file.size_bytes for file in checkpoint.files) if checkpoint is not None else 0
        await asyncio.to_thread(self._around.room.ensure_for_work, copied)
        if dataset is not None and (kind.needs == "dataset" or kind.needs_photographs(options)):
            title = dataset.name
            scene = await asyncio.to_thread(self._workspace.fetch_dataset, dataset.id, files, dataset.name)
        if kind.needs == "result":
            await asyncio.to_thread(self._workspace.fetch_source, artifacts, kind.source_files)
        if named:
            await asyncio.to_thread(self._workspace.fetch_files, named)
        if checkpoint is not None:
            await self._restore(checkpoint)
        self._reporter.expect(kind.stages(options))
        return {
            "program": kind.program,
            "kind": kind.name,
            "kind_modules": list(settings.kind_modules),
            "folder": str(self._workspace.folder),
            "options": job.options,
            "scene": str(scene) if scene else None,
            "title": title,
            "threads": settings.threads,
            "hidden": [str(folder) for folder in settings.own_folders],
            "memory_limit_bytes": self._around.memory_limit_bytes,
        }

    async def _restore(self, checkpoint: Checkpoint) -> None:
        if checkpoint.results != versions.RESULTS:
            self._reporter.note(
                "Warning: the checkpoint is of a version in which the same settings gave other results, so "
                "the job begins anew."
            )
            return
        try:
            await asyncio.to_thread(self._workspace.restore, checkpoint)
        except (BlobMissing, DigestMismatch) as error:
            await asyncio.to_thread(self._workspace.discard_run)
            self._reporter.note(f"Warning: the checkpoint cannot be used, so the job begins anew: {error}")
            return
        self._reporter.resumed_from(checkpoint)
        data = {"stage": checkpoint.stage, "step": checkpoint.step, "attempt": checkpoint.attempt}
        await self._attempt.tell("resumed", data)

    async def _after_stop(self, end: End) -> None:
        if end is End.FENCED:
            raise Fenced
        if end is End.LOST:
            raise LostDatabase(end.value)
        if end is End.CANCELED:
            await self._verdicts.cancel()
        elif end is End.LEAVING:
            await self._verdicts.hand_back(end.value)
        elif end is End.SILENT:
            seconds = self._settings.silent_seconds
            message = f"The job's program said nothing for {seconds:g} s and was stopped."
            await self._verdicts.lose({"type": "silent", "message": message})
        elif end is End.TIME:
            message = (
                f"The job ran for {self._settings.max_job_hours:g} hours, as long as it may; ask for fewer "
                "iterations or rays, or retry it, which goes on from its checkpoint."
            )
            await self._verdicts.fail({"type": "time_limit", "message": message})
        elif end is End.PROCESSES:
            message = f"The job's program started more than {MOST_PROCESSES} others and was stopped."
            await self._verdicts.fail({"type": "process_limit", "message": message})
        elif end is End.DISK:
            taken, most = self._workspace.most_taken_bytes(), self._settings.max_workspace_bytes
            message = f"The job's folder took {taken} bytes, and {most} are allowed; ask for fewer images."
            await self._verdicts.fail({"type": "disk_limit", "message": message})
        elif end is End.ROOM:
            taken = self._workspace.most_taken_bytes()
            message = f"The job was stopped with {taken} bytes in its folder, as its disk was full."
            await self._verdicts.let_go({"type": NO_SPACE, "message": message})
        else:
            limit = (self._around.memory_limit_bytes or 0) / 2**30
            message = (
                f"The job needed more than the {limit:.1f} GB of memory that it may use; "
                "use fewer Gaussians, smaller photographs, or a machine with more."
            )
            await self._verdicts.fail({"type": "memory_limit", "message": message})

    async def _after_exit(self, child: ChildProcess, code: int) -> None:
        if code in (EXIT_REFUSED, EXIT_UNEXPECTED) and child.error is not None:
            error = child.error
            # What fails on a full disk may well succeed on another.
            if error["type"] == NO_SPACE or await self._around.lacking_room() is not None:
                await self._verdicts.let_go(error)
            else:
                await self._verdicts.fail(error)
        elif code == EXIT_STOPPED:
            # Somebody else asked the child to stop; it wrote what is needed to go on.
            await self._verdicts.hand_back("its program was stopped")
        else:
            how = f"by signal {-code}" if code < 0 else f"with exit code {code}"
            last = f" Its last words: {child.last_words[-1]}" if child.last_words else ""
            message = f"The job's program ended {how}.{last}"
            self._around.host.crashed(self._job.id, self._job.owner)
            await self._verdicts.lose({"type": "crashed", "message": message})

    async def _wait_for_child(self, child: ChildProcess) -> int:
        """Wait for the child's end, which is brought about if anything asks for it."""
        exited = asyncio.create_task(child.wait())
        limits = asyncio.create_task(self._watch_limits(child))
        asked = False
        try:
            while not exited.done():
                left = self._kill_at - time.monotonic()
                if left <= 0:
                    child.kill()
                    break
                if self._end is not None and not asked:
                    child.ask_to_stop()
                    asked = True
                self._news.clear()
                news = asyncio.create_task(self._news.wait())
                timeout = left if math.isfinite(left) else None
                await asyncio.wait({exited, news}, timeout=timeout, return_when=asyncio.FIRST_COMPLETED)
                news.cancel()
            return await exited
        finally:
            limits.cancel()

    async def _watch_contact(self) -> None:
        """Say that the worker lives, and hear of the wishes of others."""
        try:
            await self._contact.keep(lambda state: self._stop(End.CANCELED) if state == "canceling" else None)
        except Fenced:
            self._stop(End.FENCED)

    async def _watch_clock(self) -> None:
        await self._contact.until_lost()
        self._stop(End.LOST)

    async def _watch_leaving(self) -> None:
        await self._around.leaving.wait()
        self._stop(End.LEAVING)

    async def _watch_limits(self, child: ChildProcess) -> None:
        """Stop a child that is silent, late or too big, also one that was asked to stop already."""
        settings, loop = self._settings, asyncio.get_running_loop()
        while True:
            await asyncio.sleep(min(1.0, settings.silent_seconds / 4))
            if time.monotonic() - child.last_heard > settings.silent_seconds:
                self._stop(End.SILENT)
            if settings.max_job_hours and time.monotonic() > self._time_up:
                self._stop(End.TIME)
            limit = self._around.memory_limit_bytes
            if limit is not None and await loop.run_in_executor(_EYE, child.memory_bytes) > limit:
                self._stop(End.MEMORY)
            if await loop.run_in_executor(_EYE, child.process_count) > MOST_PROCESSES:
                self._stop(End.PROCESSES)
            await self._watch_disk()

    async def _watch_disk(self) -> None:
        """Stop a child that fills the disk; of several the one that took most."""
        around, loop = self._around, asyncio.get_running_loop()
        taken = await loop.run_in_executor(_EYE, self._workspace.taken_bytes)
        around.taken_bytes[self._job.id] = taken
        if 0 < self._settings.max_workspace_bytes < taken:
            self._stop(End.DISK)
        try:
            await loop.run_in_executor(_EYE, around.room.ensure_for_work, 0)
        except StorageFull:
            if taken >= max(around.taken_bytes.values()):
                self._stop(End.ROOM)
        except StorageError as error:
            logger.info("the disk of job %s was not looked at: %s", self._job.id, error)

    def _stop(self, end: End) -> None:
        """The first reason counts, but for the two that forbid writing; of the deadlines the earliest."""
        if self._end is None or end in (End.FENCED, End.LOST):
            self._end = end
        self._kill_at = min(self._kill_at, self._deadline(end))
        self._news.set()

    def _deadline(self, end: End) -> float:
        """Until when the child may go on to stop by itself, by ``time.monotonic()``."""
        now, grace = time.monotonic(), self._settings.grace_seconds
        if end is End.LOST:
            return self._contact.late_at
        if end is End.CANCELED:
            return now + min(CANCEL_SECONDS, grace)
        return now + grace if end in (End.LEAVING, End.TIME) else now


def _program(kind: str) -> str:
    """The program of a kind of jobs; none where this version does not know it."""
    try:
        return kind_named(kind).program
    except ConfigError:
        return ""

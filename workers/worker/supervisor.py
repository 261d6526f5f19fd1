"""One attempt at a job: the child process, its heartbeat, and its outcome."""

import asyncio
import logging
import math
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import psycopg

from octasplat.engine import __version__
from octasplat.engine.core import versions
from octasplat.engine.core.errors import ConfigError, OctasplatError
from octasplat.engine.operations.precompile import request_groups
from octasplat.workers.cancellation import cancel_and_wait
from octasplat.workers.queue.attempts import Attempt, FencedError
from octasplat.workers.queue.job_deadlines import seconds_spent
from octasplat.workers.queue.job_endings import MAX_SILENT_RECOVERIES
from octasplat.workers.sandbox.confinement import MAX_PROCESSES
from octasplat.workers.storage.errors import (
    BlobNotFoundError,
    DigestMismatchError,
    UntrustedFileError,
)
from octasplat.workers.storage.untrusted_folder import MAX_DEPTH
from octasplat.workers.worker.checkpoint import Checkpoint
from octasplat.workers.worker.child_process import ChildProcess
from octasplat.workers.worker.context import DatabaseLostError, WorkerContext
from octasplat.workers.worker.heartbeat import DATABASE_ERRORS, Heartbeat
from octasplat.workers.worker.job_inputs import fetch_photographs, read_inputs
from octasplat.workers.worker.job_kinds import JobKind, get_job_kind
from octasplat.workers.worker.job_kinds.stored_options import resolve_here
from octasplat.workers.worker.kernels import compile_for_job
from octasplat.workers.worker.outcomes import OutcomeWriter
from octasplat.workers.worker.path_redaction import PathRedactor, redact_json
from octasplat.workers.worker.reporter import Reporter
from octasplat.workers.worker.stop_reasons import StopReason, disk_stop_reason
from octasplat.workers.worker.task import EXIT_REFUSED, EXIT_STOPPED, EXIT_UNEXPECTED, NO_SPACE_ERROR
from octasplat.workers.worker.workspace import Workspace

logger = logging.getLogger(__name__)
T = TypeVar("T")

MAX_CANCEL_SECONDS = 10.0
_WATCH_POOL = ThreadPoolExecutor(1, "watch")
"""A thread for watching children; the common ones may all be waiting for a store that is cut off as well."""


class Supervisor:
    """Runs one attempt.

    Args:
        attempt: the claimed job.
        context: the worker.
        claimed_at: when the claim was asked for, by ``time.monotonic()``.
    """

    def __init__(self, attempt: Attempt, context: WorkerContext, claimed_at: float) -> None:
        self._workspace = Workspace(context.settings.work_folder, attempt.job, context.storage)
        others = (Path(context.settings.storage_address), context.settings.data)
        places = PathRedactor(self._workspace.folder, context.settings.work_folder, others)
        # All that the attempt writes for users is rid of the paths of this machine.
        self._attempt = attempt = replace(
            attempt, redact=lambda value: redact_json(value, places), quota=context.quota
        )
        self._context = context
        self._settings = context.settings
        self._job = attempt.job
        self._reporter = Reporter(attempt, self._workspace)
        self._child: ChildProcess | None = None
        self._stop_reason: StopReason | None = None
        self._kill_at = math.inf
        self._stop_event = asyncio.Event()
        self._heartbeat = Heartbeat(attempt, context.settings, claimed_at)
        self._outcomes = OutcomeWriter(
            attempt=attempt,
            context=context,
            workspace=self._workspace,
            reporter=self._reporter,
            heartbeat=self._heartbeat,
            program=_program_of_kind(attempt.job.kind),
        )
        self._deadline_at = math.inf

    async def run(self) -> None:
        """Work until the job is over, requeued or lost.

        Raises:
            DatabaseLostError: the database did not answer for too long.
        """
        watches = [
            asyncio.create_task(watch())
            for watch in (self._run_heartbeat, self._watch_database, self._watch_draining)
        ]
        try:
            await self._work()
        except FencedError:
            logger.warning("attempt %d of job %s is over: others have it", self._job.attempt, self._job.id)
        except psycopg.DataError as error:
            await self._outcomes.fail_refused_value(error)
        except DATABASE_ERRORS as error:
            raise DatabaseLostError(str(error)) from error
        finally:
            # After an error of this program too: no child may outlive its attempt.
            if self._child is not None:
                self._child.kill()
            await cancel_and_wait(watches)
            await self._reporter.close()
            await asyncio.to_thread(self._workspace.close)
            self._context.taken_bytes.pop(self._job.id, None)

    async def _work(self) -> None:
        try:
            await asyncio.to_thread(self._workspace.open)
            # The last attempt may have ended between publishing its results and writing its row.
            earlier = await asyncio.to_thread(self._workspace.find_published_results)
            if earlier is not None:
                await self._outcomes.succeed(earlier)
                return
            kind = get_job_kind(self._job.kind)
            task = await self._prepare(kind)
        except OctasplatError as error:
            await self._outcomes.handle_error(error)
            return
        if self._stop_reason is not None:  # it was asked to stop while the folder was filled
            await self._after_stop(self._stop_reason)
            return
        try:
            self._child = await ChildProcess.start(task, self._reporter.on_event, self._reporter.log)
        except OSError as error:
            what = f"The job's program cannot be started ({error.strerror or error})."
            await self._outcomes.diagnose_and_requeue(what)
            return
        code = await self._wait_for_child(self._child)
        # Else the rows may be those of another attempt by now, and what is pending is dropped.
        if self._stop_reason not in (StopReason.FENCED, StopReason.DATABASE_LOST):
            await self._reporter.finish()
        # A program that was done before it heard of the wish to stop has succeeded.
        if code == 0 and (self._stop_reason is None or self._stop_reason.gives_time):
            planned = self._reporter.blocks_planned
            if planned is not None and kind.block_kind:
                await self._outcomes.start_blocks(planned, kind, task["options"])
            else:
                await self._outcomes.publish()
        elif self._stop_reason is not None:
            await self._after_stop(self._stop_reason)
        elif self._child.is_ready:
            await self._after_exit(self._child, code)
        else:
            # The job's own code was not reached, so that this machine is suspected first.
            error_text = self._child.error["message"] if self._child.error is not None else f"code {code}"
            await self._outcomes.diagnose_and_requeue(
                f"The job's program ended before it began: {error_text}"
            )

    async def _prepare(self, kind: JobKind) -> dict[str, Any]:
        """Fill the workspace; returns the child's task."""
        job, settings = self._job, self._settings
        options = resolve_here(kind, job)
        complete = options.model_dump(mode="json")
        await self._attempt.record_settings(complete, __version__)
        scene, title = None, ""
        async with self._attempt.pool.connection() as connection:
            inputs = await read_inputs(connection, job, kind, options)
            # The limit is for all attempts of the job together.
            left = 3600 * settings.max_job_hours - await seconds_spent(connection, job)
        self._deadline_at = time.monotonic() + left
        checkpoint = None if job.checkpoint is None else Checkpoint.from_row(job.checkpoint)
        copied = inputs.copied_bytes(kind)
        if checkpoint is not None:
            fetched = self._workspace.stored_frames.fetched(checkpoint.files)
            copied += sum(file.size_bytes for file in fetched)
        await asyncio.to_thread(self._context.disk_space.ensure_workspace, copied)
        if kind.needs == "result":
            await asyncio.to_thread(self._workspace.fetch_source, inputs.artifacts, kind.source_files)
        if inputs.named:
            await asyncio.to_thread(self._workspace.fetch_files, inputs.named)
        is_restored = checkpoint is not None and await self._restore(checkpoint)
        # What blocks have made goes with the plan that is in the checkpoint.
        if inputs.others and (job.root_id is not None or is_restored):
            lost = await asyncio.to_thread(self._workspace.fetch_from_others, inputs.others)
            await self._attempt.drop_lost_blocks(lost)
        dataset = inputs.dataset
        if dataset is not None and (kind.needs == "dataset" or kind.needs_photographs(options)):
            title = dataset.name
            scene = await asyncio.to_thread(fetch_photographs, self._workspace, kind, options, inputs)
        begins_with = None
        if kind.starts_from_result(options) and not self._workspace.has_start():
            starts = inputs.starts
            begins_with = await asyncio.to_thread(self._workspace.fetch_start, job.source_id, starts)
        self._reporter.set_stages(kind.stages(options))
        await compile_for_job(
            request_groups(kind.name, options),
            self._reporter.add_note,
            lambda: self._stop_reason is not None,
        )
        # Last, as files that are written afterwards would belong to the worker's user.
        uids, workspace = settings.job_uids, self._workspace
        uid = await asyncio.to_thread(workspace.give_to_user, uids) if uids is not None else None
        return {
            "uid": uid,
            "program": kind.program,
            "kind": kind.name,
            "kind_modules": list(settings.kind_modules),
            "folder": str(self._workspace.folder),
            "options": complete,
            "scene": str(scene) if scene else None,
            "title": title,
            "begins_with": str(begins_with) if begins_with else None,
            "requested": job.requested,
            "threads": settings.threads,
            "hidden": [str(folder) for folder in settings.own_folders],
            "memory_limit_bytes": self._context.memory_limit_bytes,
        }

    async def _restore(self, checkpoint: Checkpoint) -> bool:
        """Restore a checkpoint; return False where it cannot be used, so that the job begins anew."""
        if checkpoint.results != versions.RESULTS_VERSION:
            await self._tell_begun_anew(
                "the checkpoint is of a version in which the same settings gave other results, so the job "
                "begins anew."
            )
            return False
        try:
            await asyncio.to_thread(self._workspace.restore, checkpoint)
        except (BlobNotFoundError, DigestMismatchError) as error:
            await asyncio.to_thread(self._workspace.discard_run)
            await self._tell_begun_anew(f"the checkpoint cannot be used, so the job begins anew: {error}")
            return False
        self._reporter.record_resume(checkpoint, keeps_progress=self._job.attempt in self._job.continuations)
        data = {"stage": checkpoint.stage, "step": checkpoint.step, "attempt": checkpoint.attempt}
        await self._attempt.add_event("resumed", data)
        return True

    async def _tell_begun_anew(self, why: str) -> None:
        self._reporter.add_note(f"Warning: {why}")
        await self._attempt.record_begun_anew(f"{why[0].upper()}{why[1:]}")

    async def _after_stop(self, reason: StopReason) -> None:
        if reason is StopReason.FENCED:
            raise FencedError
        if reason is StopReason.DATABASE_LOST:
            raise DatabaseLostError(reason.value)
        if reason is StopReason.CANCELED:
            await self._outcomes.cancel()
        elif reason is StopReason.DRAINING:
            await self._outcomes.requeue(reason.value)
        elif reason is StopReason.SILENT:
            seconds = self._settings.silent_seconds
            message = f"The job's program said nothing for {seconds:g} s and was stopped."
            error = {"type": "silent", "message": message}
            await self._outcomes.requeue_or_fail(error, MAX_SILENT_RECOVERIES)
        elif reason is StopReason.TIME_LIMIT:
            message = (
                f"The job ran for {self._settings.max_job_hours:g} hours, as long as it may; ask for fewer "
                "iterations or rays, or retry it, which goes on from its checkpoint."
            )
            await self._outcomes.fail({"type": "time_limit", "message": message})
        elif reason is StopReason.PROCESS_LIMIT:
            message = f"The job's program started more than {MAX_PROCESSES} others and was stopped."
            await self._outcomes.fail({"type": "process_limit", "message": message})
        elif reason is StopReason.DISK_LIMIT:
            taken, most = self._workspace.peak_used_bytes(), self._settings.max_workspace_bytes
            message = f"The job's folder took {taken} bytes, and {most} are allowed; ask for fewer images."
            await self._outcomes.fail({"type": "disk_limit", "message": message})
        elif reason is StopReason.HIDDEN_FILES:
            message = (
                f"The job's folder holds folders that cannot be read, or more than {MAX_DEPTH} in each other."
            )
            await self._outcomes.fail({"type": UntrustedFileError.error_type, "message": message})
        elif reason is StopReason.UNWATCHED:
            message = "The job was stopped, as its limits could not be watched; see the log of the worker."
            await self._outcomes.requeue_or_fail({"type": "unwatched", "message": message})
        elif reason is StopReason.DISK_RESERVE:
            taken = self._workspace.peak_used_bytes()
            message = f"The job was stopped with {taken} bytes in its folder, as its disk was full."
            await self._outcomes.requeue_counted({"type": NO_SPACE_ERROR, "message": message})
        else:
            limit = (self._context.memory_limit_bytes or 0) / 2**30
            message = (
                f"The job needed more than the {limit:.1f} GB of memory that it may use; "
                "use fewer Gaussians, smaller photographs, or a machine with more."
            )
            await self._outcomes.fail({"type": "memory_limit", "message": message})

    async def _after_exit(self, child: ChildProcess, code: int) -> None:
        if code in (EXIT_REFUSED, EXIT_UNEXPECTED) and child.error is not None:
            error = child.error
            # What fails on a full disk may well succeed on another.
            if error["type"] == NO_SPACE_ERROR or await self._context.space_shortage() is not None:
                await self._outcomes.requeue_counted(error)
            else:
                await self._outcomes.fail(error)
        elif code == EXIT_STOPPED:
            # Somebody else asked the child to stop; it wrote what is needed to go on.
            await self._outcomes.requeue("its program was stopped")
        else:
            how = f"by signal {-code}" if code < 0 else f"with exit code {code}"
            last = f" Its last words: {child.last_log_lines[-1]}" if child.last_log_lines else ""
            message = f"The job's program ended {how}.{last}"
            self._context.host_health.record_crash(self._job.id, self._job.owner)
            await self._outcomes.requeue_or_fail({"type": "crashed", "message": message})

    async def _wait_for_child(self, child: ChildProcess) -> int:
        """Wait for the child's end, and stop it when something requires that."""
        exited = asyncio.create_task(child.wait())
        limits = asyncio.create_task(self._watch_limits(child))
        limits.add_done_callback(self._on_limits_end)
        is_asked_to_stop = False
        try:
            while not exited.done():
                left = self._kill_at - time.monotonic()
                if left <= 0:
                    child.kill()
                    break
                if self._stop_reason is not None and not is_asked_to_stop:
                    child.request_stop()
                    is_asked_to_stop = True
                # Nothing is awaited between the checks above and this, so that no request is lost.
                self._stop_event.clear()
                news = asyncio.create_task(self._stop_event.wait())
                timeout = left if math.isfinite(left) else None
                await asyncio.wait({exited, news}, timeout=timeout, return_when=asyncio.FIRST_COMPLETED)
                news.cancel()
            return await exited
        finally:
            limits.cancel()

    async def _run_heartbeat(self) -> None:
        """Write heartbeats, and handle requests to cancel or stop."""
        try:
            await self._heartbeat.run(
                lambda state: self._stop(StopReason.CANCELED) if state == "canceling" else None
            )
        except FencedError:
            self._stop(StopReason.FENCED)

    async def _watch_database(self) -> None:
        await self._heartbeat.wait_until_lost()
        self._stop(StopReason.DATABASE_LOST)

    async def _watch_draining(self) -> None:
        await self._context.draining.wait()
        self._stop(StopReason.DRAINING)

    async def _watch_limits(self, child: ChildProcess) -> None:
        """Stop a child that is silent, late or too big, also one that was asked to stop already."""
        settings, loop = self._settings, asyncio.get_running_loop()
        while True:
            await asyncio.sleep(min(1.0, settings.silent_seconds / 4))
            if time.monotonic() - child.last_output_at > settings.silent_seconds:
                self._stop(StopReason.SILENT)
            if settings.max_job_hours and time.monotonic() > self._deadline_at:
                self._stop(StopReason.TIME_LIMIT)
            limit = self._context.memory_limit_bytes
            if limit is not None and await loop.run_in_executor(_WATCH_POOL, child.memory_bytes) > limit:
                self._stop(StopReason.MEMORY_LIMIT)
            if await loop.run_in_executor(_WATCH_POOL, child.process_count) > MAX_PROCESSES:
                self._stop(StopReason.PROCESS_LIMIT)
            await self._watch_disk()

    async def _watch_disk(self) -> None:
        """Stop a child that fills the disk."""
        if reason := await disk_stop_reason(self._context, self._workspace, self._job.id, _WATCH_POOL):
            self._stop(reason)

    def _on_limits_end(self, limits: "asyncio.Task[None]") -> None:
        """Stop a child that nobody watches; the watch ends with it, or by an error."""
        if not limits.cancelled() and (error := limits.exception()) is not None:
            logger.error("the limits of job %s are not watched any more", self._job.id, exc_info=error)
            self._stop(StopReason.UNWATCHED)

    def _stop(self, reason: StopReason) -> None:
        """Stop the child for ``reason``; the first reason counts, except for those that forbid writing."""
        if self._stop_reason is None or reason in (StopReason.FENCED, StopReason.DATABASE_LOST):
            self._stop_reason = reason
        # A further reason may shorten the time that is left, never lengthen it.
        self._kill_at = min(self._kill_at, self._kill_deadline(reason))
        self._stop_event.set()

    def _kill_deadline(self, reason: StopReason) -> float:
        """Return until when the child may take to stop by itself, by ``time.monotonic()``."""
        now, grace = time.monotonic(), self._settings.grace_seconds
        if reason is StopReason.DATABASE_LOST:
            return self._heartbeat.kill_at
        if reason is StopReason.CANCELED:
            return now + min(MAX_CANCEL_SECONDS, grace)
        # Time for a checkpoint, for the two reasons after which the job may go on.
        return now + grace if reason in (StopReason.DRAINING, StopReason.TIME_LIMIT) else now


def _program_of_kind(kind: str) -> str:
    """Return the program of a kind of jobs; none where this version does not know it."""
    try:
        return get_job_kind(kind).program
    except ConfigError:
        return ""

"""Outcomes of attempts, written to the database: succeeded, failed, requeued."""

import asyncio
import logging
from collections.abc import Awaitable, Callable, Mapping, Sequence
from typing import Any, TypeVar

import psycopg
from pydantic import BaseModel, ValidationError

from octasplat.engine.core.errors import OctasplatError
from octasplat.engine.core.portable_names import FileNameError
from octasplat.workers.db.quotas import QuotaExceededError
from octasplat.workers.queue.attempts import Attempt
from octasplat.workers.queue.block_jobs import NewBlock
from octasplat.workers.queue.job_endings import MAX_RECOVERIES
from octasplat.workers.queue.job_results import ResultFile
from octasplat.workers.queue.storage_leases import StorageLease, storage_lease
from octasplat.workers.storage.disk_space import SpaceUsage
from octasplat.workers.storage.errors import (
    BlobNotFoundError,
    DigestMismatchError,
    StorageError,
    StorageUnavailableError,
    UntrustedFileError,
)
from octasplat.workers.storage.os_errors import is_disk_full
from octasplat.workers.storage.trees import TREE_ERRORS
from octasplat.workers.worker.checkpoint import plan_digest
from octasplat.workers.worker.context import DatabaseLostError, WorkerContext
from octasplat.workers.worker.heartbeat import DATABASE_ERRORS, Heartbeat
from octasplat.workers.worker.job_kinds import JobKind, get_job_kind
from octasplat.workers.worker.reporter import Reporter
from octasplat.workers.worker.task import NO_SPACE_ERROR, BlocksPlanned
from octasplat.workers.worker.workspace import Workspace

logger = logging.getLogger(__name__)
T = TypeVar("T")

MAX_CONTRADICTIONS = 3
"""So often an outcome is told again that contradicts what others changed at the same time."""


class OutcomeWriter:
    """Writes the outcome of one attempt, with retries while the job is certainly ours.

    Every method raises DatabaseLostError when that time is over, and FencedError when the job has continued
    elsewhere.

    Args:
        attempt: the claimed job.
        context: the worker.
        workspace: of the attempt.
        reporter: of the attempt.
        heartbeat: tells whether the job is ours.
        program: of the job; empty where this version does not know its kind.
    """

    def __init__(
        self,
        attempt: Attempt,
        context: WorkerContext,
        workspace: Workspace,
        reporter: Reporter,
        heartbeat: Heartbeat,
        program: str,
    ) -> None:
        self._attempt = attempt
        self._context = context
        self._job = attempt.job
        self._workspace = workspace
        self._reporter = reporter
        self._heartbeat = heartbeat
        self._program = program

    async def publish(self) -> None:
        """Store the results and end the job with them."""
        try:
            results = await self._store_results()
        except TREE_ERRORS as error:
            await self.handle_error(error)
            return
        await self.succeed(results)

    async def succeed(self, results: list[ResultFile]) -> None:
        """Mark the job as succeeded with the ``results`` that are already published."""
        psnr = await asyncio.to_thread(self._workspace.read_psnr, results)
        try:
            job_queue = self._context.job_queue  # for what waited for the job
            await self._write_with_retries(lambda: self._attempt.succeed(results, psnr, job_queue=job_queue))
        except QuotaExceededError as error:
            problem = {"type": "quota", "message": f"The results cannot be stored. {error}"}
            await self._write_with_retries(lambda: self._attempt.fail(problem, discarded=results))
            # The next attempt would take the manifest for results that were published but not recorded.
            await self._discard_published_results()
        # The machine did its work in either case: a quota is its owner's matter.
        self._context.host_health.record_success()

    async def start_blocks(self, planned: BlocksPlanned, kind: JobKind, options: Mapping[str, Any]) -> None:
        """Store what the blocks begin with and queue them; the job waits for them.

        Args:
            planned: what the program has told.
            kind: of the job.
            options: complete ones of the job.
        """
        try:
            await self._store_and_start_blocks(planned, kind, kind.options.model_validate(dict(options)))
        except QuotaExceededError as error:
            problem = {"type": "quota", "message": f"What its blocks begin with cannot be stored. {error}"}
            await self._write_with_retries(lambda: self._attempt.fail(problem))
        except TREE_ERRORS as error:
            await self.handle_error(error)
        self._context.host_health.record_success()

    async def fail(self, error: dict[str, Any]) -> None:
        """Fail the job, with the results that its program has finished."""
        try:
            await self._with_partial_results(lambda results, note: self._attempt.fail(error, results, note))
        except (QuotaExceededError, FileNameError) as refusal:
            message = f"{error['message']} What it has finished cannot be stored. {refusal}"
            await self._write_with_retries(lambda: self._attempt.fail({**error, "message": message}))
        except StorageError as storage_error:
            await self.handle_error(storage_error)

    async def fail_refused_value(self, error: psycopg.DataError) -> None:
        """Fail the job because the database refused a value that was to be written."""
        logger.error("what was to be written about job %s is refused: %s", self._job.id, error)
        described = {
            "type": "refused_value",
            "message": "The job says something that cannot be written down.",
        }
        await self._write_with_retries(lambda: self._attempt.fail(described))

    async def cancel(self) -> None:
        """End the job as its owner requested."""
        await self._write_with_retries(self._attempt.cancel)

    async def requeue(self, reason: str) -> None:
        """Requeue the job for a reason that is not its own."""
        await self._write_with_retries(lambda: self._attempt.requeue(self._context.job_queue, reason))

    async def requeue_or_fail(self, error: dict[str, Any], max_recoveries: int = MAX_RECOVERIES) -> None:
        """Requeue the job after a failure that may be its own, or fail it with its finished results.

        Args:
            error: what happened.
            max_recoveries: lost attempts after which it fails.
        """
        # No attempt follows, so that what is finished is stored now.
        if self._job.rescues >= max_recoveries:
            try:
                await self._with_partial_results(
                    lambda results, note: self._requeue_counted(error, results, note, max_recoveries)
                )
                return
            except (*TREE_ERRORS, QuotaExceededError) as storage_error:
                logger.warning("the results there are could not be stored: %s", storage_error)
        await self._write_with_retries(lambda: self._requeue_counted(error, max_recoveries=max_recoveries))

    async def requeue_counted(self, error: dict[str, Any]) -> None:
        """Requeue the job for a reason that may pass; the attempt counts."""
        await self._write_with_retries(lambda: self._requeue_counted(error))

    async def handle_error(self, error: OctasplatError) -> None:
        """Requeue the job, or fail it, after an error around its program."""
        described = _error_as_dict(error)
        if isinstance(error, StorageUnavailableError):
            # A store that cannot be reached may be the fault of this machine, which is checked first.
            await self.diagnose_and_requeue(described["message"])
        elif isinstance(error, StorageError) and not isinstance(
            error, BlobNotFoundError | DigestMismatchError | UntrustedFileError
        ):
            await self.requeue_counted(described)
        else:
            # Contents that are missing or damaged stay so, and another attempt would end the same way.
            await self._write_with_retries(lambda: self._attempt.fail(described))

    async def diagnose_and_requeue(self, message: str) -> None:
        """Requeue the job after a failure; the attempt counts unless the machine is at fault."""
        found = await self._context.host_health.diagnose(self._program)
        if found is None:
            error = {"type": "crashed", "message": message}
            await self.requeue_counted(error)
        else:
            await self.requeue(f"The worker's machine is at fault, which takes no jobs for now: {found}")

    async def _requeue_counted(
        self,
        error: dict[str, Any],
        results: Sequence[ResultFile] = (),
        lease: StorageLease | None = None,
        max_recoveries: int = MAX_RECOVERIES,
    ) -> None:
        """Put the job back, which counts.

        Where room is lacking, and would be without the job too, that is no fault of the job. One that fills a
        disk itself is tried again a few times, later and later, as others may have gone by then.
        """
        lacking = await self._context.space_shortage()
        if lacking is None and error["type"] != NO_SPACE_ERROR:
            await self._attempt.requeue_lost(
                self._context.job_queue, error, results, lease, max_recoveries=max_recoveries
            )
            return
        message = f"{error['message']} {lacking or ''}".strip()
        kept_bytes, taken = (
            self._reporter.checkpoint_bytes,
            await asyncio.to_thread(self._workspace.peak_used_bytes),
        )
        # Were the disk full without this job's folder and checkpoint too, the job is not to blame.
        if await self._context.space_shortage(SpaceUsage(taken, kept_bytes + taken)) is not None:
            await self._attempt.requeue(self._context.job_queue, message)
            return
        # What it kept goes at the end if the store lacks room with it: nobody else could store anything.
        crowds = kept_bytes > 0 and await self._context.space_shortage(SpaceUsage(taken, taken)) is not None
        await self._attempt.requeue_lost(
            self._context.job_queue,
            {"type": NO_SPACE_ERROR, "message": message},
            results,
            lease,
            delay_seconds=self._context.settings.full_disk_seconds * 4**self._job.rescues,
            drop_checkpoint=crowds,
        )

    async def _store_results(self) -> list[ResultFile]:
        """Store the results and publish their manifest."""
        while True:
            try:
                async with storage_lease(self._attempt.pool, self._context.storage) as note:
                    manifest = await asyncio.to_thread(self._workspace.store_results)
                    contents = {file.sha256 for file in manifest.files}
                    await note.verify(contents)
                    results = await asyncio.to_thread(self._workspace.publish_results, manifest)
                    try:
                        # The manifest names them for whoever collects; nobody did before it was there.
                        await note.verify(contents)
                    except StorageUnavailableError:
                        await asyncio.to_thread(self._workspace.withdraw_results)
                        raise
                    return results
            except DATABASE_ERRORS as error:
                await self._pause_or_raise(error)

    async def _discard_published_results(self) -> None:
        """Delete the manifest of the published results, so that garbage collection removes them."""
        try:
            await asyncio.to_thread(self._workspace.withdraw_results)
        except StorageError as error:
            logger.warning("the results of job %s stay in the store: %s", self._job.id, error)

    async def _store_and_start_blocks(
        self, planned: BlocksPlanned, kind: JobKind, options: BaseModel
    ) -> None:
        first = planned.first_iterations
        block_kind = get_job_kind(kind.block_kind)

        def complete(given: Mapping[str, Any]) -> Mapping[str, Any] | None:
            try:
                found: dict[str, Any] = block_kind.options.model_validate(given).model_dump(mode="json")
            except ValidationError:
                return None
            return found

        while True:
            try:
                async with storage_lease(self._attempt.pool, self._context.storage) as note:
                    checkpoint = await asyncio.to_thread(self._workspace.store_checkpoint, "train", first)
                    if checkpoint is None:
                        raise StorageError("The plan of the blocks is not in the job's folder.")
                    plan = plan_digest(checkpoint)
                    own_bytes = planned.disk_bytes or [None] * len(planned.numbers)
                    blocks = [
                        NewBlock(
                            number,
                            length,
                            kind.options_of_block(options, number, length, plan),
                            None if own is None else own + checkpoint.size_bytes,
                        )
                        for number, length, own in zip(
                            planned.numbers, planned.iterations, own_bytes, strict=True
                        )
                    ]
                    await self._attempt.start_blocks(
                        self._context.job_queue,
                        checkpoint.as_row(),
                        kind.block_kind,
                        blocks,
                        note,
                        first_steps=first,
                        total_steps=planned.total_iterations,
                        complete=complete,
                    )
                    return
            except DATABASE_ERRORS as error:
                await self._pause_or_raise(error)

    async def _with_partial_results(
        self, write: Callable[[list[ResultFile], StorageLease], Awaitable[None]]
    ) -> None:
        """Store the finished results of a program and record them."""
        while True:
            try:
                async with storage_lease(self._attempt.pool, self._context.storage) as note:
                    results = await asyncio.to_thread(self._workspace.store_partial_results)
                    await write(results, note)
                    return
            except DATABASE_ERRORS as error:
                await self._pause_or_raise(error)

    async def _write_with_retries(self, write: Callable[[], Awaitable[T]]) -> T:
        """Call ``write`` until it succeeds, with a longer timeout each time for slow databases."""
        settings = self._context.settings
        seconds = settings.heartbeat_seconds
        contradicted = 0
        while True:
            try:
                async with asyncio.timeout(seconds):
                    return await write()
            except psycopg.IntegrityError as error:  # something was deleted at the same moment
                contradicted += 1
                if contradicted > MAX_CONTRADICTIONS:
                    raise
                await self._pause_or_raise(error)
            except DATABASE_ERRORS as error:
                await self._pause_or_raise(error)
                seconds = max(seconds, min(2 * seconds, settings.stale_seconds / 3))

    async def _pause_or_raise(self, error: Exception) -> None:
        if self._heartbeat.is_lost:
            raise DatabaseLostError(str(error)) from error
        await asyncio.sleep(self._context.settings.poll_seconds)


def _error_as_dict(error: OctasplatError) -> dict[str, Any]:
    return {"type": NO_SPACE_ERROR if is_disk_full(error) else error.error_type, "message": str(error)}

"""Changes of a job by the worker that runs it, each fenced by the number of the attempt.

A worker that was taken for dead may come back. By then its job has a higher attempt number or is over, and
its writes are refused with :class:`FencedError`.
"""

from collections.abc import AsyncIterator, Callable, Collection, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import Any

from octasplat.workers.db.connections import Connection, Pool
from octasplat.workers.db.events_and_logs import add_event, add_log_lines
from octasplat.workers.db.live_scenes import LiveScene, put_live_scene
from octasplat.workers.db.locks import lock_owner
from octasplat.workers.db.postgres_text import as_json, storable_text
from octasplat.workers.db.quotas import NO_QUOTA, Quota, check_bytes
from octasplat.workers.db.rows import Job
from octasplat.workers.queue.block_jobs import (
    ROOT,
    CompleteOptions,
    NewBlock,
    add_live_scene_event,
    release_needs,
    start_blocks,
)
from octasplat.workers.queue.block_results import drop_lost_blocks, forget_block_results
from octasplat.workers.queue.job_endings import MAX_RECOVERIES, count_requeues, end_job, recover_attempt
from octasplat.workers.queue.job_results import ResultFile, replace_artifacts, result_digests
from octasplat.workers.queue.jobs import get_job, lock_blocks, requeue_job
from octasplat.workers.queue.protocol import JobQueue
from octasplat.workers.queue.storage_leases import StorageLease


class FencedError(Exception):
    """The attempt is over: the job has continued without this worker."""


@dataclass(frozen=True)
class Attempt:
    """One start of a job.

    Args:
        pool: connections.
        job: the row as it was when the attempt began; ``job.attempt`` is the number that fences.
        redact: a JSON value as its texts may be shown to users; everything that is written goes through it.
        quota: what an owner may store who has no limits of their own.
    """

    pool: Pool
    job: Job
    redact: Callable[[Any], Any] = lambda value: value
    quota: Quota = NO_QUOTA

    async def heartbeat(self) -> str:
        """Write a heartbeat; returns the state, ``running`` or ``canceling``."""
        async with self._fenced_transaction() as (connection, job):
            await connection.execute("UPDATE jobs SET heartbeat_at = now() WHERE id = %s", [job.id])
            return job.state

    async def read_state(self) -> str:
        """Return the state without writing a heartbeat."""
        async with self.pool.connection() as connection:
            job = await get_job(connection, self.job.id)
        self._check_fence(job)
        assert job is not None
        return job.state

    async def add_event(self, kind: str, data: Mapping[str, Any]) -> None:
        """Add an event to the event log; a measurement of held-out views also sets the job's PSNR."""
        async with self._fenced_transaction() as (connection, job):
            if kind == "held_out_measured":
                await connection.execute("UPDATE jobs SET psnr = %s WHERE id = %s", [data["psnr"], job.id])
            await add_event(connection, job.id, job.attempt, kind, self.redact(dict(data)))

    async def record_settings(self, settings: Mapping[str, Any], version: str) -> None:
        """Record the complete options that this attempt runs with, and the version that completed them."""
        async with self._fenced_transaction() as (connection, job):
            await connection.execute(
                "UPDATE jobs SET settings = %s, resolved_by = %s WHERE id = %s",
                [as_json(dict(settings)), version, job.id],
            )

    async def add_log_lines(self, lines: Sequence[str]) -> None:
        """Add lines to the log."""
        async with self._fenced_transaction() as (connection, job):
            await add_log_lines(connection, job.id, job.attempt, self.redact(list(lines)))

    async def set_progress(
        self,
        *,
        stage: str,
        step: int | None,
        total_steps: int | None,
        seconds_left: float | None = None,
        training_psnr: float | None = None,
        event: Mapping[str, Any] | None = None,
    ) -> None:
        """Set the progress of the job; ``event`` is added to the event log."""
        async with self._fenced_transaction() as (connection, job):
            await connection.execute(
                """
                UPDATE jobs SET stage = %s, step = %s, total_steps = %s, seconds_left = %s,
                    training_psnr = coalesce(%s, training_psnr)
                WHERE id = %s
                """,
                [stage, step, total_steps, seconds_left, training_psnr, job.id],
            )
            if event is not None:
                await add_event(connection, job.id, job.attempt, "progress", event)

    async def record_checkpoint(
        self, manifest: Mapping[str, Any], *, is_progress: bool, lease: StorageLease | None = None
    ) -> None:
        """Record a stored checkpoint; one that advances resets the count of lost workers.

        Raises:
            StorageUnavailableError: ``lease``, under which it was stored, was given up.
            QuotaExceededError: the job's owner may not store as much.
        """
        contents = {file["sha256"] for file in manifest.get("files", ())}
        async with self._fenced_transaction(lease, contents, changes_usage=True) as (connection, job):
            await connection.execute(
                """
                UPDATE jobs SET checkpoint = %s, rescues = CASE WHEN %s THEN 0 ELSE rescues END WHERE id = %s
                """,
                [as_json(dict(manifest)), is_progress, job.id],
            )
            # After the update, whose bytes the triggers of the database have counted by now.
            await check_bytes(connection, job.owner, self.quota)
            event = {key: manifest[key] for key in ("stage", "step") if key in manifest}
            await add_event(connection, job.id, job.attempt, "checkpoint", event)

    async def record_preview(
        self, preview: Mapping[str, Any], lease: StorageLease | None = None,
        *, block_positions: Mapping[str, tuple[float, float]] | None = None,
    ) -> None:  # fmt: skip
        """Record the newest preview picture, ``lease`` as above; of a map with the places of blocks on it."""
        row = {**preview, "block_positions": dict(block_positions)} if block_positions else dict(preview)
        async with self._fenced_transaction(lease, [preview["sha256"]]) as (connection, job):
            await connection.execute("UPDATE jobs SET preview = %s WHERE id = %s", [as_json(row), job.id])
            await add_event(connection, job.id, job.attempt, "preview", preview)

    async def record_live_scene(self, scene: LiveScene, lease: StorageLease | None = None) -> None:
        """Record the newest state of the training; ``lease`` as above."""
        contents = [scene.sha256, scene.views_sha256]
        async with self._fenced_transaction(lease, contents) as (connection, job):
            await put_live_scene(connection, scene)
            await add_live_scene_event(connection, job)

    async def record_begun_anew(self, reason: str) -> None:
        """Record why the attempt does not go on from the checkpoint of an earlier one."""
        async with self._fenced_transaction() as (connection, job):
            await connection.execute(
                "UPDATE jobs SET begun_anew = %s WHERE id = %s",
                [storable_text(self.redact(reason)), job.id],
            )

    async def succeed(
        self,
        results: Sequence[ResultFile],
        psnr: float | None = None,
        *,
        job_queue: JobQueue | None = None,
    ) -> None:
        """Publish the results and end the job; what waited for it is queued.

        Args:
            results: all of them.
            psnr: mean over the held-out views, dB, if they were measured.
            job_queue: the queue; None leaves what waited for the job to the recovery.

        Raises:
            QuotaExceededError: the job's owner may not store as much.
        """
        async with self._fenced_transaction(changes_usage=True) as (connection, job):
            if psnr is not None:
                await connection.execute("UPDATE jobs SET psnr = %s WHERE id = %s", [psnr, job.id])
            await replace_artifacts(connection, job, results)
            await end_job(connection, job, "succeeded", None)
            if job.role == ROOT:
                await forget_block_results(connection, job)
            await check_bytes(connection, job.owner, self.quota)
            await release_needs(connection, job_queue, job)

    async def start_blocks(
        self,
        job_queue: JobQueue,
        checkpoint: Mapping[str, Any],
        kind: str,
        blocks: Sequence[NewBlock],
        lease: StorageLease,
        *,
        first_steps: int,
        total_steps: int,
        complete: CompleteOptions = dict,
    ) -> None:
        """Queue the blocks of the job, which ends the attempt; a job being cancelled ends instead.

        Args:
            job_queue: the queue.
            checkpoint: manifest of the stored one, which the blocks begin with.
            kind: of the blocks' jobs.
            blocks: all of them.
            lease: under which the checkpoint was stored.
            first_steps: see :func:`octasplat.workers.queue.block_jobs.start_blocks`.
            total_steps: likewise.
            complete: likewise.

        Raises:
            StorageUnavailableError: ``lease`` was given up.
            QuotaExceededError: the job's owner may not store as much.
        """
        contents = {file["sha256"] for file in checkpoint["files"]}
        async with self._fenced_transaction(lease, contents, changes_usage=True, with_blocks=True) as (
            connection,
            job,
        ):
            if job.state == "canceling":
                await end_job(connection, job, "canceled", None)
                return
            await connection.execute(
                "UPDATE jobs SET checkpoint = %s WHERE id = %s", [as_json(dict(checkpoint)), job.id]
            )
            await check_bytes(connection, job.owner, self.quota)
            await start_blocks(
                connection, job_queue, job, kind, blocks,
                first_steps=first_steps, total_steps=total_steps, complete=complete,
            )  # fmt: skip

    async def drop_lost_blocks(self, lost: Collection[str]) -> None:
        """Let blocks be trained again of whose results the store has lost contents of these digests.

        Raises:
            BlobNotFoundError: results of the same block were lost before.
        """
        if not lost:
            return
        async with self._fenced_transaction(changes_usage=True, with_blocks=True) as (connection, job):
            await drop_lost_blocks(connection, job, lost)

    async def fail(
        self,
        error: Mapping[str, Any],
        results: Sequence[ResultFile] = (),
        lease: StorageLease | None = None,
        *,
        discarded: Sequence[ResultFile] = (),
    ) -> None:
        """End the job for a reason that another attempt would meet again, with the results so far.

        Args:
            error: what happened.
            results: those that there are.
            lease: under which they were stored.
            discarded: results that are stored and will not be named, so that they go soon.

        Raises:
            StorageUnavailableError: ``lease``, under which they were stored, was given up.
            QuotaExceededError: the job's owner may not store as much.
        """
        async with self._fenced_transaction(lease, result_digests(results), changes_usage=bool(results)) as (
            connection,
            job,
        ):
            if results:
                await replace_artifacts(connection, job, results)
                await check_bytes(connection, job.owner, self.quota)
            await end_job(connection, job, "failed", self.redact(dict(error)))
            # Collected soon, like contents that were replaced.
            await connection.execute(
                "INSERT INTO replaced_contents (sha256) SELECT unnest(%s::text[]) ON CONFLICT DO NOTHING",
                [sorted(result_digests(discarded))],
            )

    async def cancel(self) -> None:
        """End the job as its owner requested."""
        async with self._fenced_transaction() as (connection, job):
            await end_job(connection, job, "canceled", None)

    async def requeue(self, job_queue: JobQueue, reason: str, *, max_uncounted: int | None = None) -> None:
        """Put the job back into the queue because its worker stops; a job being cancelled ends instead.

        Args:
            job_queue: the queue.
            reason: why.
            max_uncounted: how often in a row, without a checkpoint in between, that may happen for the same
                reason before it counts as a lost attempt; None never counts it.
        """
        async with self._fenced_transaction() as (connection, job):
            if job.state == "canceling":
                await end_job(connection, job, "canceled", None)
                return
            # In the form that the events keep, by which it is counted.
            reason = storable_text(self.redact(reason))
            if max_uncounted is not None and await count_requeues(connection, job, reason) >= max_uncounted:
                error = {"type": "worker_failed", "message": f"Handed back too often: {reason}."}
                await recover_attempt(connection, job_queue, job, error, keep_entry=True)
                return
            await add_event(connection, job.id, job.attempt, "handed_back", {"reason": reason})
            await add_log_lines(connection, job.id, job.attempt, [f"Handed back to the queue: {reason}"])
            await requeue_job(connection, job_queue, job, keep_entry=True, reason=reason)

    async def requeue_lost(
        self,
        job_queue: JobQueue,
        error: Mapping[str, Any],
        results: Sequence[ResultFile] = (),
        lease: StorageLease | None = None,
        *,
        delay_seconds: float = 0.0,
        drop_checkpoint: bool = False,
        max_recoveries: int = MAX_RECOVERIES,
    ) -> None:
        """Requeue a job whose attempt was lost, or fail it after too many attempts.

        Args:
            job_queue: the queue.
            error: what happened.
            results: those that there are, for the end.
            lease: as in :meth:`fail`.
            delay_seconds: for how long the job is not taken up again.
            drop_checkpoint: at the end; then a retry begins anew.
            max_recoveries: lost attempts after which it fails.

        Raises:
            StorageUnavailableError: as by :meth:`fail`.
            QuotaExceededError: as by :meth:`fail`.
        """
        # Both change what the owner stores, for which the owner's lock is taken first.
        counts = drop_checkpoint or bool(results)
        async with self._fenced_transaction(lease, result_digests(results), changes_usage=counts) as (
            connection,
            job,
        ):
            error = self.redact(dict(error))
            failed = await recover_attempt(
                connection,
                job_queue,
                job,
                error,
                keep_entry=True,
                delay_seconds=delay_seconds,
                max_recoveries=max_recoveries,
            )
            if failed and drop_checkpoint:
                await connection.execute("UPDATE jobs SET checkpoint = NULL WHERE id = %s", [job.id])
            if failed and results:
                await replace_artifacts(connection, job, results)
                await check_bytes(connection, job.owner, self.quota)

    @asynccontextmanager
    async def _fenced_transaction(
        self,
        lease: StorageLease | None = None,
        contents: Collection[str] = (),
        *,
        changes_usage: bool = False,
        with_blocks: bool = False,
    ) -> AsyncIterator[tuple[Connection, Job]]:
        """Yield a transaction that holds the job's lock, if the attempt is still the job's.

        Args:
            lease: under which contents were stored that the transaction names.
            contents: their digests.
            changes_usage: whether it changes what the owner stores; the owner's lock is taken before the
                job's, see :mod:`octasplat.workers.db.locks`.
            with_blocks: whether it changes the blocks of the job, too; these are locked before it.
        """
        named = _transaction(self.pool) if lease is None else lease.reference(contents)
        async with named as connection:
            if changes_usage:
                await lock_owner(connection, self.job.owner)
            if with_blocks:
                await lock_blocks(connection, self.job.id)
            job = await get_job(connection, self.job.id, lock=True)
            self._check_fence(job)
            assert job is not None
            yield connection, job

    def _check_fence(self, job: Job | None) -> None:
        is_ours = job is not None and job.attempt == self.job.attempt and job.heartbeat_at is not None
        if job is None or not is_ours or job.state not in ("running", "canceling"):
            raise FencedError(f"attempt {self.job.attempt} of job {self.job.id} is over")


@asynccontextmanager
async def _transaction(pool: Pool) -> AsyncIterator[Connection]:
    async with pool.connection() as connection, connection.transaction():
        yield connection

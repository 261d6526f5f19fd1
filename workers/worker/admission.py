"""Admission of jobs: whether a worker has disk space for one, and eviction to make some."""

import asyncio
import logging
import time
import uuid

from octasplat.workers.db.connections import Pool
from octasplat.workers.db.rows import Job
from octasplat.workers.db.workers import live_workers
from octasplat.workers.maintenance.garbage_collection import collect_garbage_now
from octasplat.workers.queue.job_deadlines import fail_before_start
from octasplat.workers.queue.jobs import get_job, requeue_job
from octasplat.workers.queue.protocol import JobQueue
from octasplat.workers.storage.disk_space import SpaceUsage
from octasplat.workers.storage.errors import StorageError
from octasplat.workers.worker.checkpoint import Checkpoint
from octasplat.workers.worker.context import WorkerContext
from octasplat.workers.worker.heartbeat import DATABASE_ERRORS
from octasplat.workers.worker.stored_frames import removes_stored_frames
from octasplat.workers.worker.task import NO_SPACE_ERROR
from octasplat.workers.worker.workspace_locks import sweep_workspaces

logger = logging.getLogger(__name__)

MAX_SPACE_WAIT_SECONDS = 60.0
"""How long a worker without room keeps a job from others that may have some."""
MAX_DEFERRAL_SECONDS = 20.0
"""A job that needs more room than there is now is looked at again after this time at the latest."""


class Admission:
    """Checks disk space before jobs begin.

    Args:
        name: of the worker.
        pool: connections.
        context: the worker.
    """

    def __init__(self, name: str, pool: Pool, context: WorkerContext) -> None:
        self._name = name
        self._pool = pool
        self._context = context
        self.shortage: str | None = None
        """What there is no room for, while the worker takes no jobs."""

    async def admit(self, job_id: uuid.UUID, entry_id: int) -> bool:
        """Return whether there is space for a job, after waiting a while; else the job is left to others.

        Without space for any job the worker waits. A job that needs more than is free is deferred and others
        go before it; one that no worker of its queue could ever hold is failed.
        """
        wait_seconds = min(MAX_SPACE_WAIT_SECONDS, self._context.settings.full_disk_seconds)
        deadline = time.monotonic() + wait_seconds
        while (lacking := await self._context.space_shortage()) is not None:
            if self.shortage is None:
                logger.warning("worker %s takes no jobs: %s", self._name, lacking)
            self.shortage = lacking
            await self._free_space()
            # A worker that stops has not waited, so that it cannot know whether there will be room.
            is_late = time.monotonic() > deadline
            if is_late or self._context.draining.is_set():
                if not (is_late and await self._fail_if_crowding(job_id, entry_id)):
                    await defer_job(self._pool, self._context.job_queue, job_id, entry_id, reason=lacking)
                return False
            await asyncio.sleep(self._context.settings.poll_seconds)
        if self.shortage is not None:
            logger.info("worker %s has room again", self._name)
        self.shortage = None
        return await self._has_space_for(job_id, entry_id)

    async def _fail_if_crowding(self, job_id: uuid.UUID, entry_id: int) -> bool:
        """Fail a render whose own images take the room for lack of which no job begins; return whether.

        Checkpoints of other jobs do not grow with their work: they wait until there is room again.
        """
        async with self._pool.connection() as connection:
            job = await get_job(connection, job_id)
        kept = _checkpoint_bytes(job) if job is not None and removes_stored_frames(job) else 0
        if not kept or await self._context.space_shortage(SpaceUsage(0, kept)) is not None:
            return False
        message = (
            f"What the job has finished takes {kept} bytes, so that the disk is full, and there is more to "
            "do; ask for fewer or smaller images, or add room."
        )
        error = {"type": NO_SPACE_ERROR, "message": message}
        async with self._pool.connection() as connection:
            await fail_before_start(connection, job_id, entry_id, error, drop_checkpoint=True)
        return True

    async def free_space_if_short(self) -> None:
        """Free space if it is short."""
        if await self._context.space_shortage() is not None:
            await self._free_space()

    async def _has_space_for(self, job_id: uuid.UUID, entry_id: int) -> bool:
        async with self._pool.connection() as connection:
            job = await get_job(connection, job_id)
        if job is None or (needed := _needed_bytes(job)) <= await self._context.free_bytes():
            return True
        # Costs later jobs a download of their photographs, so only where there is too little.
        await self._free_space()
        free = await self._context.free_bytes()
        if needed <= free:
            return True
        largest = await self._largest_capacity(job)
        if largest is not None and needed > largest:
            kept = _checkpoint_bytes(job)
            beside = f" beside its checkpoint of {kept} bytes" if kept else ""
            message = (
                f"The job needs at least {needed} bytes of disk for its work, and no worker of the queue "
                f"{job.queue} has more than {largest}{beside}; ask for fewer or smaller images, or add room."
            )
            async with self._pool.connection() as connection:
                error = {"type": NO_SPACE_ERROR, "message": message}
                await fail_before_start(connection, job_id, entry_id, error, drop_checkpoint=True)
            return False
        logger.info("job %s needs %d bytes of disk and waits, as there are %d", job_id, needed, free)
        wait_seconds = min(MAX_DEFERRAL_SECONDS, self._context.settings.full_disk_seconds)
        reason = f"It needs {needed} bytes of disk, and the worker that looked at it last has {free} free."
        await defer_job(self._pool, self._context.job_queue, job_id, entry_id, wait_seconds, reason=reason)
        return False

    async def _largest_capacity(self, job: Job) -> int | None:
        """Return the largest capacity of the queue's live workers, without what the job's checkpoint takes.

        None if one does not report it.
        """
        stale, kept = self._context.settings.stale_seconds, _checkpoint_bytes(job)
        async with self._pool.connection() as connection:
            facts = [row.facts for row in await live_workers(connection, stale) if job.queue in row.queues]
        try:
            own = await asyncio.to_thread(self._context.disk_space.facts)
        except StorageError:
            return None
        capacities = []
        for known in (own, *facts):
            if known.get("disk_bytes") is None:
                return None
            # A checkpoint in a store on the same disk takes space that no eviction frees.
            capacities.append(int(known["disk_bytes"]) - (kept if known.get("shares_store_disk") else 0))
        return max(capacities)

    async def _free_space(self) -> None:
        """Remove unreferenced contents, and photographs that can be fetched again."""
        try:
            await asyncio.to_thread(sweep_workspaces, self._context.settings.work_folder, 0.0)
            await collect_garbage_now(self._pool, self._context.storage)
        except (StorageError, *DATABASE_ERRORS) as error:
            logger.info("unused contents were not collected: %s", error)


def _checkpoint_bytes(job: Job) -> int:
    """Return the size of a job's checkpoint, which lies in the store."""
    return 0 if job.checkpoint is None else Checkpoint.from_row(job.checkpoint).size_bytes


def _needed_bytes(job: Job) -> int:
    """Return the least disk space for the rest of a job's work.

    Frames of a render that are stored are not fetched, and not made again.
    """
    needed = int((job.estimate or {}).get("disk_bytes", 0))
    return max(0, needed - _checkpoint_bytes(job)) if removes_stored_frames(job) else needed


async def defer_job(
    pool: Pool,
    job_queue: JobQueue,
    job_id: uuid.UUID,
    entry_id: int,
    delay_seconds: float = 0.0,
    *,
    reason: str | None = None,
) -> None:
    """Defer a job whose entry is being delivered by ``delay_seconds``; its owner is told the reason."""
    async with pool.connection() as connection, connection.transaction():
        # Read under the row's lock: its owner may have canceled it, or another entry has taken this one's
        # place.
        job = await get_job(connection, job_id, lock=True)
        if job is not None and job.state == "queued" and job.slip == entry_id:
            await requeue_job(
                connection,
                job_queue,
                job,
                keep_entry=True,
                delay_seconds=delay_seconds,
                without_event=True,
                reason=reason or job.waits_for,
            )

"""Whether a worker has room for a job, and room made where there is none."""

import asyncio
import logging
import time
import uuid

from octasplat.workers.queue.jobs import get_job, queue_again
from octasplat.workers.queue.limits import fail_unbegun
from octasplat.workers.queue.port import Slips
from octasplat.workers.records.database import Pool
from octasplat.workers.records.rows import Job
from octasplat.workers.records.workers import live_workers
from octasplat.workers.store.errors import StorageError
from octasplat.workers.upkeep.collecting import collect_at_once
from octasplat.workers.work.contact import DATABASE_ERRORS
from octasplat.workers.work.surroundings import Surroundings
from octasplat.workers.work.task import NO_SPACE
from octasplat.workers.work.workspace import sweep_workspaces

logger = logging.getLogger(__name__)

ROOM_SECONDS = 60.0
"""How long a worker without room keeps a job from others that may have some."""
TOO_LARGE_SECONDS = 20.0
"""A job that needs more room than there is now is looked at again after this time at the latest."""


class Openings:
    """Looks for room before jobs are begun.

    Args:
        name: of the worker.
        pool: connections.
        around: the worker.
    """

    def __init__(self, name: str, pool: Pool, around: Surroundings) -> None:
        self._name = name
        self._pool = pool
        self._around = around
        self._told = False

    async def come(self, job_id: uuid.UUID, slip: int) -> bool:
        """Whether there is room for a job, waiting a while for it; else the job was left to others.

        Without room for any job the worker waits. A job that needs more than there is waits by itself, and
        others go before it; one that no worker of its queue could ever have room for has failed.
        """
        deadline = time.monotonic() + ROOM_SECONDS
        while (lacking := await self._around.lacking_room()) is not None:
            if not self._told:
                logger.warning("worker %s takes no jobs: %s", self._name, lacking)
            self._told = True
            await self._make()
            if time.monotonic() > deadline or self._around.leaving.is_set():
                await put_off(self._pool, self._around.slips, job_id, slip)
                return False
            await asyncio.sleep(self._around.settings.poll_seconds)
        if self._told:
            logger.info("worker %s has room again", self._name)
        self._told = False
        return await self._is_large_enough(job_id, slip)

    async def keep(self) -> None:
        """Make room if it is lacking."""
        if await self._around.lacking_room() is not None:
            await self._make()

    async def _is_large_enough(self, job_id: uuid.UUID, slip: int) -> bool:
        async with self._pool.connection() as connection:
            job = await get_job(connection, job_id)
        needed = int((job.estimate or {}).get("disk_bytes", 0)) if job is not None else 0
        if job is None or needed <= await self._around.free_bytes():
            return True
        await self._make()
        free = await self._around.free_bytes()
        if needed <= free:
            return True
        largest = await self._largest(job)
        if largest is not None and needed > largest:
            message = (
                f"The job needs at least {needed} bytes of disk for its work, and no worker of the queue "
                f"{job.queue} has more than {largest}; ask for fewer or smaller images, or add room."
            )
            async with self._pool.connection() as connection:
                await fail_unbegun(connection, job_id, slip, {"type": NO_SPACE, "message": message})
            return False
        logger.info("job %s needs %d bytes of disk and waits, as there are %d", job_id, needed, free)
        wait_seconds = min(TOO_LARGE_SECONDS, self._around.settings.full_disk_seconds)
        await put_off(self._pool, self._around.slips, job_id, slip, wait_seconds)
        return False

    async def _largest(self, job: Job) -> int | None:
        """The most room that a living worker of the job's queue could have; None where one does not say."""
        stale = self._around.settings.stale_seconds
        async with self._pool.connection() as connection:
            rooms = [
                row.facts.get("disk_bytes")
                for row in await live_workers(connection, stale)
                if job.queue in row.queues
            ]
        try:
            own = await asyncio.to_thread(self._around.room.capacity_bytes)
        except StorageError:
            return None
        return None if None in rooms else max([own, *map(int, filter(None, rooms))])

    async def _make(self) -> None:
        """Remove what nobody names, and photographs that can be had from the store again."""
        try:
            await asyncio.to_thread(sweep_workspaces, self._around.settings.work_folder, 0.0)
            await collect_at_once(self._pool, self._around.storage)
        except (StorageError, *DATABASE_ERRORS) as error:
            logger.info("unused contents were not collected: %s", error)


async def put_off(pool: Pool, slips: Slips, job_id: uuid.UUID, slip: int, wait_seconds: float = 0.0) -> None:
    """Leave a job whose slip is being delivered to whoever comes after ``wait_seconds``."""
    async with pool.connection() as connection, connection.transaction():
        job = await get_job(connection, job_id, lock=True)
        if job is not None and job.state == "queued" and job.slip == slip:
            await queue_again(connection, slips, job, keep_slip=True, wait_seconds=wait_seconds, quiet=True)

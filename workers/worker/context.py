"""Context that all attempts of a worker share."""

import asyncio
import uuid
from dataclasses import dataclass, field

from octasplat.workers.db.quotas import Quota
from octasplat.workers.queue.protocol import JobQueue
from octasplat.workers.settings import WorkerSettings
from octasplat.workers.storage.disk_space import NO_USAGE, DiskSpace, SpaceUsage
from octasplat.workers.storage.errors import StorageError
from octasplat.workers.storage.protocol import Storage
from octasplat.workers.worker.host_health import HostHealth


class DatabaseLostError(Exception):
    """The worker cannot confirm any more that its jobs are its own, so it has given them up."""


@dataclass(frozen=True)
class WorkerContext:
    """Context that all attempts of a worker share.

    Attributes:
        settings: of the worker.
        job_queue: the queue.
        storage: the store.
        disk_space: on its disks.
        host_health: what jobs need of this machine.
        draining: set when the worker is to stop.
        memory_limit_bytes: of a job's program.
        taken_bytes: what the folder of each attempt under way takes.
    """

    settings: WorkerSettings
    job_queue: JobQueue
    storage: Storage
    disk_space: DiskSpace
    host_health: HostHealth
    draining: asyncio.Event
    memory_limit_bytes: int | None = None
    taken_bytes: dict[uuid.UUID, int] = field(default_factory=dict)

    @property
    def quota(self) -> Quota:
        """Return the default storage quota of an owner."""
        return Quota(max_bytes=self.settings.quota_bytes)

    async def space_shortage(self, excluding: SpaceUsage = NO_USAGE) -> str | None:
        """Return a sentence on which disk is short of space for jobs, or None."""
        try:
            return await asyncio.to_thread(self.disk_space.shortage, excluding)
        except StorageError as error:
            return str(error)

    async def free_bytes(self) -> int:
        """Return the space for jobs; 0 where it is unknown."""
        try:
            return await asyncio.to_thread(self.disk_space.free_bytes)
        except StorageError:
            return 0

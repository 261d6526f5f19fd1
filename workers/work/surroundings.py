"""What all attempts of a worker share."""

import asyncio
import uuid
from dataclasses import dataclass, field

from octasplat.workers.queue.port import Slips
from octasplat.workers.records.quotas import Quota
from octasplat.workers.settings import WorkerSettings
from octasplat.workers.store.errors import StorageError
from octasplat.workers.store.protocol import Storage
from octasplat.workers.store.room import NOTHING, Room, Taken
from octasplat.workers.work.host import Host


class LostDatabase(Exception):
    """The worker cannot say any more whether its jobs are its own, so it has let go of them."""


@dataclass(frozen=True)
class Surroundings:
    """What all attempts of a worker share.

    Attributes:
        settings: of the worker.
        slips: the queue.
        storage: the store.
        room: on its disks.
        host: what jobs need of this machine.
        leaving: set when the worker is to stop.
        memory_limit_bytes: of a job's program.
        taken_bytes: what the folder of each attempt under way takes.
    """

    settings: WorkerSettings
    slips: Slips
    storage: Storage
    room: Room
    host: Host
    leaving: asyncio.Event
    memory_limit_bytes: int | None = None
    taken_bytes: dict[uuid.UUID, int] = field(default_factory=dict)

    @property
    def quota(self) -> Quota:
        """What an owner may store who has no limits of their own."""
        return Quota(max_bytes=self.settings.quota_bytes)

    async def lacking_room(self, without: Taken = NOTHING) -> str | None:
        """What lacks room for jobs, in a sentence, or None."""
        try:
            return await asyncio.to_thread(self.room.lacking, without)
        except StorageError as error:
            return str(error)

    async def free_bytes(self) -> int:
        """Room for jobs; 0 where that cannot be said."""
        try:
            return await asyncio.to_thread(self.room.free_bytes)
        except StorageError:
            return 0

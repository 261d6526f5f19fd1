"""Protocol of a job queue: it delivers entries that each name a job; the state of jobs is in our own table.

An entry is delivered at least once. The entry of a lost worker stays behind; the recovery of stalled jobs
lists such entries and replaces them. Everything that belongs to a change of a job takes the connection of its
transaction.
"""

import uuid
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from octasplat.workers.db.connections import Connection

DeliveryCallback = Callable[[uuid.UUID, int], Awaitable[None]]
"""Called with the job's id and the queue entry's number; when it returns the queue entry is done with."""


@dataclass(frozen=True)
class QueueDepth:
    """Entries of one queue that wait, and the seconds for which the oldest of them has waited."""

    queue: str
    waiting: int
    oldest_seconds: float


@dataclass(frozen=True)
class NewEntry:
    """An entry to be queued.

    Args:
        job_id: which job.
        queue: who may take it.
        priority: higher goes first; where it is the same, the smaller number does.
        earlier_entry_id: an earlier queue entry of the job, whose queue position the new one takes: before
            all that were queued after it. None queues it last.
        delay_seconds: with ``earlier_entry_id``, for how long others go before it all the same.
    """

    job_id: uuid.UUID
    queue: str
    priority: int
    earlier_entry_id: int | None = None
    delay_seconds: float = 0.0


@runtime_checkable
class JobQueue(Protocol):
    """A queue of entries, each for one job."""

    async def enqueue(self, connection: Connection, entry: NewEntry) -> int:
        """Queue an entry for a job within the transaction of ``connection``.

        Returns:
            The entry's number, which no queue entry of this job had.
        """
        ...

    async def enqueue_all(self, connection: Connection, entries: Sequence[NewEntry]) -> list[int]:
        """Queue entries of new jobs, last and in their order; returns their numbers."""
        ...

    async def remove(self, connection: Connection, entry_id: int) -> None:
        """Remove an entry, whether it waits or its worker was lost; harmless if it is gone."""
        ...

    async def take_waiting(self, connection: Connection, entry_id: int) -> bool:
        """Remove an entry that could be delivered now; False if it is being delivered or is delayed."""
        ...

    async def orphaned_jobs(self, connection: Connection) -> Sequence[uuid.UUID]:
        """Return jobs in the state queued that have no entry that waits or is with a live worker."""
        ...

    async def consume(self, queue: str, concurrency: int, deliver: DeliveryCallback) -> None:
        """Deliver entries until :meth:`stop` is called or the database is lost; returns when all are done."""
        ...

    def pause(self) -> None:
        """Pause delivering until :meth:`consume` is called again."""
        ...

    def stop(self) -> None:
        """Stop delivering entries."""
        ...

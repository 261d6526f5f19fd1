"""What an administrator holds back: paused queues, and drained workers by their names.

Both outlive every process: a worker of the same name is still drained when it starts again.
"""

from dataclasses import dataclass

from octasplat.workers.db.connections import Connection


@dataclass(frozen=True)
class Holds:
    """Queues that hand out no jobs, and names of workers that take no new ones."""

    queues: frozenset[str]
    workers: frozenset[str]

    def reason(self, queue: str, worker: str) -> str | None:
        """Return why a worker takes no jobs of a queue now; None if it does."""
        if queue in self.queues:
            return f"The queue {queue} is paused."
        return f"The worker {worker} is drained." if worker in self.workers else None


async def read_holds(connection: Connection) -> Holds:
    """Return what is held back now."""
    queues = await connection.execute("SELECT queue FROM paused_queues")
    workers = await connection.execute("SELECT name FROM drained_workers")
    return Holds(
        frozenset(row["queue"] for row in await queues.fetchall()),
        frozenset(row["name"] for row in await workers.fetchall()),
    )


async def set_queue_paused(connection: Connection, queue: str, paused: bool) -> None:
    """Pause a queue, or let it hand out jobs again; harmless if it is so already."""
    if paused:
        await connection.execute(
            "INSERT INTO paused_queues (queue) VALUES (%s) ON CONFLICT DO NOTHING", [queue]
        )
    else:
        await connection.execute("DELETE FROM paused_queues WHERE queue = %s", [queue])


async def set_worker_drained(connection: Connection, name: str, drained: bool) -> None:
    """Drain the worker of a name, or let it take jobs again; harmless if it is so already."""
    if drained:
        await connection.execute(
            "INSERT INTO drained_workers (name) VALUES (%s) ON CONFLICT DO NOTHING", [name]
        )
    else:
        await connection.execute("DELETE FROM drained_workers WHERE name = %s", [name])

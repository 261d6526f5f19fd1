"""Job queue on Procrastinate."""

import uuid
from collections.abc import Sequence
from typing import Any, cast

import procrastinate
from procrastinate.manager import JobManager
from procrastinate.worker import Worker

from octasplat.workers.db.connections import Connection, Pool
from octasplat.workers.queue.protocol import DeliveryCallback, NewEntry

TASK_NAME = "octasplat.run_job"
# An id of 62 bits below zero: 50 of the first id and 12 that count returns, see requeued_entry_id.
_MAX_REQUEUES = 4096
_FIRST_REQUEUED_ID = -(1 << 62)


class ProcrastinateQueue:
    """A job queue in the tables of Procrastinate.

    Args:
        pool: connections; only :meth:`consume` needs it.
        heartbeat_seconds: how often a worker says that it lives.
        stale_seconds: after how long without it is taken for dead.
        poll_seconds: how often to look for queue entries that no notification told of.
        listen: whether notifications reach this process; a pooler in transaction mode swallows them.
    """

    def __init__(
        self,
        pool: Pool | None = None,
        *,
        heartbeat_seconds: float = 5.0,
        stale_seconds: float = 20.0,
        poll_seconds: float = 1.0,
        listen: bool = True,
    ) -> None:
        self._pool = pool
        self._heartbeat_seconds = heartbeat_seconds
        self._stale_seconds = stale_seconds
        self._poll_seconds = poll_seconds
        self._listen = listen
        # Never opened: it is only given connections of the callers' transactions.
        self._manager = JobManager(procrastinate.PsycopgConnector())
        self._workers: set[Worker] = set()
        self._stopped = False

    async def enqueue(self, connection: Connection, entry: NewEntry) -> int:
        """Queue an entry; see the protocol."""
        if entry.earlier_entry_id is not None:
            return await _reenqueue(connection, entry, entry.earlier_entry_id)
        [entry_id] = await self.enqueue_all(connection, [entry])
        return entry_id

    async def enqueue_all(self, connection: Connection, entries: Sequence[NewEntry]) -> list[int]:
        """Queue entries of new jobs; see the protocol."""
        jobs = [
            procrastinate.jobs.Job(
                queue=entry.queue,
                priority=entry.priority,
                lock=None,
                queueing_lock=None,
                task_name=TASK_NAME,
                task_kwargs={"job_id": str(entry.job_id)},
            )
            for entry in entries
        ]
        deferred = await self._manager.batch_defer_jobs_async(jobs, connection=connection)
        return [job.id for job in deferred if job.id is not None]

    async def remove(self, connection: Connection, entry_id: int) -> None:
        """Remove an entry; see the protocol."""
        await connection.execute("DELETE FROM procrastinate_jobs WHERE id = %s", [entry_id])

    async def take_waiting(self, connection: Connection, entry_id: int) -> bool:
        """Remove an entry that waits; see the protocol."""
        cursor = await connection.execute(
            """
            DELETE FROM procrastinate_jobs WHERE id = (
                SELECT id FROM procrastinate_jobs
                WHERE id = %s AND status = 'todo' AND (scheduled_at IS NULL OR scheduled_at <= now())
                FOR UPDATE SKIP LOCKED
            )
            """,
            [entry_id],
        )
        return cursor.rowcount > 0

    async def orphaned_jobs(self, connection: Connection) -> Sequence[uuid.UUID]:
        """Return queued jobs without a live entry; see the protocol."""
        cursor = await connection.execute(
            """
            SELECT jobs.id FROM jobs
            LEFT JOIN procrastinate_jobs slips ON slips.id = jobs.slip AND slips.status IN ('todo', 'doing')
            LEFT JOIN procrastinate_workers holders ON holders.id = slips.worker_id
            WHERE jobs.state = 'queued'
              AND jobs.queued_at < now() - make_interval(secs => %(stale)s)
              AND (slips.id IS NULL OR slips.status = 'doing' AND
                   (holders.id IS NULL OR holders.last_heartbeat < now() - make_interval(secs => %(stale)s)))
            """,
            {"stale": self._stale_seconds},
        )
        return [row["id"] for row in await cursor.fetchall()]

    async def consume(self, queue: str, concurrency: int, deliver: DeliveryCallback) -> None:
        """Deliver entries; see the protocol."""
        assert self._pool is not None
        connector = procrastinate.PsycopgConnector()
        await connector.open_async(cast(Any, self._pool))  # its cursors name their own kind of rows
        app = procrastinate.App(connector=connector)

        async def run_job(context: procrastinate.JobContext, job_id: str) -> None:
            assert context.job.id is not None
            await deliver(uuid.UUID(job_id), context.job.id)

        app.task(name=TASK_NAME, pass_context=True)(run_job)
        worker = Worker(
            app,
            queues=[queue],
            name=queue,
            concurrency=concurrency,
            fetch_job_polling_interval=self._poll_seconds,
            abort_job_polling_interval=60.0,  # jobs are cancelled by their own table
            listen_notify=self._listen,
            delete_jobs="always",  # how jobs ended is in our own table
            install_signal_handlers=False,  # the worker process has its own
            update_heartbeat_interval=self._heartbeat_seconds,
            stalled_worker_timeout=self._stale_seconds,
        )
        self._workers.add(worker)
        try:
            # stop() may have been called before there was a worker to stop.
            if not self._stopped:
                await worker.run()  # type: ignore[no-untyped-call]
        finally:
            self._workers.discard(worker)

    def stop(self) -> None:
        """Stop delivering; see the protocol."""
        self._stopped = True
        self.pause()

    def pause(self) -> None:
        """Pause delivering; see the protocol."""
        for worker in self._workers:
            worker.stop()  # type: ignore[no-untyped-call]


async def _reenqueue(connection: Connection, entry: NewEntry, earlier_entry_id: int) -> int:
    """Queue an entry (a job of Procrastinate) of our job at the queue position of an earlier one.

    Procrastinate's own retry would assign a new id and so lose the position.
    """
    cursor = await connection.execute(
        """
        INSERT INTO procrastinate_jobs (id, queue_name, task_name, priority, args, scheduled_at)
        VALUES (%(id)s, %(queue)s, %(task)s, %(priority)s, jsonb_build_object('job_id', %(job)s::text),
            CASE WHEN %(delay_seconds)s > 0 THEN now() + make_interval(secs => %(delay_seconds)s) END)
        RETURNING id
        """,
        {
            "id": requeued_entry_id(earlier_entry_id),
            "queue": entry.queue,
            "task": TASK_NAME,
            "priority": entry.priority,
            "job": str(entry.job_id),
            "delay_seconds": entry.delay_seconds,
        },
    )
    row = await cursor.fetchone()
    assert row is not None
    return int(row["id"])


def requeued_entry_id(entry_id: int) -> int:
    """Return the id of an entry that takes the queue position of ``entry_id``.

    Entries of one priority are delivered in ascending order of id. Ids below zero are for entries that were
    queued again: they go before all that were never delivered, and among themselves in the order of their
    first ids. A counter in the id distinguishes the entries of one job, so that no two are the same.
    """
    if entry_id < 0:
        first, returns = divmod(entry_id - _FIRST_REQUEUED_ID, _MAX_REQUEUES)
    else:
        first, returns = entry_id, -1
    return _FIRST_REQUEUED_ID + first * _MAX_REQUEUES + (returns + 1) % _MAX_REQUEUES

"""Figures on the whole service for monitoring; none of them names a job, a dataset or an owner."""

from dataclasses import dataclass

from octasplat.workers.db.connections import Connection
from octasplat.workers.queue.protocol import QueueDepth
from octasplat.workers.queue.usage_figures import queue_depths, running_by_queue

TOTAL_NAMES = ("attempts", "rescues", "poisoned", "succeeded", "failed", "canceled")


@dataclass(frozen=True)
class ServiceStats:
    """Figures on queues, jobs, workers and webhooks of the service.

    Attributes:
        depths: what waits in each queue that has something waiting.
        running: jobs that run, by queue.
        workers: workers that live.
        slots: jobs that they may run at once, by queue.
        worker_age_seconds: since the living worker that was quiet for longest was heard of; None without any.
        heartbeat_age_seconds: the same of the jobs that run.
        totals: what :data:`TOTAL_NAMES` names, since the tables were made; it never falls.
        webhooks: messages to be sent, and messages given up of those that are remembered.
    """

    depths: list[QueueDepth]
    running: dict[str, int]
    workers: int
    slots: dict[str, int]
    worker_age_seconds: float | None
    heartbeat_age_seconds: float | None
    totals: dict[str, int]
    webhooks: dict[str, int]


async def read_service_stats(connection: Connection, stale_seconds: float) -> ServiceStats:
    """Return the present figures.

    Args:
        connection: to the database.
        stale_seconds: after so long a worker is taken for lost.
    """
    cursor = await connection.execute(
        """
        SELECT count(*) AS workers, extract(epoch FROM now() - min(seen_at))::float8 AS age
        FROM workers WHERE seen_at > now() - make_interval(secs => %s)
        """,
        [stale_seconds],
    )
    alive = await cursor.fetchone() or {}
    cursor = await connection.execute(
        """
        SELECT queue, sum(slots) AS slots FROM workers, unnest(queues) AS queue
        WHERE seen_at > now() - make_interval(secs => %s) GROUP BY queue
        """,
        [stale_seconds],
    )
    slots = {row["queue"]: int(row["slots"]) for row in await cursor.fetchall()}
    cursor = await connection.execute(
        """
        SELECT extract(epoch FROM now() - min(heartbeat_at))::float8 AS age FROM jobs
        WHERE state IN ('running', 'canceling')
        """
    )
    beat = await cursor.fetchone() or {}
    cursor = await connection.execute(
        """
        SELECT sequencename AS name, coalesce(last_value, 0) AS total FROM pg_sequences
        WHERE schemaname = current_schema() AND sequencename LIKE 'octasplat\\_total\\_%'
        """
    )
    totals = {
        row["name"].removeprefix("octasplat_total_"): int(row["total"]) for row in await cursor.fetchall()
    }
    cursor = await connection.execute(
        "SELECT state, count(*) AS n FROM webhook_deliveries WHERE state <> 'delivered' GROUP BY state"
    )
    webhooks = {row["state"]: int(row["n"]) for row in await cursor.fetchall()}
    return ServiceStats(
        depths=await queue_depths(connection),
        running=await running_by_queue(connection),
        workers=alive.get("workers", 0),
        slots=slots,
        worker_age_seconds=alive.get("age"),
        heartbeat_age_seconds=beat.get("age"),
        totals={name: totals.get(name, 0) for name in TOTAL_NAMES},
        webhooks={state: webhooks.get(state, 0) for state in ("pending", "failed")},
    )

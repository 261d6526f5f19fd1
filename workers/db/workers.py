"""Table of the live workers."""

import uuid
from collections.abc import Mapping, Sequence
from typing import Any

from octasplat.workers.db.connections import Connection, fetch_all
from octasplat.workers.db.postgres_text import as_json
from octasplat.workers.db.rows import WorkerRow


async def record_worker_heartbeat(
    connection: Connection,
    worker_id: uuid.UUID,
    *,
    name: str,
    queues: Sequence[str],
    slots: int,
    facts: Mapping[str, Any],
) -> None:
    """Record the heartbeat of a worker."""
    await connection.execute(
        """
        INSERT INTO workers (id, name, queues, slots, facts) VALUES (%s, %s, %s, %s, %s)
        ON CONFLICT (id) DO UPDATE SET seen_at = now(), facts = excluded.facts
        """,
        [worker_id, name, list(queues), slots, as_json(dict(facts))],
    )


async def remove_worker(connection: Connection, worker_id: uuid.UUID) -> None:
    """Remove a worker that has shut down."""
    await connection.execute("DELETE FROM workers WHERE id = %s", [worker_id])


async def remove_stale_workers(connection: Connection, older_than_seconds: float) -> None:
    """Delete workers that were not seen for that long."""
    await connection.execute(
        "DELETE FROM workers WHERE seen_at < now() - make_interval(secs => %s)", [older_than_seconds]
    )


async def live_workers(connection: Connection, stale_seconds: float) -> list[WorkerRow]:
    """Return the workers that were seen within ``stale_seconds``, by name."""
    return await fetch_all(
        connection,
        WorkerRow,
        "SELECT {} FROM workers WHERE seen_at > now() - make_interval(secs => %s) ORDER BY name",
        [stale_seconds],
    )

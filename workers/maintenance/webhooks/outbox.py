"""Queue of webhook messages: a sender leases one for a while and records its outcome."""

from collections.abc import Mapping
from dataclasses import dataclass

from psycopg.rows import class_row

from octasplat.workers.db.connections import Connection, select_columns
from octasplat.workers.maintenance.webhooks.rows import Delivery, Endpoint, get_webhook_endpoint

LEASE_SECONDS = 60
"""After so long a message whose sender was lost is taken by another."""
RETRY_DELAYS_SECONDS = (5, 60, 300, 1800, 7200, 14_400, 28_800, 33_000)
"""Between the tries; 23.7 hours in all, to which up to a tenth is added by chance."""
RETENTION_DAYS = 30
MAX_PAUSED_DAYS = 3
"""After so long nobody wants to hear what happened while a webhook was paused."""
NONE_IN_FLIGHT: Mapping[str, int] = {}


@dataclass(frozen=True)
class Outcome:
    """Outcome of a delivery attempt: the HTTP status, or the error before there was one."""

    status: int | None
    error: str | None = None

    @property
    def is_success(self) -> bool:
        """Return whether the message was delivered."""
        return self.status is not None and 200 <= self.status < 300

    @property
    def is_gone(self) -> bool:
        """Return whether the endpoint answered that it is gone (HTTP 410)."""
        return self.status == 410


async def lease_due(
    connection: Connection,
    limit: int,
    *,
    max_per_owner: int | None = None,
    in_flight: Mapping[str, int] = NONE_IN_FLIGHT,
) -> list[tuple[Delivery, Endpoint]]:
    """Return messages to send now; nobody else gets them for :data:`LEASE_SECONDS`.

    Args:
        connection: to the database.
        limit: at most so many.
        max_per_owner: at most so many of one owner, with those under way; None sets no limit.
        in_flight: how many messages of an owner are being sent.
    """
    async with connection.transaction(), connection.cursor(row_factory=class_row(Delivery)) as cursor:
        await cursor.execute(
            select_columns(
                """
            WITH ranked AS (
                SELECT deliveries.id, endpoints.owner,
                    row_number() OVER (PARTITION BY endpoints.owner ORDER BY deliveries.due_at) AS place
                FROM webhook_deliveries deliveries
                JOIN webhook_endpoints endpoints ON endpoints.id = deliveries.endpoint_id
                WHERE deliveries.state = 'pending' AND deliveries.due_at <= now() AND endpoints.enabled
            ), due AS (
                SELECT deliveries.id FROM webhook_deliveries deliveries JOIN ranked USING (id)
                LEFT JOIN unnest(%(owners)s::text[], %(counts)s::int[]) AS busy (owner, n) USING (owner)
                WHERE deliveries.state = 'pending' AND deliveries.due_at <= now()
                  AND (%(each)s::int IS NULL OR ranked.place + coalesce(busy.n, 0) <= %(each)s)
                ORDER BY ranked.place, deliveries.due_at LIMIT %(limit)s
                FOR UPDATE OF deliveries SKIP LOCKED
            )
            UPDATE webhook_deliveries SET tries = tries + 1, tried_at = now(),
                due_at = now() + make_interval(secs => %(lease)s)
            FROM due WHERE webhook_deliveries.id = due.id RETURNING {}
            """,
                Delivery,
                "webhook_deliveries",
            ),
            {
                "limit": limit,
                "lease": LEASE_SECONDS,
                "each": max_per_owner,
                "owners": list(in_flight),
                "counts": list(in_flight.values()),
            },
        )
        taken = await cursor.fetchall()
        with_endpoints = [
            (delivery, await get_webhook_endpoint(connection, delivery.endpoint_id)) for delivery in taken
        ]
    # An endpoint may have been deleted after its messages were leased.
    return [(delivery, endpoint) for delivery, endpoint in with_endpoints if endpoint is not None]


async def record_outcome(connection: Connection, delivery: Delivery, outcome: Outcome) -> None:
    """Record the outcome of a delivery attempt; if a later one was made meanwhile, that one counts."""
    wait = RETRY_DELAYS_SECONDS[delivery.failures] if delivery.failures < len(RETRY_DELAYS_SECONDS) else None
    again = wait is not None and not outcome.is_gone
    async with connection.transaction():
        if outcome.is_gone:  # its row before those of its messages, as where it is deleted
            query = "SELECT id FROM webhook_endpoints WHERE id = %s FOR UPDATE"
            await connection.execute(query, [delivery.endpoint_id])
        cursor = await connection.execute(
            """
            UPDATE webhook_deliveries SET status = %(status)s, error = %(error)s,
                state = CASE WHEN %(success)s THEN 'delivered' WHEN %(again)s THEN 'pending'
                    ELSE 'failed' END,
                failures = failures + CASE WHEN %(success)s THEN 0 ELSE 1 END,
                due_at = now() + make_interval(secs => %(wait)s * (1 + random() / 10))
            WHERE id = %(id)s AND tries = %(tries)s AND state = 'pending'
            """,
            {
                "status": outcome.status,
                "error": outcome.error,
                "success": outcome.is_success,
                "again": again,
                "wait": wait or 0,
                "id": delivery.id,
                "tries": delivery.tries,
            },
        )
        if cursor.rowcount and outcome.is_gone:
            await connection.execute(
                "UPDATE webhook_endpoints SET enabled = false, disabled_reason = %s WHERE id = %s",
                ["The address answered 410 Gone.", delivery.endpoint_id],
            )
            await connection.execute(
                """
                UPDATE webhook_deliveries SET state = 'failed', error = 'The webhook was disabled.'
                WHERE endpoint_id = %s AND state = 'pending'
                """,
                [delivery.endpoint_id],
            )


async def purge_deliveries(connection: Connection) -> None:
    """Delete messages that were settled long ago; give up those that wait too long for a paused webhook."""
    await connection.execute(
        """
        UPDATE webhook_deliveries SET state = 'failed', error = 'The webhook was paused for too long.'
        FROM webhook_endpoints endpoints
        WHERE endpoints.id = endpoint_id AND NOT endpoints.enabled AND state = 'pending'
          AND due_at < now() - make_interval(days => %s)
        """,
        [MAX_PAUSED_DAYS],
    )
    await connection.execute(
        """
        DELETE FROM webhook_deliveries
        WHERE state <> 'pending' AND created_at < now() - make_interval(days => %s)
        """,
        [RETENTION_DAYS],
    )

"""Endpoints and messages in the tables."""

import uuid
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Literal, LiteralString

from psycopg.rows import class_row

from octasplat.engine.core.errors import OctasplatError
from octasplat.workers.db.connections import Connection, fetch_all, fetch_one, select_columns
from octasplat.workers.db.errors import NotFoundError
from octasplat.workers.db.ids import new_id
from octasplat.workers.db.locks import lock_owner
from octasplat.workers.db.postgres_text import as_json

EventName = Literal[
    "job.queued", "job.running", "job.canceling", "job.succeeded", "job.failed", "job.canceled"
]
DeliveryState = Literal["pending", "delivered", "failed"]
TERMINAL_EVENTS: tuple[EventName, ...] = ("job.succeeded", "job.failed", "job.canceled")
TEST_EVENT = "webhook.test"
MAX_ENDPOINTS = 50
"""Of one owner, without those that are about one job only."""
MAX_ENDPOINTS_OF_JOB = 5


class TooManyEndpointsError(OctasplatError):
    """An owner has as many endpoints as allowed."""

    error_type = "too_many_endpoints"


@dataclass(frozen=True)
class Endpoint:
    """Webhook endpoint: the URL that receives events of jobs.

    Attributes:
        id: UUIDv7.
        owner: whose jobs it is about.
        job_id: the one job it is about; None for all.
        url: where messages go.
        secret: signs them.
        events: which are sent.
        enabled: whether any are.
        disabled_reason: why not, if the service decided it.
        created_at: when it was made.
    """

    id: uuid.UUID
    owner: str
    job_id: uuid.UUID | None
    url: str
    secret: str
    events: list[str]
    enabled: bool
    disabled_reason: str | None
    created_at: datetime


@dataclass(frozen=True)
class Delivery:
    """A message to an endpoint.

    Attributes:
        id: random UUID; the message's id is made of it.
        endpoint_id: where it goes.
        kind: of what it tells.
        payload: its content.
        state: ``pending`` will be sent or sent again.
        tries: how often it was sent, in all; a result counts only for the try that it belongs to.
        failures: tries that failed since it was last asked for.
        due_at: when it is sent next, if it is pending.
        status: HTTP status of the last try.
        error: why the last try failed.
        created_at: when it happened.
        tried_at: when it was last sent.
    """

    id: uuid.UUID
    endpoint_id: uuid.UUID
    kind: str
    payload: dict[str, Any]
    state: DeliveryState
    tries: int
    failures: int
    due_at: datetime
    status: int | None
    error: str | None
    created_at: datetime
    tried_at: datetime | None


async def add_endpoint(
    connection: Connection,
    *,
    owner: str,
    url: str,
    secret: str,
    events: Sequence[str],
    job_id: uuid.UUID | None = None,
) -> Endpoint:
    """Make an endpoint.

    Raises:
        TooManyEndpointsError: the owner has enough.
    """
    async with connection.transaction(), connection.cursor(row_factory=class_row(Endpoint)) as cursor:
        # Else two requests at once would both find room for the last one.
        await lock_owner(connection, owner)
        count = await connection.execute(
            "SELECT count(*) AS n FROM webhook_endpoints WHERE owner = %s AND job_id IS NOT DISTINCT FROM %s",
            [owner, job_id],
        )
        limit = MAX_ENDPOINTS if job_id is None else MAX_ENDPOINTS_OF_JOB
        row = await count.fetchone()
        if row is not None and row["n"] >= limit:
            raise TooManyEndpointsError(f"There are {limit} such webhooks already; delete some first.")
        await cursor.execute(
            select_columns(
                """
            INSERT INTO webhook_endpoints (id, owner, job_id, url, secret, events)
            VALUES (%s, %s, %s, %s, %s, %s) RETURNING {}
            """,
                Endpoint,
            ),
            [new_id(), owner, job_id, url, secret, list(events)],
        )
        endpoint = await cursor.fetchone()
    assert endpoint is not None
    return endpoint


async def get_webhook_endpoint(
    connection: Connection, endpoint_id: uuid.UUID, *, lock: bool = False
) -> Endpoint | None:
    """Return the webhook endpoint with that id, or None; with ``lock`` until the transaction ends."""
    query: LiteralString = "SELECT {} FROM webhook_endpoints WHERE id = %s"
    if lock:
        query += " FOR NO KEY UPDATE"  # jobs may go on to make messages
    return await fetch_one(connection, Endpoint, query, [endpoint_id])


async def list_endpoints(
    connection: Connection,
    *,
    owner: str | None = None,
    before: uuid.UUID | None = None,
    limit: int | None = None,
) -> list[Endpoint]:
    """Return endpoints, newest first; ``owner`` None takes those of all owners.

    Args:
        connection: to the database.
        owner: whose.
        before: made before this one.
        limit: at most so many.
    """
    return await fetch_all(
        connection,
        Endpoint,
        """
            SELECT {} FROM webhook_endpoints
            WHERE (%(owner)s::text IS NULL OR owner = %(owner)s)
              AND (%(before)s::uuid IS NULL OR id < %(before)s)
            ORDER BY id DESC LIMIT %(limit)s
            """,
        {"owner": owner, "before": before, "limit": limit},
    )


async def change_endpoint(
    connection: Connection,
    endpoint_id: uuid.UUID,
    *,
    url: str | None = None,
    secret: str | None = None,
    events: Sequence[str] | None = None,
    enabled: bool | None = None,
) -> Endpoint:
    """Change the given values; None leaves a value unchanged.

    Raises:
        NotFoundError: there is no such endpoint.
    """
    await connection.execute(
        """
        UPDATE webhook_endpoints SET url = coalesce(%(url)s, url), secret = coalesce(%(secret)s, secret),
            events = coalesce(%(events)s, events), enabled = coalesce(%(enabled)s, enabled),
            disabled_reason = CASE WHEN %(enabled)s::boolean IS NULL THEN disabled_reason END
        WHERE id = %(id)s
        """,
        {
            "url": url,
            "secret": secret,
            "events": None if events is None else list(events),
            "enabled": enabled,
            "id": endpoint_id,
        },
    )
    endpoint = await get_webhook_endpoint(connection, endpoint_id)
    if endpoint is None:
        raise NotFoundError("webhook")
    return endpoint


async def delete_endpoint(connection: Connection, endpoint_id: uuid.UUID) -> None:
    """Delete an endpoint and its messages."""
    await connection.execute("DELETE FROM webhook_endpoints WHERE id = %s", [endpoint_id])


async def add_delivery(
    connection: Connection, endpoint_id: uuid.UUID, kind: str, data: dict[str, Any]
) -> Delivery:
    """Put a message into the queue."""
    delivery = await fetch_one(
        connection,
        Delivery,
        """
            INSERT INTO webhook_deliveries (endpoint_id, kind, payload)
            VALUES (%(endpoint)s, %(kind)s, jsonb_build_object(
                'type', %(kind)s::text, 'data', %(data)s::jsonb,
                'timestamp', to_char(now() AT TIME ZONE 'UTC', 'YYYY-MM-DD"T"HH24:MI:SS.US"Z"')))
            RETURNING {}
            """,
        {"endpoint": endpoint_id, "kind": kind, "data": as_json(data)},
    )
    assert delivery is not None
    return delivery


async def get_delivery(
    connection: Connection, endpoint_id: uuid.UUID, delivery_id: uuid.UUID
) -> Delivery | None:
    """Return a message to an endpoint, or None."""
    return await fetch_one(
        connection,
        Delivery,
        "SELECT {} FROM webhook_deliveries WHERE id = %s AND endpoint_id = %s",
        [delivery_id, endpoint_id],
    )


async def list_deliveries(connection: Connection, endpoint_id: uuid.UUID, limit: int) -> list[Delivery]:
    """Return the newest messages to an endpoint."""
    return await fetch_all(
        connection,
        Delivery,
        """
                SELECT {} FROM webhook_deliveries WHERE endpoint_id = %s ORDER BY created_at DESC, id LIMIT %s
                """,
        [endpoint_id, limit],
    )


async def redeliver(connection: Connection, delivery_id: uuid.UUID) -> Delivery:
    """Put a message into the queue once more, with all its tries; its id and body stay.

    Raises:
        NotFoundError: there is no such message.
    """
    delivery = await fetch_one(
        connection,
        Delivery,
        """
            UPDATE webhook_deliveries SET state = 'pending', failures = 0, due_at = now() WHERE id = %s
            RETURNING {}
            """,
        [delivery_id],
    )
    if delivery is None:
        raise NotFoundError("message")
    return delivery

"""``Idempotency-Key``: a repeated request creates nothing new."""

import hashlib
import json
import uuid
from collections.abc import Awaitable, Callable
from typing import Any

from octasplat.service.auth import Principal
from octasplat.service.problems import ProblemError
from octasplat.workers.db.connections import Connection


def fingerprint(*parts: Any) -> str:
    """Return a fingerprint of the content of a request."""
    return hashlib.sha256(json.dumps(parts, sort_keys=True, default=str).encode()).hexdigest()


async def is_repeated(connection: Connection, principal: Principal, key: str) -> bool:
    """Return whether a request with this key was answered before; then :func:`create_once` makes nothing."""
    query = "SELECT 1 FROM idempotency_keys WHERE owner = %s AND key = %s"
    cursor = await connection.execute(query, [principal.owner, key])
    return await cursor.fetchone() is not None


async def create_once(
    connection: Connection,
    principal: Principal,
    key: str | None,
    request: str,
    create: Callable[[], Awaitable[uuid.UUID]],
) -> tuple[uuid.UUID, bool]:
    """Create an object, or return the one that an equal request created, in one transaction.

    A twin that comes while the first is under way waits for it.

    Args:
        connection: of the caller's transaction.
        principal: asks.
        key: names the request; without one it is always made.
        request: fingerprint of the request.
        create: makes it and returns its id.

    Returns:
        The id, and whether it was made now.

    Raises:
        ProblemError: 422 if the key was used for another request.
    """
    if key is None:
        return await create(), True
    # The row is inserted before its object is made, as a twin waits for the lock of that row.
    placeholder = uuid.UUID(int=0)
    cursor = await connection.execute(
        """
        INSERT INTO idempotency_keys (owner, key, fingerprint, resource_id) VALUES (%s, %s, %s, %s)
        ON CONFLICT DO NOTHING
        """,
        [principal.owner, key, request, placeholder],
    )
    if cursor.rowcount:
        made = await create()
        await connection.execute(
            "UPDATE idempotency_keys SET resource_id = %s WHERE owner = %s AND key = %s",
            [made, principal.owner, key],
        )
        return made, True
    cursor = await connection.execute(
        "SELECT fingerprint, resource_id FROM idempotency_keys WHERE owner = %s AND key = %s",
        [principal.owner, key],
    )
    row = await cursor.fetchone()
    if row is None or row["fingerprint"] != request:
        detail = "This Idempotency-Key was used for another request; choose a new one."
        raise ProblemError(422, "idempotency-key", detail)
    return row["resource_id"], False

"""Audit log: requested changes and refused callers, deleted after their retention time."""

import uuid
from dataclasses import dataclass
from datetime import datetime

from octasplat.workers.db.connections import Connection, fetch_all
from octasplat.workers.db.postgres_text import storable_text

_MAX_CHARACTERS = 500


@dataclass(frozen=True)
class AuditEntry:
    """An entry of the audit log: one requested change.

    Attributes:
        id: rises.
        at: when it was answered.
        owner: who asked; None is nobody known.
        token_id: the token that was shown, or that the session was begun with.
        session_id: the session of a browser.
        address: where the request came from, or ``command line``.
        action: method and path, or the command.
        target: what was made, if something was.
        status: of the answer; 0 for commands.
    """

    id: int
    at: datetime
    owner: str | None
    token_id: uuid.UUID | None
    session_id: uuid.UUID | None
    address: str
    action: str
    target: str | None
    status: int


async def add_entry(
    connection: Connection,
    *,
    address: str,
    action: str,
    status: int = 0,
    owner: str | None = None,
    token_id: uuid.UUID | None = None,
    session_id: uuid.UUID | None = None,
    target: str | None = None,
) -> None:
    """Write an entry; see :class:`AuditEntry`."""
    await connection.execute(
        """
        INSERT INTO audit (owner, token_id, session_id, address, action, target, status)
        VALUES (%s, %s, %s, %s, %s, %s, %s)
        """,
        [
            owner,
            token_id,
            session_id,
            _bounded_text(address),
            _bounded_text(action),
            target and _bounded_text(target),
            status,
        ],
    )


async def list_entries(connection: Connection, *, before: int | None, limit: int) -> list[AuditEntry]:
    """Return at most ``limit`` entries before the entry ``before``, newest first."""
    return await fetch_all(
        connection,
        AuditEntry,
        """
            SELECT {} FROM audit WHERE (%(before)s::bigint IS NULL OR id < %(before)s)
            ORDER BY id DESC LIMIT %(limit)s
            """,
        {"before": before, "limit": limit},
    )


async def delete_old_entries(connection: Connection, hours: float) -> None:
    """Delete entries that are older; 0 keeps them for ever."""
    if hours > 0:
        await connection.execute(
            "DELETE FROM audit WHERE at < now() - make_interval(secs => %s)", [3600 * hours]
        )


def _bounded_text(text: str) -> str:
    """Return a text cut to a bounded length and without characters that Postgres refuses."""
    return storable_text(text)[:_MAX_CHARACTERS]

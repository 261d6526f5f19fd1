"""Sessions of browsers, and links that begin one; the tables hold only the SHA-256 of their secrets.

A session has the rights of the token that it was begun with, and ends with it.
"""

import secrets
import uuid
from dataclasses import dataclass

from octasplat.workers.db.connections import Connection, fetch_one
from octasplat.workers.db.ids import new_id
from octasplat.workers.db.rows import Token
from octasplat.workers.db.tokens import hash_secret

LINK_SECONDS = 300.0
RETENTION_DAYS = 30
"""Sessions that are over are kept so long, as the audit names them."""


@dataclass(frozen=True)
class Session:
    """A session that is valid now, and the token it was begun with."""

    id: uuid.UUID
    token_id: uuid.UUID


async def begin_session(connection: Connection, token: Token, hours: float) -> tuple[uuid.UUID, str]:
    """Begin a session; returns its id and the secret for the cookie."""
    secret, session_id = secrets.token_urlsafe(32), new_id()
    await connection.execute(
        """
        INSERT INTO sessions (id, token_id, sha256, expires_at)
        VALUES (%s, %s, %s, now() + make_interval(secs => %s))
        """,
        [session_id, token.id, hash_secret(secret), 3600 * hours],
    )
    return session_id, secret


async def find_session(connection: Connection, secret: str) -> Session | None:
    """Return the session of that secret, or None; whether its token is still valid is another question."""
    return await fetch_one(
        connection,
        Session,
        "SELECT {} FROM sessions WHERE sha256 = %s AND revoked_at IS NULL AND expires_at > now()",
        [hash_secret(secret)],
    )


async def is_session_valid(connection: Connection, session_id: uuid.UUID) -> bool:
    """Return whether the session of that id is neither ended nor expired."""
    cursor = await connection.execute(
        "SELECT 1 FROM sessions WHERE id = %s AND revoked_at IS NULL AND expires_at > now()", [session_id]
    )
    return await cursor.fetchone() is not None


async def end_session(connection: Connection, secret: str) -> None:
    """Invalidate the session of a cookie."""
    await connection.execute(
        "UPDATE sessions SET revoked_at = now() WHERE sha256 = %s AND revoked_at IS NULL",
        [hash_secret(secret)],
    )


async def add_link(connection: Connection, token_id: uuid.UUID) -> str:
    """Add a link that signs in once within :data:`LINK_SECONDS`; return its secret."""
    secret = secrets.token_urlsafe(32)
    await connection.execute(
        """
        INSERT INTO sign_in_links (sha256, token_id, expires_at)
        VALUES (%s, %s, now() + make_interval(secs => %s))
        """,
        [hash_secret(secret), token_id, LINK_SECONDS],
    )
    return secret


async def use_link(connection: Connection, secret: str) -> uuid.UUID | None:
    """Use a link and return its token; None if it was used, has expired, or never existed."""
    # In one statement, so that of two requests with the same link only one gets the row.
    cursor = await connection.execute(
        "DELETE FROM sign_in_links WHERE sha256 = %s RETURNING token_id, expires_at > now() AS fresh",
        [hash_secret(secret)],
    )
    row = await cursor.fetchone()
    return row["token_id"] if row is not None and row["fresh"] else None


async def delete_old_sessions(connection: Connection) -> None:
    """Delete sessions and links that are long over."""
    await connection.execute(
        "DELETE FROM sessions WHERE expires_at < now() - make_interval(days => %s)", [RETENTION_DAYS]
    )
    await connection.execute("DELETE FROM sign_in_links WHERE expires_at < now()")

"""Access tokens; the tables hold only the SHA-256 of their secrets."""

import hashlib
import secrets
import uuid
from collections.abc import Sequence
from datetime import datetime
from typing import Literal, LiteralString

from octasplat.workers.db.connections import Connection, fetch_all, fetch_one
from octasplat.workers.db.errors import NotFoundError
from octasplat.workers.db.ids import new_id
from octasplat.workers.db.rows import Token

PREFIX = "octa_"
SCOPES = ("read", "write", "admin", "metrics")
"""What tokens may do; ``metrics`` reads the figures of the whole service and nothing else."""
LOCAL_OWNER = "local"
"""Whose things they are that were made on one's own machine."""
Origin = Literal["environment", "machine"]
_LOCK = 0x6F637474  # "octt"


def new_secret() -> str:
    """Return a fresh secret of 256 random bits."""
    return PREFIX + secrets.token_urlsafe(32)


def hash_secret(secret: str) -> str:
    """Hash a secret for the table; secrets are random, so a slow hash would add no protection."""
    return hashlib.sha256(secret.encode()).hexdigest()


async def add_token(
    connection: Connection,
    secret: str,
    *,
    owner: str,
    name: str,
    scopes: Sequence[str],
    hours: float | None = None,
) -> Token:
    """Add a token; one that exists keeps its row and gets these rights.

    One that was revoked stays so.

    Args:
        connection: to the database.
        secret: what is sent.
        owner: whose things it shows.
        name: what to call it.
        scopes: what it may do.
        hours: for how long it is valid; None for ever.

    Raises:
        ValueError: an unknown scope.
    """
    unknown = set(scopes) - set(SCOPES)
    if unknown or not scopes:
        raise ValueError(f"scopes are {', '.join(SCOPES)}, not {', '.join(sorted(unknown)) or 'none'}")
    token = await fetch_one(
        connection,
        Token,
        """
            INSERT INTO tokens (id, owner, name, sha256, scopes, expires_at)
            VALUES (%s, %s, %s, %s, %s, now() + make_interval(secs => %s))
            ON CONFLICT (sha256) DO UPDATE
            SET owner = excluded.owner, name = excluded.name, scopes = excluded.scopes
            RETURNING {}
            """,
        [
            new_id(),
            owner,
            name,
            hash_secret(secret),
            list(scopes),
            None if hours is None else 3600 * hours,
        ],
    )
    assert token is not None
    return token


async def add_environment_token(connection: Connection, secret: str) -> Token:
    """Add the token of the environment, and revoke its former values.

    Returns:
        Its row; one that was revoked stays so, and then nothing is changed.
    """
    async with connection.transaction():
        # One process at a time: two with different tokens would revoke each other's.
        await connection.execute("SELECT pg_advisory_xact_lock(%s)", [_LOCK])
        token = await add_token(connection, secret, owner="admin", name="OCTASPLAT_TOKEN", scopes=["admin"])
        if token.revoked_at is None:
            await set_origin(connection, token.id, "environment")
            await connection.execute(
                """
                UPDATE tokens SET revoked_at = now() FROM token_origins
                WHERE token_id = id AND origin = 'environment' AND id <> %s AND revoked_at IS NULL
                """,
                [token.id],
            )
    return token


async def set_origin(connection: Connection, token_id: uuid.UUID, origin: Origin) -> None:
    """Record that a token was made by a program rather than by a user."""
    await connection.execute(
        "INSERT INTO token_origins (token_id, origin) VALUES (%s, %s) ON CONFLICT DO NOTHING",
        [token_id, origin],
    )


async def find_token(connection: Connection, secret: str) -> Token | None:
    """Return the valid token of that secret, or None."""
    return await fetch_one(
        connection,
        Token,
        """
            SELECT {} FROM tokens WHERE sha256 = %s AND revoked_at IS NULL
              AND (expires_at IS NULL OR expires_at > now())
            """,
        [hash_secret(secret)],
    )


async def get_token(connection: Connection, token_id: uuid.UUID) -> Token | None:
    """Return the valid token of that id, or None."""
    return await fetch_one(
        connection,
        Token,
        """
            SELECT {} FROM tokens WHERE id = %s AND revoked_at IS NULL
              AND (expires_at IS NULL OR expires_at > now())
            """,
        [token_id],
    )


async def get_any_token(connection: Connection, token_id: uuid.UUID, *, lock: bool = False) -> Token | None:
    """Return the token of that id, valid or not, or None; with ``lock`` until the transaction ends."""
    query: LiteralString = "SELECT {} FROM tokens WHERE id = %s"
    if lock:
        query += " FOR NO KEY UPDATE"  # sessions may begin meanwhile
    return await fetch_one(connection, Token, query, [token_id])


async def list_tokens(connection: Connection, owner: str | None = None) -> list[Token]:
    """Return the tokens of an owner, the newest first; None takes those of all."""
    query = "SELECT {} FROM tokens WHERE %(owner)s::text IS NULL OR owner = %(owner)s ORDER BY id DESC"
    return await fetch_all(connection, Token, query, {"owner": owner})


async def change_token(
    connection: Connection,
    token_id: uuid.UUID,
    *,
    name: str,
    scopes: Sequence[str],
    expires_at: datetime | None,
) -> Token:
    """Change a token, whose rights the caller has checked; returns it.

    Raises:
        NotFoundError: there is no such token.
    """
    token = await fetch_one(
        connection,
        Token,
        "UPDATE tokens SET name = %s, scopes = %s, expires_at = %s WHERE id = %s RETURNING {}",
        [name, list(scopes), expires_at, token_id],
    )
    if token is None:
        raise NotFoundError("token")
    return token


async def has_any_token(connection: Connection) -> bool:
    """Return whether there is any valid token."""
    cursor = await connection.execute(
        """
        SELECT EXISTS (SELECT 1 FROM tokens WHERE revoked_at IS NULL
                       AND (expires_at IS NULL OR expires_at > now())) AS any
        """
    )
    row = await cursor.fetchone()
    return bool(row and row["any"])


async def revoke_token(connection: Connection, token_id: uuid.UUID) -> bool:
    """Revoke a token, with the sessions that were begun with it; False if there is none that is valid."""
    cursor = await connection.execute(
        "UPDATE tokens SET revoked_at = now() WHERE id = %s AND revoked_at IS NULL", [token_id]
    )
    return cursor.rowcount > 0

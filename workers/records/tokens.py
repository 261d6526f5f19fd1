"""Access tokens; the tables know the SHA-256 of their secrets only."""

import hashlib
import secrets
import uuid
from collections.abc import Sequence

from psycopg.rows import class_row

from workers.records.database import Connection, naming
from workers.records.ids import new_id
from workers.records.rows import Token

PREFIX = "octa_"
SCOPES = ("read", "write", "admin")


def new_secret() -> str:
    """A fresh secret of 256 random bits."""
    return PREFIX + secrets.token_urlsafe(32)


def hash_secret(secret: str) -> str:
    """What the table knows of a secret. Secrets are random, so a slow hash would protect nothing more."""
    return hashlib.sha256(secret.encode()).hexdigest()


async def add_token(
    connection: Connection, secret: str, *, owner: str, name: str, scopes: Sequence[str]
) -> Token:
    """Let ``secret`` in; one that is known already keeps its row and gets these rights.

    Raises:
        ValueError: an unknown scope.
    """
    unknown = set(scopes) - set(SCOPES)
    if unknown or not scopes:
        raise ValueError(f"scopes are {', '.join(SCOPES)}, not {', '.join(sorted(unknown)) or 'none'}")
    async with connection.cursor(row_factory=class_row(Token)) as cursor:
        await cursor.execute(
            naming(
                """
            INSERT INTO tokens (id, owner, name, sha256, scopes) VALUES (%s, %s, %s, %s, %s)
            ON CONFLICT (sha256) DO UPDATE
            SET owner = excluded.owner, name = excluded.name, scopes = excluded.scopes, revoked_at = NULL
            RETURNING {}
            """,
                Token,
            ),
            [new_id(), owner, name, hash_secret(secret), list(scopes)],
        )
        token = await cursor.fetchone()
    assert token is not None
    return token


async def find_token(connection: Connection, secret: str) -> Token | None:
    """The valid token of that secret, or None."""
    async with connection.cursor(row_factory=class_row(Token)) as cursor:
        await cursor.execute(
            naming(
                """
            SELECT {} FROM tokens WHERE sha256 = %s AND revoked_at IS NULL
              AND (expires_at IS NULL OR expires_at > now())
            """,
                Token,
            ),
            [hash_secret(secret)],
        )
        return await cursor.fetchone()


async def list_tokens(connection: Connection) -> list[Token]:
    """All tokens, the newest first."""
    async with connection.cursor(row_factory=class_row(Token)) as cursor:
        await cursor.execute(naming("SELECT {} FROM tokens ORDER BY id DESC", Token))
        return await cursor.fetchall()


async def any_token(connection: Connection) -> bool:
    """Whether there is a valid token at all."""
    cursor = await connection.execute(
        """
        SELECT EXISTS (SELECT 1 FROM tokens WHERE revoked_at IS NULL
                       AND (expires_at IS NULL OR expires_at > now())) AS any
        """
    )
    row = await cursor.fetchone()
    return bool(row and row["any"])


async def revoke_token(connection: Connection, token_id: uuid.UUID) -> bool:
    """Shut a token out; False if there is none that is valid."""
    cursor = await connection.execute(
        "UPDATE tokens SET revoked_at = now() WHERE id = %s AND revoked_at IS NULL", [token_id]
    )
    return cursor.rowcount > 0

"""Token that ``octasplat serve`` makes for itself; its file is readable by its user only.

Without a token, every user of the machine would have access, and a web page through a proxy.
"""

import os
import secrets
import socket
import stat
from pathlib import Path

import psycopg
from psycopg.rows import dict_row

from octasplat.engine.core.errors import OutputError
from octasplat.workers.db.tokens import (
    LOCAL_OWNER,
    add_token,
    find_token,
    new_secret,
    revoke_token,
    set_origin,
)


async def ensure_bootstrap_token(conninfo: str, path: Path) -> None:
    """Create a token and store it in a file, unless there is a valid one.

    One that others could read is revoked.

    Args:
        conninfo: of the database.
        path: of the file.

    Raises:
        OutputError: the file cannot be written.
    """
    secret, is_ours = _read_token(path)
    async with await psycopg.AsyncConnection.connect(conninfo, row_factory=dict_row) as connection:
        known = await find_token(connection, secret) if secret else None
        if known is not None and is_ours:
            return
        if known is not None:
            await revoke_token(connection, known.id)
        secret = new_secret()
        name = f"octasplat serve on {socket.gethostname()}"
        token = await add_token(connection, secret, owner=LOCAL_OWNER, name=name, scopes=["admin"])
        await set_origin(connection, token.id, "machine")
        _write_token(path, secret)


def _read_token(path: Path) -> tuple[str, bool]:
    """Return the secret that a file holds, if any, and whether nobody else could read it."""
    try:
        facts = path.lstat()
        is_ours = (
            stat.S_ISREG(facts.st_mode)
            and facts.st_uid == os.geteuid()
            and not stat.S_IMODE(facts.st_mode) & 0o077
        )
        return path.read_text(encoding="ascii").strip(), is_ours
    except (OSError, ValueError):
        return "", False


def _write_token(path: Path, secret: str) -> None:
    partial = path.with_name(f".{path.name}.{secrets.token_hex(8)}.partial")
    try:
        handle = os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o600)
        with os.fdopen(handle, "w", encoding="ascii") as file:
            file.write(f"{secret}\n")
        partial.replace(path)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise OutputError(f"{path} cannot be written ({error.strerror or error}).") from None

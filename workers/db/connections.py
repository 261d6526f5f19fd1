"""Connections to the database, with their timeouts."""

import asyncio
import functools
import random
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import fields
from functools import cache
from typing import Any, LiteralString, ParamSpec, TypeVar

import psycopg
from psycopg import sql
from psycopg.rows import DictRow, class_row, dict_row
from psycopg_pool import AsyncConnectionPool

from octasplat.workers.db.errors import DatabaseError

Parameters = ParamSpec("Parameters")
Outcome = TypeVar("Outcome")
RowT = TypeVar("RowT")
Connection = psycopg.AsyncConnection[DictRow]
Pool = AsyncConnectionPool[Connection]

MAX_TRIES = 5
"""So often is a transaction tried that the database ends because of another."""
STATEMENT_SECONDS = 60
"""A statement that takes longer, as it waits for a lock or the database is overwhelmed, is given up."""
IDLE_SECONDS = 30
"""A transaction of which nothing is heard for so long is undone; its process is gone or frozen."""
TRANSACTION_SECONDS = 300
"""None takes longer. The limits above do not count while a process is frozen between statements that it sends
without waiting for each one's outcome (a pipeline, as of psycopg's ``executemany``, which is not used for
that reason); this one does, where the server knows it (PostgreSQL 17)."""
KEEPALIVES: Mapping[str, int] = {
    "keepalives": 1,
    "keepalives_idle": 10,
    "keepalives_interval": 5,
    "keepalives_count": 3,
    "tcp_user_timeout": 25_000,
}
"""So that a host that vanished is noticed within half a minute; by itself TCP takes hours."""


def select_columns(query: LiteralString, row: type[Any], table_name: str = "") -> sql.Composed:
    """Return a query that selects the columns of ``row``, whose names replace its braces.

    They are named, as the next version's tables, with which this one goes on for a while, may have more.

    Args:
        query: with ``{}`` where the columns belong.
        row: a dataclass whose fields are named as the columns.
        table_name: name of the table, where the query has several.
    """
    return _compose(query, tuple(field.name for field in fields(row)), table_name)


@cache
def _compose(query: LiteralString, columns: tuple[str, ...], table_name: str) -> sql.Composed:
    table = (table_name,) if table_name else ()
    named = (sql.Identifier(*table, column) for column in columns)
    return sql.SQL(query).format(sql.SQL(", ").join(named))


async def fetch_all(
    connection: Connection,
    row: type[RowT],
    query: LiteralString,
    values: Sequence[object] | Mapping[str, object] | None = None,
    *,
    table_name: str = "",
) -> list[RowT]:
    """Return all rows that a query finds.

    Args:
        connection: to the database.
        row: see :func:`select_columns`, as for ``query`` and ``table_name``.
        query: with ``{}`` where the columns belong.
        values: of the query's placeholders.
        table_name: name of the table, where the query has several.
    """
    async with connection.cursor(row_factory=class_row(row)) as cursor:
        await cursor.execute(select_columns(query, row, table_name), values)
        return await cursor.fetchall()


async def fetch_one(
    connection: Connection,
    row: type[RowT],
    query: LiteralString,
    values: Sequence[object] | Mapping[str, object] | None = None,
    *,
    table_name: str = "",
) -> RowT | None:
    """Return the first row that a query finds, or None; arguments as of :func:`fetch_all`."""
    async with connection.cursor(row_factory=class_row(row)) as cursor:
        await cursor.execute(select_columns(query, row, table_name), values)
        return await cursor.fetchone()


def retry_on_deadlock(
    action: Callable[Parameters, Awaitable[Outcome]],
) -> Callable[Parameters, Coroutine[Any, Any, Outcome]]:
    """Return a function whose transaction is repeated where the database ended it in a deadlock.

    The function must leave nothing behind but what it did in that transaction.
    """

    @functools.wraps(action)
    async def trying(*values: Parameters.args, **named: Parameters.kwargs) -> Outcome:
        for left in reversed(range(MAX_TRIES)):
            try:
                return await action(*values, **named)
            except (psycopg.errors.DeadlockDetected, psycopg.errors.SerializationFailure):
                if left == 0:
                    raise
                await asyncio.sleep(random.uniform(0.0, 0.1))  # noqa: S311 - only so that twins part
        raise AssertionError

    return trying


@asynccontextmanager
async def open_pool(conninfo: str, *, max_size: int = 10, wait_seconds: float = 30.0) -> AsyncIterator[Pool]:
    """Yield a pool of connections for as long as the block runs.

    Args:
        conninfo: how to connect.
        max_size: most connections.
        wait_seconds: how long to wait for a connection before giving up.

    Raises:
        DatabaseError: the database cannot be reached.
    """
    options: dict[str, Any] = {"row_factory": dict_row, "connect_timeout": 10, **KEEPALIVES}
    pool: Pool = AsyncConnectionPool(
        conninfo,
        min_size=1,
        max_size=max_size,
        timeout=wait_seconds,
        open=False,
        kwargs=options,
        configure=_set_timeouts,
        check=AsyncConnectionPool.check_connection,
        reconnect_timeout=wait_seconds,
    )
    try:
        await pool.open(wait=True, timeout=wait_seconds)
    except psycopg.OperationalError as error:
        await pool.close()
        text = " ".join(str(error).split()).rstrip(".")
        raise DatabaseError(
            f"The database cannot be reached ({text}); check DATABASE_URL and that it runs."
        ) from None
    try:
        yield pool
    finally:
        await pool.close(timeout=5)


async def _set_timeouts(connection: Connection) -> None:
    """Set the timeouts of a connection; by statements, as a pooler refuses connection options."""
    settings = {
        "statement_timeout": f"{STATEMENT_SECONDS}s",
        "idle_in_transaction_session_timeout": f"{IDLE_SECONDS}s",
        "transaction_timeout": f"{TRANSACTION_SECONDS}s",
        # The server's own view of a client that vanished.
        "tcp_keepalives_idle": str(KEEPALIVES["keepalives_idle"]),
        "tcp_keepalives_interval": str(KEEPALIVES["keepalives_interval"]),
        "tcp_keepalives_count": str(KEEPALIVES["keepalives_count"]),
    }
    # Outside of a transaction, as a rollback would undo the settings.
    await connection.set_autocommit(True)
    await _set_known_settings(connection, settings, is_local=False)
    await connection.set_autocommit(False)


async def extend_timeouts(connection: Connection, seconds: float) -> None:
    """Extend the timeouts of the current transaction, including its idle time."""
    limit = f"{seconds:g}s"
    names = ("idle_in_transaction_session_timeout", "transaction_timeout")
    await _set_known_settings(connection, dict.fromkeys(names, limit), is_local=True)


async def _set_known_settings(connection: Connection, settings: Mapping[str, str], *, is_local: bool) -> None:
    """Set those of the settings that the server knows."""
    await connection.execute(
        """
        SELECT set_config(name, value, %s) FROM unnest(%s::text[], %s::text[]) AS given (name, value)
        WHERE EXISTS (SELECT FROM pg_settings WHERE pg_settings.name = given.name)
        """,
        [is_local, list(settings), list(settings.values())],
    )

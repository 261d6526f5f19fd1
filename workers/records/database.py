"""Connections to the database."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import fields
from functools import cache
from typing import Any, LiteralString

import psycopg
from psycopg import sql
from psycopg.rows import DictRow, dict_row
from psycopg_pool import AsyncConnectionPool

from workers.records.errors import DatabaseError

Connection = psycopg.AsyncConnection[DictRow]
Pool = AsyncConnectionPool[Connection]


@cache
def naming(query: LiteralString, row: type[Any]) -> sql.Composed:
    """A query with the columns that a row has in the place of its braces.

    They are named, as the next version's tables, with which this one goes on for a while, may have more.

    Args:
        query: with ``{}`` where the columns belong.
        row: a dataclass whose fields are named as the columns.
    """
    return sql.SQL(query).format(sql.SQL(", ").join(sql.Identifier(field.name) for field in fields(row)))


@asynccontextmanager
async def open_pool(conninfo: str, *, max_size: int = 10, wait_seconds: float = 30.0) -> AsyncIterator[Pool]:
    """A pool of connections for as long as the block runs.

    Args:
        conninfo: how to connect.
        max_size: most connections.
        wait_seconds: how long to wait for a connection before giving up.

    Raises:
        DatabaseError: the database cannot be reached.
    """
    options: dict[str, Any] = {"row_factory": dict_row, "connect_timeout": 10}
    pool: Pool = AsyncConnectionPool(
        conninfo,
        min_size=1,
        max_size=max_size,
        timeout=wait_seconds,
        open=False,
        kwargs=options,
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

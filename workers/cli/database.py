"""Work of commands on the tables of a service."""

from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from octasplat.workers.db.connections import Connection

T = TypeVar("T")


def run_with_database(data: Path | None, action: Callable[["Connection"], Awaitable[T]]) -> T:
    """Return what ``action`` returns of a connection to the database of the settings.

    Args:
        data: data folder of octasplat serve; None for that of the environment.
        action: is called with the connection, in a transaction.

    Raises:
        DatabaseError: it does not answer, or lacks tables of this version.
    """
    import asyncio

    import psycopg

    from octasplat.workers.db.connections import open_pool
    from octasplat.workers.db.errors import DatabaseError
    from octasplat.workers.settings import WorkerSettings, load_settings

    conninfo = load_settings(WorkerSettings, data=data).conninfo()

    async def run() -> T:
        try:
            async with open_pool(conninfo, max_size=1) as pool, pool.connection() as connection:
                return await action(connection)
        except (psycopg.errors.UndefinedTable, psycopg.errors.UndefinedColumn):
            raise DatabaseError(
                "The database lacks tables of this version; run octasplat migrate, or start octasplat "
                "serve or the front end."
            ) from None

    return asyncio.run(run())

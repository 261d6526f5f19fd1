"""Entries of the audit log take any text that a request can hold."""

from octasplat.workers.db.audit import add_entry, list_entries
from tests.support.service_harness import ConnectService


async def test_entries_hold_texts_that_postgres_refuses(connect_service: ConnectService) -> None:
    async with connect_service() as (_, service), service.pool.connection() as connection:
        await add_entry(connection, address="a", action="PUT /\ud800\0" + "x" * 1000, target="\udfff")
        (entry,) = await list_entries(connection, before=None, limit=1)
        assert entry.action.startswith("PUT /\N{REPLACEMENT CHARACTER}\N{REPLACEMENT CHARACTER}xxx")
        assert (len(entry.action), entry.target) == (500, "\N{REPLACEMENT CHARACTER}")

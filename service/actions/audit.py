"""Who did what."""

from octasplat.service.actions.parts import Part, cut
from octasplat.service.state import Service
from octasplat.workers.records import audit as rows
from octasplat.workers.records.audit import AuditEntry


async def list_entries(service: Service, *, before: int | None, limit: int) -> Part[AuditEntry]:
    """Entries, the newest first.

    Args:
        service: the service.
        before: those before this entry.
        limit: at most so many.
    """
    async with service.pool.connection() as connection:
        found = await rows.list_entries(connection, before=before, limit=limit + 1)
    return cut(found, limit, lambda entry: entry.id)

"""Who did what."""

from service.actions.parts import Part, cut
from service.state import Service
from workers.records import audit as rows
from workers.records.audit import AuditEntry


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

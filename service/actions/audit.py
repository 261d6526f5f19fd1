"""Queries of the audit log."""

from octasplat.service.actions.pages import Page, page_of
from octasplat.service.state import Service
from octasplat.workers.db import audit as rows
from octasplat.workers.db.audit import AuditEntry


async def list_entries(service: Service, *, before: int | None, limit: int) -> Page[AuditEntry]:
    """Return entries of the audit log, newest first.

    Args:
        service: the service.
        before: those before this entry.
        limit: at most so many.
    """
    async with service.pool.connection() as connection:
        found = await rows.list_entries(connection, before=before, limit=limit + 1)
    return page_of(found, limit, lambda entry: entry.id)

"""What an owner takes and may take."""

from octasplat.service.auth import Principal
from octasplat.service.schemas.usage import UsageView, UsedView
from octasplat.service.state import Service
from octasplat.workers.db.quotas import quota_of, usage_of
from octasplat.workers.queue.jobs import worked_seconds


async def read_usage(service: Service, principal: Principal) -> UsageView:
    """Return what the principal's owner takes and may take."""
    async with service.pool.connection() as connection:
        quota = await quota_of(connection, principal.owner, service.settings.quota)
        usage = await usage_of(connection, principal.owner)
        seconds = await worked_seconds(connection, principal.owner)
    return UsageView(
        owner=principal.owner,
        bytes=UsedView(used=usage.bytes, limit=quota.max_bytes),
        datasets=UsedView(used=usage.datasets, limit=quota.max_datasets),
        jobs=UsedView(used=usage.jobs, limit=quota.max_jobs),
        job_seconds=seconds,
    )

"""What an owner takes and may take."""

from typing import Literal

from octasplat.service.auth import Principal
from octasplat.service.schemas.usage import UsageView, UsedView
from octasplat.service.state import Service
from octasplat.workers.db.quotas import quota_of, usage_of
from octasplat.workers.queue.usage_figures import worked_seconds


async def rate_limit_headers(
    service: Service, principal: Principal, resource: Literal["datasets", "jobs"]
) -> dict[str, str]:
    """Return the headers that tell of an owner's quota; none without one.

    They are those of draft-ietf-httpapi-ratelimit-headers, without a time, as quotas come back by use.
    """
    async with service.pool.connection() as connection:
        quota = await quota_of(connection, principal.owner, service.settings.quota)
        limit = quota.max_jobs if resource == "jobs" else quota.max_datasets
        if limit is None:
            return {}
        usage = await usage_of(connection, principal.owner)
    left = max(0, limit - (usage.jobs if resource == "jobs" else usage.datasets))
    return {"RateLimit-Policy": f'"{resource}";q={limit}', "RateLimit": f'"{resource}";r={left}'}


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

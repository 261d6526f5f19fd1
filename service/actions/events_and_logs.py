"""Log and events of a job, as a list and as a stream."""

import asyncio
import time
import uuid
from collections.abc import AsyncGenerator
from dataclasses import replace

from psycopg_pool import PoolTimeout

from octasplat.service.actions.access import read_job
from octasplat.service.auth import Principal, is_still_valid
from octasplat.service.problems import ProblemError
from octasplat.service.state import Service
from octasplat.workers.db.events_and_logs import list_job_events, list_log_lines
from octasplat.workers.db.rows import Job, JobEvent, LogLine
from octasplat.workers.queue.jobs import get_job

_POLL_SECONDS = 2.0
_ACCESS_CHECK_SECONDS = 5.0
"""A stream of a token or session that has ended ends at most so much later."""
_PAGE_SIZE = 500
_RETRY_SECONDS = 10


async def read_log(
    service: Service, principal: Principal, job_id: uuid.UUID, *, after: int, limit: int
) -> list[LogLine]:
    """Return lines of a job's log after the number ``after``.

    Raises:
        ProblemError: 404 if it does not exist or the principal may not see it.
    """
    job = await read_job(service, principal, job_id)
    async with service.pool.connection() as connection:
        lines = await list_log_lines(connection, job_id, after, limit)
    return [replace(line, attempt=job.count_starts(line.attempt)) for line in lines]


async def read_events(
    service: Service, principal: Principal, job_id: uuid.UUID, *, after: int, limit: int
) -> list[JobEvent]:
    """Return the events of a job after the number ``after``.

    Raises:
        ProblemError: 404 if it does not exist or the principal may not see it.
    """
    job = await read_job(service, principal, job_id)
    async with service.pool.connection() as connection:
        events = await list_job_events(connection, job_id, after, limit)
    return [_visible_event(principal, job, event) for event in events]


async def follow_events(
    service: Service, principal: Principal, job_id: uuid.UUID, *, after: int, address: str
) -> AsyncGenerator[JobEvent | None, None] | None:
    """Return the events of a job as they happen until it is over; None if all were sent already.

    In the place of an event comes None as a sign of life, where nothing has happened for a while.

    Raises:
        ProblemError: 404, 429 with too many streams of the principal's owner or of its address, 503 with too
            many of all.
    """
    job = await read_job(service, principal, job_id)
    broker, settings = service.event_broker, service.settings
    if broker.count_of_owner(principal.owner) >= settings.max_streams_per_owner:
        detail = "You have too many streams open; close some, or poll GET /v1/jobs/{id} instead."
        raise ProblemError(429, "streams", detail, retry_seconds=_RETRY_SECONDS)
    if broker.count_of_address(address) >= settings.max_streams_per_address:
        detail = "Your address has too many streams open; close some, or poll GET /v1/jobs/{id} instead."
        raise ProblemError(429, "streams", detail, retry_seconds=_RETRY_SECONDS)
    if broker.subscriber_count >= settings.max_streams:
        detail = "Too many streams are open; poll GET /v1/jobs/{id} instead."
        raise ProblemError(503, "streams", detail, retry_seconds=_RETRY_SECONDS)
    if job.is_over:
        async with service.pool.connection() as connection:
            if not await list_job_events(connection, job_id, after, 1):
                return None
    return _stream_events(service, principal, job_id, after, address)


async def _stream_events(
    service: Service, principal: Principal, job_id: uuid.UUID, after: int, address: str
) -> AsyncGenerator[JobEvent | None, None]:
    ping = service.settings.ping_seconds
    quiet = 0.0
    wait = min(ping, _ACCESS_CHECK_SECONDS if service.settings.listen else _POLL_SECONDS)
    checked_at = time.monotonic()
    with service.event_broker.subscribe(job_id, principal.owner, address) as news:
        while not service.event_broker.is_closing:
            # Before the events are read, so that one that comes meanwhile wakes the stream again.
            news.clear()
            try:
                async with service.pool.connection() as connection:
                    if time.monotonic() - checked_at >= _ACCESS_CHECK_SECONDS:
                        if not await is_still_valid(connection, principal):
                            return
                        checked_at = time.monotonic()
                    job = await get_job(connection, job_id)
                    if job is None or not principal.may_see(job.owner):
                        return  # it was deleted, which ends the stream
                    # Before the events are read, so that the last ones are among them.
                    over = job.is_over
                    events = await list_job_events(connection, job_id, after, _PAGE_SIZE)
            except PoolTimeout:  # all connections are in use: the stream goes on once there is one
                yield None
                continue
            for event in events:
                after = event.number
                yield _visible_event(principal, job, event)
            if len(events) == _PAGE_SIZE:
                continue
            if over:
                return
            quiet = 0.0 if events else quiet + wait
            if quiet >= ping:
                yield None
                quiet = 0.0
            try:
                async with asyncio.timeout(wait):
                    await news.wait()
            except TimeoutError:
                continue


def _visible_event(principal: Principal, job: Job, event: JobEvent) -> JobEvent:
    """Return an event as the principal sees it: the worker, named after its host, is for administrators."""
    event = replace(event, attempt=job.count_starts(event.attempt))
    if principal.may("admin") or "worker" not in event.data:
        return event
    return replace(event, data={name: value for name, value in event.data.items() if name != "worker"})

"""What happens to a job: its log, its events as a list and as a stream."""

import asyncio
import json
import uuid
from collections.abc import AsyncIterator
from typing import Annotated

from fastapi import APIRouter, Header, Query, Request, Response
from fastapi.responses import StreamingResponse
from fastapi.sse import format_sse_event

from service.auth import Principal, Reader
from service.problems import Problem, not_found
from service.routes import problems
from service.routes.jobs import read_job
from service.schemas.journal import EventPage, EventView, LogLineView, LogPage
from service.state import Service, ServiceDep
from workers.queue.jobs import get_job
from workers.records.database import Connection
from workers.records.journal import events_after, log_after
from workers.records.rows import JobEvent

router = APIRouter(prefix="/v1/jobs", tags=["progress"])

After = Annotated[int, Query(ge=0, lt=1 << 62, description="`next` of the answer before.")]
_POLL_SECONDS = 2.0
_PAGE = 500


@router.get("/{job_id}/logs", responses=problems(404))
async def read_log(
    job_id: uuid.UUID, who: Reader, service: ServiceDep, after: After = 0,
    limit: Annotated[int, Query(ge=1, le=5000)] = 1000,
) -> LogPage:  # fmt: skip
    """What the job did when: stages, pace, warnings, errors with their cause, and what its program wrote."""
    await read_job(service, who, job_id)
    async with service.pool.connection() as connection:
        lines = await log_after(connection, job_id, after, limit)
    return LogPage(lines=[LogLineView.of(row) for row in lines], next=lines[-1].id if lines else after)


@router.get("/{job_id}/timeline", responses=problems(404))
async def read_timeline(
    job_id: uuid.UUID, who: Reader, service: ServiceDep, after: After = 0,
    limit: Annotated[int, Query(ge=1, le=5000)] = 1000,
) -> EventPage:  # fmt: skip
    """What happened to the job, as a list; `/events` is the same as a stream."""
    await read_job(service, who, job_id)
    async with service.pool.connection() as connection:
        events = await events_after(connection, job_id, after, limit)
    return EventPage(events=[EventView.of(row) for row in events], next=events[-1].id if events else after)


@router.get(
    "/{job_id}/events",
    response_class=StreamingResponse,
    responses={
        200: {"description": "Server-sent events", "content": {"text/event-stream": {}}},
        204: {"description": "The job is over and everything was told"},
        **problems(404),
    },
)
async def stream_events(
    job_id: uuid.UUID, who: Reader, service: ServiceDep, request: Request,
    last_event_id: Annotated[str | None, Header(max_length=40)] = None,
    after: After = 0,
) -> Response:  # fmt: skip
    """What happens to the job, as it happens; after a break `Last-Event-ID` says what was heard last."""
    if last_event_id is not None and last_event_id.isdecimal():
        after = min(int(last_event_id), (1 << 62) - 1)
    job = await read_job(service, who, job_id)
    if service.hub.streams >= service.settings.max_streams:
        detail = "Too many streams are open; poll GET /v1/jobs/{id} instead."
        raise Problem(503, "streams", detail, headers={"Retry-After": "10"})
    if job.is_over:
        async with service.pool.connection() as connection:
            if not await events_after(connection, job_id, after, 1):
                return Response(status_code=204)
    headers = {"Cache-Control": "no-cache", "X-Accel-Buffering": "no"}
    stream = _stream(service, who, job_id, after)
    return StreamingResponse(stream, media_type="text/event-stream", headers=headers)


async def _stream(service: Service, who: Principal, job_id: uuid.UUID, after: int) -> AsyncIterator[bytes]:
    """The events of a job until it is over, with signs of life in between."""
    ping = service.settings.ping_seconds
    quiet = 0.0
    wait = ping if service.settings.listen else min(ping, _POLL_SECONDS)
    yield b"retry: 2000\n\n"
    with service.hub.waiting(job_id) as news:
        while not service.hub.is_closing:
            news.clear()
            async with service.pool.connection() as connection:
                over = await _is_over(connection, who, job_id)
                events = await events_after(connection, job_id, after, _PAGE)
            for event in events:
                after = event.id
                yield _formatted(event)
            if len(events) == _PAGE:
                continue
            if over:
                return
            quiet = 0.0 if events else quiet + wait
            if quiet >= ping:
                yield b": ping\n\n"
                quiet = 0.0
            try:
                async with asyncio.timeout(wait):
                    await news.wait()
            except TimeoutError:
                continue


async def _is_over(connection: Connection, who: Principal, job_id: uuid.UUID) -> bool:
    job = await get_job(connection, job_id)
    if job is None or not who.owns(job.owner):
        raise not_found("job")
    return job.is_over


def _formatted(event: JobEvent) -> bytes:
    data = {**event.data, "attempt": event.attempt, "at": event.at.isoformat()}
    return format_sse_event(data_str=json.dumps(data), event=event.kind, id=str(event.id))

"""Routes of a job's log and events, as a list and as a stream."""

import json
from collections.abc import AsyncGenerator, AsyncIterator
from contextlib import aclosing
from typing import Annotated

from fastapi import APIRouter, Header, Query, Request, Response
from fastapi.responses import StreamingResponse
from fastapi.sse import format_sse_event

from octasplat.service.actions import events_and_logs as actions
from octasplat.service.auth import Reader, client_address
from octasplat.service.paging import LongLimit
from octasplat.service.routes import problem_responses
from octasplat.service.routes.parameters import JobId
from octasplat.service.schemas.events_and_logs import EventPage, EventView, LogLineView, LogPage
from octasplat.service.state import ServiceDep
from octasplat.workers.db.rows import JobEvent

router = APIRouter(prefix="/v1/jobs", tags=["progress"])

After = Annotated[int, Query(ge=0, lt=1 << 62, description="`next` of the answer before.")]


_EVENT_SCHEMA = {
    "type": "object",
    "properties": {name: {"type": "string"} for name in ("id", "event", "data")},
    "required": ["data"],
}
"""Of each event; OpenAPI 3.1 has no word for it (``itemSchema`` in 3.2), so its name is one of our own."""


@router.get("/{job_id}/logs", responses=problem_responses(404))
async def read_log(
    job_id: JobId, principal: Reader, service: ServiceDep, after: After = 0,
    limit: LongLimit = 1000,
) -> LogPage:  # fmt: skip
    """Return the job's log: stages, pace, warnings, errors with their cause, and the program's output."""
    lines = await actions.read_log(service, principal, job_id, after=after, limit=limit)
    return LogPage(
        lines=[LogLineView.from_row(row) for row in lines], next=lines[-1].number if lines else after
    )


@router.get("/{job_id}/timeline", responses=problem_responses(404))
async def read_timeline(
    job_id: JobId, principal: Reader, service: ServiceDep, after: After = 0,
    limit: LongLimit = 1000,
) -> EventPage:  # fmt: skip
    """List the events of the job; `/events` streams the same."""
    events = await actions.read_events(service, principal, job_id, after=after, limit=limit)
    return EventPage(
        events=[EventView.from_row(row) for row in events], next=events[-1].number if events else after
    )


@router.get(
    "/{job_id}/events",
    response_class=StreamingResponse,
    responses={
        200: {
            "description": "Server-sent events",
            "content": {"text/event-stream": {"schema": {"type": "string"}, "x-event-schema": _EVENT_SCHEMA}},
        },
        204: {"description": "The job is over and everything was told"},
        **problem_responses(404),
    },
)
async def stream_events(
    job_id: JobId, principal: Reader, service: ServiceDep, request: Request,
    last_event_id: Annotated[
        str | None,
        Header(alias="Last-Event-ID", max_length=40, description="Id of the last event that has arrived."),
    ] = None,
    after: After = 0,
) -> Response:  # fmt: skip
    """Stream the job's events; after a break, `Last-Event-ID` names the last one received."""
    if last_event_id is not None and last_event_id.isdecimal():
        # No event has a number above what the database can hold.
        after = min(int(last_event_id), (1 << 62) - 1)
    address = client_address(request)
    events = await actions.follow_events(service, principal, job_id, after=after, address=address)
    if events is None:
        return Response(status_code=204)
    # nginx would collect events otherwise, and pass them on late.
    headers = {"Cache-Control": "no-cache", "X-Accel-Buffering": "no"}
    return StreamingResponse(_encode_stream(events), media_type="text/event-stream", headers=headers)


async def _encode_stream(events: AsyncGenerator[JobEvent | None, None]) -> AsyncIterator[bytes]:
    """Yield events in their wire format, with keep-alive comments between them."""
    async with aclosing(events):
        yield b"retry: 2000\n\n"  # a client connects again after 2 s
        async for event in events:
            yield b": ping\n\n" if event is None else _encode_event(event)


def _encode_event(event: JobEvent) -> bytes:
    data = {**event.data, "attempt": event.attempt, "at": event.at.isoformat()}
    return format_sse_event(data_str=json.dumps(data), event=event.kind, id=str(event.number))

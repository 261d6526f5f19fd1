"""A job's progress as the engine's events, from its stream of events."""

import json
import time
from collections.abc import Callable, Iterator
from typing import Any

import httpx

from octasplat.engine.core.events import EventListener
from octasplat.workers.client.api import (
    BUSY_STATUSES,
    UNAVAILABLE_STATUSES,
    Api,
    ServiceError,
    ServiceUnreachableError,
)
from octasplat.workers.client.backoff import MAX_OUTAGE_SECONDS, Backoff
from octasplat.workers.reporting.events import EVENT_STREAM_KINDS, decode_event

TERMINAL = frozenset({"succeeded", "failed", "canceled"})
_POLL_SECONDS = 0.5
_BUSY_SECONDS = 2.0


def watch_job(
    api: Api, job_id: str, on_event: EventListener, on_state: Callable[[dict[str, Any]], None]
) -> dict[str, Any]:
    """Follow a job to its end, over any break of the connection.

    Args:
        api: the service.
        job_id: which.
        on_event: receives the events of the engine.
        on_state: hears of changes of state, rescues and the like.

    Returns:
        The job.

    Raises:
        ServiceError: there is no such job.
        ServiceUnreachableError: the service was away for too long, see
            :mod:`octasplat.workers.client.backoff`.
    """
    last = "0"
    patience = Backoff(MAX_OUTAGE_SECONDS)
    while True:
        try:
            try:
                for kind, data, number in _read_events(api, job_id, last):
                    last = number
                    patience.reset()
                    _dispatch(kind, data, on_event, on_state)
            except ServiceError as error:
                if error.status not in BUSY_STATUSES | UNAVAILABLE_STATUSES:
                    raise
                time.sleep(_BUSY_SECONDS)  # it has enough streams, so that the job is asked for now and then
            # The service may go away between the end of the stream and this answer, too.
            job: dict[str, Any] = api.get(f"/v1/jobs/{job_id}")
        except (httpx.TransportError, ServiceUnreachableError) as error:
            if not patience.wait():
                raise (
                    error if isinstance(error, ServiceUnreachableError) else api.unreachable_error(error)
                ) from None
            continue
        if job["state"] in TERMINAL:
            return job
        time.sleep(_POLL_SECONDS)


def _read_events(api: Api, job_id: str, last: str) -> Iterator[tuple[str, dict[str, Any], str]]:
    """Yield kind, data and id of the events after ``last``, until the stream ends."""
    timeout = httpx.Timeout(10.0, read=60.0)
    headers = {"Last-Event-ID": last, "Accept": "text/event-stream"}
    with api.stream("GET", f"/v1/jobs/{job_id}/events", headers=headers, timeout=timeout) as response:
        api.raise_for_stream_status(response)
        kind, data, number = "message", "", last
        for line in response.iter_lines():
            name, _, value = line.partition(":")
            value = value.removeprefix(" ")
            if name == "event":
                kind = value
            elif name == "data":
                data += value
            elif name == "id":
                number = value
            # An empty line ends an event of the stream.
            elif not line and data:
                yield kind, json.loads(data), number
                kind, data = "message", ""


def _dispatch(
    kind: str, data: dict[str, Any], on_event: EventListener, on_state: Callable[[dict[str, Any]], None]
) -> None:
    event = decode_event(kind, data)
    if event is not None:
        on_event(event)
    elif kind not in EVENT_STREAM_KINDS:
        on_state({"kind": kind, **data})

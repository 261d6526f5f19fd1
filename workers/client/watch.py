"""A job's progress as the engine's events, from its stream of events."""

import json
import time
from collections.abc import Callable, Iterator
from typing import Any

import httpx

from octasplat.engine.events import Listener
from octasplat.workers.client.api import Api, Unreachable, check_stream
from octasplat.workers.telling.events import TOLD_KINDS, told_event

TERMINAL = frozenset({"succeeded", "failed", "canceled"})
_PATIENCE_SECONDS = 120.0


def watch_job(
    api: Api, job_id: str, listener: Listener, on_state: Callable[[dict[str, Any]], None]
) -> dict[str, Any]:
    """Follow a job to its end, over any break of the connection.

    Args:
        api: the service.
        job_id: which.
        listener: hears what the engine tells.
        on_state: hears of changes of state, rescues and the like.

    Returns:
        The job.

    Raises:
        ServiceError: there is no such job.
        Unreachable: the service was away for two minutes.
    """
    last = "0"
    away: float | None = None
    while True:
        try:
            for kind, data, number in _events(api, job_id, last):
                last, away = number, None
                _tell(kind, data, listener, on_state)
            job: dict[str, Any] = api.get(f"/v1/jobs/{job_id}")
        except (httpx.TransportError, Unreachable) as error:
            away = time.monotonic() if away is None else away
            if time.monotonic() - away > _PATIENCE_SECONDS:
                raise (error if isinstance(error, Unreachable) else api.unreachable(error)) from None
            time.sleep(0.5)
            continue
        away = None
        if job["state"] in TERMINAL:
            return job
        time.sleep(0.5)


def _events(api: Api, job_id: str, last: str) -> Iterator[tuple[str, dict[str, Any], str]]:
    """Kind, data and id of events after ``last``, until the stream ends."""
    timeout = httpx.Timeout(10.0, read=60.0)
    headers = {"Last-Event-ID": last, "Accept": "text/event-stream"}
    with api.stream("GET", f"/v1/jobs/{job_id}/events", headers=headers, timeout=timeout) as response:
        if response.status_code == 503:
            response.read()
            time.sleep(2)
            return
        check_stream(response)
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
            elif not line and data:
                yield kind, json.loads(data), number
                kind, data = "message", ""


def _tell(
    kind: str, data: dict[str, Any], listener: Listener, on_state: Callable[[dict[str, Any]], None]
) -> None:
    event = told_event(kind, data)
    if event is not None:
        listener(event)
    elif kind not in TOLD_KINDS:
        on_state({"kind": kind, **data})

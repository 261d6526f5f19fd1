"""A job's progress as the engine's events, from its stream of events."""

import json
import time
from collections.abc import Callable, Iterator
from typing import Any

import httpx

from octasplat.engine.events import Listener
from octasplat.workers.client.api import AWAY, BUSY, Api, ServiceError, Unreachable
from octasplat.workers.client.patience import AWAY_SECONDS, Patience
from octasplat.workers.telling.events import TOLD_KINDS, told_event

TERMINAL = frozenset({"succeeded", "failed", "canceled"})
_LOOK_SECONDS = 0.5
_BUSY_SECONDS = 2.0


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
        Unreachable: the service was away for too long, see :mod:`octasplat.workers.client.patience`.
    """
    last = "0"
    patience = Patience(AWAY_SECONDS)
    while True:
        try:
            for kind, data, number in _events(api, job_id, last):
                last = number
                patience.renew()
                _tell(kind, data, listener, on_state)
        except (httpx.TransportError, Unreachable) as error:
            if not patience.wait():
                raise (error if isinstance(error, Unreachable) else api.unreachable(error)) from None
            continue
        except ServiceError as error:
            if error.status not in BUSY | AWAY:
                raise
            time.sleep(_BUSY_SECONDS)  # it has enough streams, so that the job is asked for now and then
        job: dict[str, Any] = api.get(f"/v1/jobs/{job_id}")
        if job["state"] in TERMINAL:
            return job
        time.sleep(_LOOK_SECONDS)


def _events(api: Api, job_id: str, last: str) -> Iterator[tuple[str, dict[str, Any], str]]:
    """Kind, data and id of events after ``last``, until the stream ends."""
    timeout = httpx.Timeout(10.0, read=60.0)
    headers = {"Last-Event-ID": last, "Accept": "text/event-stream"}
    with api.stream("GET", f"/v1/jobs/{job_id}/events", headers=headers, timeout=timeout) as response:
        api.check_stream(response)
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

"""State that all requests share."""

import asyncio
import time
from dataclasses import dataclass, field
from typing import Annotated

from fastapi import Depends, Request

from octasplat.service.event_broker import EventBroker
from octasplat.service.eviction import SpaceEvictor
from octasplat.service.intake.spool import SpoolSpace
from octasplat.service.live_scene_file import KeptRows
from octasplat.service.login_throttle import LoginThrottle
from octasplat.service.metrics import Metrics
from octasplat.service.settings import ServiceSettings
from octasplat.workers.db.connections import Pool
from octasplat.workers.queue.protocol import JobQueue
from octasplat.workers.storage.protocol import Storage


@dataclass
class Service:
    """State of the running service.

    Attributes:
        settings: its settings.
        pool: connections to the database.
        job_queue: the queue.
        storage: the store.
        event_broker: tells of events.
        evictor: makes room in the store.
        login_throttle: counts wrong tokens.
        spool_space: room for archives while they are read.
        task_added: set when a task on a dataset was added, which this process may take.
        storage_check: what the store was last found to be, or is being.
        live_rows: rows of files of live scenes that were read.
        metrics: counts what this process does.
        is_draining: whether it is about to stop.
        started_at: monotonic time.
    """

    settings: ServiceSettings
    pool: Pool
    job_queue: JobQueue
    storage: Storage
    event_broker: EventBroker
    evictor: SpaceEvictor
    login_throttle: LoginThrottle
    spool_space: SpoolSpace
    task_added: asyncio.Event = field(default_factory=asyncio.Event)
    storage_check: "asyncio.Future[str] | None" = None
    live_rows: KeptRows = field(default_factory=KeptRows)
    metrics: Metrics = field(default_factory=Metrics)
    is_draining: bool = False
    started_at: float = field(default_factory=time.monotonic)


def get_service(request: Request) -> Service:
    """Return the service of a request."""
    service: Service = request.app.state.service
    return service


ServiceDep = Annotated[Service, Depends(get_service)]

"""What all requests share."""

import asyncio
import time
from dataclasses import dataclass, field
from typing import Annotated

from fastapi import Depends, Request

from octasplat.service.gate import Gate
from octasplat.service.guesses import Guesses
from octasplat.service.hub import EventHub
from octasplat.service.intake.spool import Spool
from octasplat.service.making_room import RoomMaker
from octasplat.service.metrics import Metrics
from octasplat.service.settings import ServiceSettings
from octasplat.workers.queue.port import Slips
from octasplat.workers.records.database import Pool
from octasplat.workers.store.protocol import Storage


@dataclass
class Service:
    """The service while it runs.

    Attributes:
        settings: its settings.
        pool: connections to the database.
        slips: the queue.
        storage: the store.
        hub: tells of events.
        room: makes room in the store.
        guesses: counts wrong tokens.
        spool: room for archives while they are read.
        checks: lets in those whose datasets are checked.
        storage_look: what the store was last found to be, or is being.
        metrics: counts what this process does.
        has_tokens: whether anybody ever had a token, as of ``tokens_seen``.
        tokens_seen: monotonic time.
        draining: whether it is about to stop.
        started: monotonic time.
    """

    settings: ServiceSettings
    pool: Pool
    slips: Slips
    storage: Storage
    hub: EventHub
    room: RoomMaker
    guesses: Guesses
    spool: Spool
    checks: Gate
    storage_look: "asyncio.Future[str] | None" = None
    metrics: Metrics = field(default_factory=Metrics)
    has_tokens: bool = True
    tokens_seen: float = -1e9
    draining: bool = False
    started: float = field(default_factory=time.monotonic)

    def forget_tokens(self) -> None:
        """Look for tokens anew at the next request."""
        self.tokens_seen = -1e9


def service_of(request: Request) -> Service:
    """The service that a request has reached."""
    service: Service = request.app.state.service
    return service


ServiceDep = Annotated[Service, Depends(service_of)]

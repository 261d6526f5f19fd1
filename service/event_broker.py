"""Notification of streams when a job has new events, over one listening connection."""

import asyncio
import contextlib
import logging
import uuid
from collections import Counter
from collections.abc import Iterator

import psycopg
from psycopg.conninfo import make_conninfo

from octasplat.service.client_addresses import client_group
from octasplat.workers.db.connections import KEEPALIVES
from octasplat.workers.db.events_and_logs import CHANNEL

logger = logging.getLogger(__name__)
_RECONNECT_SECONDS = 1.0


class EventBroker:
    """Wakes the streams that wait for a job's events.

    Args:
        conninfo: how to connect.
        listen: False where notifications do not arrive; streams then look by themselves.
    """

    def __init__(self, conninfo: str, *, listen: bool = True) -> None:
        self._conninfo = conninfo
        self._listen = listen
        self._subscribers: dict[uuid.UUID, set[asyncio.Event]] = {}
        self._owners: Counter[str] = Counter()
        self._addresses: Counter[str] = Counter()
        self._closing = asyncio.Event()

    @property
    def subscriber_count(self) -> int:
        """Return the number of waiting streams."""
        return sum(len(events) for events in self._subscribers.values())

    def count_of_owner(self, owner: str) -> int:
        """Return the number of an owner's waiting streams."""
        return self._owners[owner]

    def count_of_address(self, address: str) -> int:
        """Return the number of an address's waiting streams."""
        return self._addresses[client_group(address)]

    @property
    def is_closing(self) -> bool:
        """Return whether streams should end."""
        return self._closing.is_set()

    def close(self) -> None:
        """Wake all subscribers for the last time."""
        self._closing.set()
        self._wake_all()

    @contextlib.contextmanager
    def subscribe(self, job_id: uuid.UUID, owner: str, address: str) -> Iterator[asyncio.Event]:
        """Yield an event that is set whenever the job has new events, until the block ends.

        Args:
            job_id: the job.
            owner: whoever listens.
            address: where from.
        """
        group = client_group(address)
        event = asyncio.Event()
        self._subscribers.setdefault(job_id, set()).add(event)
        self._owners[owner] += 1
        self._addresses[group] += 1
        try:
            yield event
        finally:
            for counter, name in ((self._owners, owner), (self._addresses, group)):
                counter[name] -= 1
                if not counter[name]:
                    del counter[name]
            events = self._subscribers[job_id]
            events.discard(event)
            if not events:
                del self._subscribers[job_id]

    async def run(self) -> None:
        """Listen until cancelled, again after every loss of the connection."""
        while self._listen:
            try:
                await self._listen_once()
            except (psycopg.Error, OSError) as error:
                logger.info("not hearing of events for a moment: %s", error)
            except Exception:
                logger.exception("listening to events failed and is begun again")
            # Notifications may have been missed, so that all streams look by themselves.
            self._wake_all()
            await asyncio.sleep(_RECONNECT_SECONDS)

    async def _listen_once(self) -> None:
        # Not one of the pool, as listening takes it for good.
        connection = await psycopg.AsyncConnection.connect(
            make_conninfo(self._conninfo, **KEEPALIVES), autocommit=True, connect_timeout=10
        )
        async with connection:
            await connection.execute(f"LISTEN {CHANNEL}")
            self._wake_all()  # something may have happened while nobody listened
            async for notification in connection.notifies():
                with contextlib.suppress(ValueError):
                    for event in self._subscribers.get(uuid.UUID(notification.payload), ()):
                        event.set()

    def _wake_all(self) -> None:
        for events in self._subscribers.values():
            for event in events:
                event.set()

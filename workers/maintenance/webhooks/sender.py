"""Delivery of webhook messages to addresses that users chose."""

import asyncio
import logging
import uuid
from collections import Counter
from datetime import UTC, datetime

import httpx
import psycopg
from psycopg_pool import PoolTimeout

from octasplat.workers.cancellation import cancel_and_wait
from octasplat.workers.db.connections import Pool
from octasplat.workers.maintenance.webhooks.addresses import AddressRefusedError, check_url
from octasplat.workers.maintenance.webhooks.guarded_transport import OWNER_EXTENSION, GuardedTransport
from octasplat.workers.maintenance.webhooks.outbox import Outcome, lease_due, record_outcome
from octasplat.workers.maintenance.webhooks.rows import Delivery, Endpoint
from octasplat.workers.maintenance.webhooks.signing import signed_message

logger = logging.getLogger(__name__)

TIMEOUT_SECONDS = 15.0
MAX_CONCURRENT = 40
MAX_PER_OWNER = 5
"""Messages of an owner that are being sent; those of others do not wait for slow answers to them."""


class WebhookSender:
    """Sends messages, each by itself.

    Args:
        pool: connections.
        allowed_hosts: see :func:`octasplat.workers.maintenance.webhooks.addresses.check_url`.
    """

    def __init__(self, pool: Pool, allowed_hosts: tuple[str, ...] = ()) -> None:
        self._pool = pool
        self._allowed_hosts = allowed_hosts
        self._client = guarded_client(allowed_hosts)
        self._in_flight: Counter[str] = Counter()
        self._tasks: set[asyncio.Task[None]] = set()
        self._failing: set[uuid.UUID] = set()
        self.sent_count = 0

    async def start_due(self) -> int:
        """Start sending the messages that are due and allowed now; returns how many."""
        async with self._pool.connection() as connection:
            taken = await lease_due(
                connection,
                max(0, MAX_CONCURRENT - len(self._tasks)),
                max_per_owner=MAX_PER_OWNER,
                in_flight=self._in_flight,
            )
        for delivery, endpoint in taken:
            self._in_flight[endpoint.owner] += 1
            task = asyncio.create_task(self._send(delivery, endpoint))
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)
        return len(taken)

    async def wait(self) -> None:
        """Wait until one of the messages in flight is settled."""
        if self._tasks:
            await asyncio.wait(set(self._tasks), return_when=asyncio.FIRST_COMPLETED)

    async def close(self) -> None:
        """Stop sending; messages in flight will be sent again."""
        await cancel_and_wait(self._tasks)
        await self._client.aclose()

    async def _send(self, delivery: Delivery, endpoint: Endpoint) -> None:
        try:
            outcome = await send(self._client, delivery, endpoint, self._allowed_hosts)
            self._log_change(endpoint, outcome)
            async with self._pool.connection() as connection:
                await record_outcome(connection, delivery, outcome)
            self.sent_count += 1
        except (psycopg.Error, PoolTimeout, OSError) as error:
            # The lease runs out by itself, and the message is sent again.
            logger.info("what became of message %s was not entered: %s", delivery.id, error)
        except Exception:
            logger.exception("message %s was not sent and is tried again", delivery.id)
        finally:
            self._in_flight[endpoint.owner] -= 1
            if not self._in_flight[endpoint.owner]:
                del self._in_flight[endpoint.owner]

    def _log_change(self, endpoint: Endpoint, outcome: Outcome) -> None:
        """Log that a webhook takes no messages any more, or takes them again; not each message."""
        if outcome.is_success:
            if endpoint.id in self._failing:
                self._failing.discard(endpoint.id)
                logger.info("webhook %s takes messages again", endpoint.id)
        elif endpoint.id not in self._failing:
            self._failing.add(endpoint.id)
            logger.info("webhook %s takes no messages: %s", endpoint.id, outcome.error)


def guarded_client(allowed_hosts: tuple[str, ...] = ()) -> httpx.AsyncClient:
    """Return a client that connects to public addresses and to those in ``allowed_hosts`` only."""
    # No proxy of the environment, as it would be the proxy that looks names up.
    inner = httpx.AsyncHTTPTransport(trust_env=False, limits=httpx.Limits(max_keepalive_connections=0))
    return httpx.AsyncClient(
        trust_env=False,
        follow_redirects=False,
        timeout=TIMEOUT_SECONDS,
        transport=GuardedTransport(allowed_hosts, inner),
    )


async def send(
    client: httpx.AsyncClient, delivery: Delivery, endpoint: Endpoint, allowed_hosts: tuple[str, ...] = ()
) -> Outcome:
    """Send a message once; only the status of the response is used."""
    body, headers = signed_message(endpoint.secret, delivery.id, delivery.payload, datetime.now(UTC))
    try:
        # Checked here again, as the list of allowed hosts may have changed since the webhook was made.
        check_url(endpoint.url, allowed_hosts)
        async with (
            asyncio.timeout(TIMEOUT_SECONDS),
            client.stream(
                "POST",
                endpoint.url,
                content=body,
                headers=headers,
                extensions={OWNER_EXTENSION: endpoint.owner},
            ) as answer,
        ):
            status = answer.status_code
    except AddressRefusedError:
        return Outcome(None, "The address leads into a network that messages are not sent to.")
    except (TimeoutError, httpx.TimeoutException):
        return Outcome(None, f"There was no answer within {TIMEOUT_SECONDS:g} s.")
    except (httpx.HTTPError, httpx.InvalidURL, OSError, ValueError) as error:
        return Outcome(None, f"The address cannot be reached ({type(error).__name__}).")
    return Outcome(status, None if 200 <= status < 300 else f"The address answered {status}.")

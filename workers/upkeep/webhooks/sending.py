"""Sending messages to addresses that others chose."""

import asyncio
import logging
from datetime import UTC, datetime

import httpx

from workers.records.database import Pool
from workers.upkeep.webhooks.addresses import AddressRefused, check_url
from workers.upkeep.webhooks.guarding import GuardedTransport
from workers.upkeep.webhooks.outbox import Outcome, settle, take_due
from workers.upkeep.webhooks.rows import Delivery, Endpoint
from workers.upkeep.webhooks.signing import message

logger = logging.getLogger(__name__)

TIMEOUT_SECONDS = 15.0
AT_ONCE = 20


async def send_due(pool: Pool, allowed_hosts: tuple[str, ...] = ()) -> int:
    """Send what is due, until nothing is.

    Args:
        pool: connections.
        allowed_hosts: see :func:`workers.upkeep.webhooks.addresses.check_url`.

    Returns:
        Number of messages sent, whether they arrived or not.
    """
    sent = 0
    while True:
        async with pool.connection() as connection:
            taken = await take_due(connection, AT_ONCE)
        if not taken:
            return sent
        async with guarded_client(allowed_hosts) as client:
            sends = (_send(pool, client, *each, allowed_hosts) for each in taken)
            for outcome in await asyncio.gather(*sends, return_exceptions=True):
                if outcome is not None:
                    raise outcome
        sent += len(taken)


def guarded_client(allowed_hosts: tuple[str, ...] = ()) -> httpx.AsyncClient:
    """A client that connects to addresses of the public network only, and to what ``allowed_hosts`` names."""
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
    """Send a message once. Of the answer only the status is looked at."""
    body, headers = message(endpoint.secret, delivery.id, delivery.payload, datetime.now(UTC))
    try:
        check_url(endpoint.url, allowed_hosts)
        async with (
            asyncio.timeout(TIMEOUT_SECONDS),
            client.stream("POST", endpoint.url, content=body, headers=headers) as answer,
        ):
            status = answer.status_code
    except AddressRefused:
        return Outcome(None, "The address leads into a network that messages are not sent to.")
    except (TimeoutError, httpx.TimeoutException):
        return Outcome(None, f"There was no answer within {TIMEOUT_SECONDS:g} s.")
    except (httpx.HTTPError, httpx.InvalidURL, OSError, ValueError) as error:
        return Outcome(None, f"The address cannot be reached ({type(error).__name__}).")
    return Outcome(status, None if 200 <= status < 300 else f"The address answered {status}.")


async def _send(
    pool: Pool,
    client: httpx.AsyncClient,
    delivery: Delivery,
    endpoint: Endpoint,
    allowed_hosts: tuple[str, ...],
) -> None:
    outcome = await send(client, delivery, endpoint, allowed_hosts)
    if not outcome.is_success:
        logger.info("message %s of webhook %s: %s", delivery.id, endpoint.id, outcome.error)
    async with pool.connection() as connection:
        await settle(connection, delivery, outcome)

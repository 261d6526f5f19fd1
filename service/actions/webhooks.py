"""Webhooks: created, listed, changed, tested, and their deliveries."""

import uuid
from collections.abc import Callable

from octasplat.service.actions.access import fetch_visible_job, fetch_visible_webhook
from octasplat.service.actions.pages import Page, page_of
from octasplat.service.auth import Principal
from octasplat.service.idempotency import create_once, fingerprint
from octasplat.service.problems import ProblemError, not_found_error
from octasplat.service.schemas.webhooks import NewWebhook, WebhookChange
from octasplat.service.state import Service
from octasplat.service.webhook_addresses import check_webhook_address
from octasplat.workers.db.connections import Connection, retry_on_deadlock
from octasplat.workers.db.locks import lock_owner
from octasplat.workers.maintenance.webhooks import rows
from octasplat.workers.maintenance.webhooks.rows import Delivery, Endpoint
from octasplat.workers.maintenance.webhooks.signing import new_secret


@retry_on_deadlock
async def create_webhook(
    service: Service, principal: Principal, new: NewWebhook, *, idempotency_key: str | None = None
) -> Endpoint:
    """Create a webhook for the caller's jobs, or for one job.

    The same request with the key makes nothing new.

    Raises:
        ProblemError: 404, or 422 for an address that messages are not sent to or a key used otherwise.
    """
    check_webhook_address(service, new.url)
    async with service.pool.connection() as connection, connection.transaction():

        async def make() -> uuid.UUID:
            owner = principal.owner
            if new.job_id is not None:
                owner = (await fetch_visible_job(connection, principal, new.job_id)).owner
            # The owner's lock comes before the row of the job, see workers.db.locks.
            await lock_owner(connection, owner)
            if new.job_id is not None:
                await fetch_visible_job(connection, principal, new.job_id, lock=True)
            made = await rows.add_endpoint(
                connection,
                owner=owner,
                url=new.url,
                secret=new.secret or new_secret(),
                events=new.events,
                job_id=new.job_id,
            )
            return made.id

        named = fingerprint("webhook", new.model_dump(mode="json", exclude_defaults=True))
        endpoint_id, _ = await create_once(connection, principal, idempotency_key, named, make)
        return await fetch_visible_webhook(connection, principal, endpoint_id)


async def list_webhooks(
    service: Service, principal: Principal, *, before: uuid.UUID | None, limit: int
) -> Page[Endpoint]:
    """Return the webhooks before ``before`` that the principal may see, newest first."""
    async with service.pool.connection() as connection:
        found = await rows.list_endpoints(
            connection, owner=principal.visible_owner, before=before, limit=limit + 1
        )
    return page_of(found, limit, lambda endpoint: endpoint.id)


async def get_webhook(service: Service, principal: Principal, webhook_id: uuid.UUID) -> Endpoint:
    """Return the webhook with that id, if the principal may see it.

    Raises:
        ProblemError: 404 if it does not exist or the principal may not see it.
    """
    async with service.pool.connection() as connection:
        return await fetch_visible_webhook(connection, principal, webhook_id)


@retry_on_deadlock
async def change_webhook(
    service: Service,
    principal: Principal,
    webhook_id: uuid.UUID,
    change: WebhookChange,
    check: Callable[[Endpoint], None] = lambda _: None,
) -> Endpoint:
    """Change a webhook, pause it, or enable it again.

    Args:
        service: the service.
        principal: asks.
        webhook_id: the webhook.
        change: what is to be different.
        check: sees the webhook as it is and raises to leave it so.

    Raises:
        ProblemError: 404, or 422 for an address that messages are not sent to.
    """
    if change.url is not None:
        check_webhook_address(service, change.url)
    async with service.pool.connection() as connection, connection.transaction():
        check(await fetch_visible_webhook(connection, principal, webhook_id, lock=True))
        return await rows.change_endpoint(connection, webhook_id, **change.model_dump(exclude_unset=True))


@retry_on_deadlock
async def delete_webhook(service: Service, principal: Principal, webhook_id: uuid.UUID) -> None:
    """Delete a webhook with its messages.

    Raises:
        ProblemError: 404 if it does not exist or the principal may not see it.
    """
    async with service.pool.connection() as connection:
        await fetch_visible_webhook(connection, principal, webhook_id)
        await rows.delete_endpoint(connection, webhook_id)


async def send_test(
    service: Service, principal: Principal, webhook_id: uuid.UUID, *, idempotency_key: str | None = None
) -> Delivery:
    """Send a test message; the same request with the key sends no other.

    Raises:
        ProblemError: 404, 409 if the webhook is disabled, or 422 for a key used otherwise.
    """
    async with service.pool.connection() as connection, connection.transaction():

        async def send() -> uuid.UUID:
            endpoint = _check_enabled(await fetch_visible_webhook(connection, principal, webhook_id))
            data = {"webhook_id": str(endpoint.id)}
            return (await rows.add_delivery(connection, endpoint.id, rows.TEST_EVENT, data)).id

        named = fingerprint("webhook test", str(webhook_id))
        sent_id, _ = await create_once(connection, principal, idempotency_key, named, send)
        return await _fetch_delivery(connection, principal, webhook_id, sent_id)


async def list_deliveries(
    service: Service, principal: Principal, webhook_id: uuid.UUID, limit: int
) -> list[Delivery]:
    """Return the newest messages and their outcomes.

    Raises:
        ProblemError: 404 if it does not exist or the principal may not see it.
    """
    async with service.pool.connection() as connection:
        await fetch_visible_webhook(connection, principal, webhook_id)
        return await rows.list_deliveries(connection, webhook_id, limit)


@retry_on_deadlock
async def redeliver(
    service: Service,
    principal: Principal,
    webhook_id: uuid.UUID,
    delivery_id: uuid.UUID,
    *,
    idempotency_key: str | None = None,
) -> Delivery:
    """Send a message again, with the same id and content; the same request with the key only once.

    Raises:
        ProblemError: 404, 409 if the webhook is disabled, or 422 for a key used otherwise.
    """
    async with service.pool.connection() as connection, connection.transaction():

        async def send() -> uuid.UUID:
            _check_enabled(await fetch_visible_webhook(connection, principal, webhook_id))
            await _fetch_delivery(connection, principal, webhook_id, delivery_id)
            return (await rows.redeliver(connection, delivery_id)).id

        named = fingerprint("redeliver", str(webhook_id), str(delivery_id))
        await create_once(connection, principal, idempotency_key, named, send)
        return await _fetch_delivery(connection, principal, webhook_id, delivery_id)


async def _fetch_delivery(
    connection: Connection, principal: Principal, webhook_id: uuid.UUID, delivery_id: uuid.UUID
) -> Delivery:
    """Return a message of a webhook that the principal may see."""
    await fetch_visible_webhook(connection, principal, webhook_id)
    delivery = await rows.get_delivery(connection, webhook_id, delivery_id)
    if delivery is None:
        raise not_found_error("message")
    return delivery


def _check_enabled(endpoint: Endpoint) -> Endpoint:
    if not endpoint.enabled:
        raise ProblemError(
            409, "webhook-disabled", "The webhook is disabled; PATCH it with enabled true first."
        )
    return endpoint

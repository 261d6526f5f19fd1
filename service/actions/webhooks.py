"""Webhooks: created, listed, changed, tested, and their deliveries."""

import uuid
from dataclasses import dataclass

from octasplat.service.actions.access import fetch_visible_job, fetch_visible_webhook
from octasplat.service.actions.pages import Page, page_of
from octasplat.service.auth import Principal
from octasplat.service.problems import ProblemError, not_found_error
from octasplat.service.schemas.webhooks import NewWebhook, WebhookChange
from octasplat.service.state import Service
from octasplat.service.webhook_addresses import check_webhook_address
from octasplat.workers.db.connections import retry_on_deadlock
from octasplat.workers.db.locks import lock_owner
from octasplat.workers.maintenance.webhooks import rows
from octasplat.workers.maintenance.webhooks.rows import Delivery, Endpoint
from octasplat.workers.maintenance.webhooks.signing import new_secret


@dataclass(frozen=True)
class CreatedEndpoint:
    """A new webhook, with its secret."""

    row: Endpoint
    secret: str


@retry_on_deadlock
async def create_webhook(service: Service, principal: Principal, new: NewWebhook) -> CreatedEndpoint:
    """Create a webhook for the caller's jobs, or for one job.

    Raises:
        ProblemError: 404, or 422 for an address that messages are not sent to.
    """
    check_webhook_address(service, new.url)
    secret = new.secret or new_secret()
    async with service.pool.connection() as connection, connection.transaction():
        owner = principal.owner
        if new.job_id is not None:
            owner = (await fetch_visible_job(connection, principal, new.job_id)).owner
        await lock_owner(connection, owner)
        if new.job_id is not None:
            await fetch_visible_job(connection, principal, new.job_id, lock=True)
        made = await rows.add_endpoint(
            connection, owner=owner, url=new.url, secret=secret, events=new.events, job_id=new.job_id
        )
    return CreatedEndpoint(made, secret)


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
    service: Service, principal: Principal, webhook_id: uuid.UUID, change: WebhookChange
) -> Endpoint:
    """Change a webhook, pause it, or enable it again.

    Raises:
        ProblemError: 404, or 422 for an address that messages are not sent to.
    """
    if change.url is not None:
        check_webhook_address(service, change.url)
    async with service.pool.connection() as connection:
        await fetch_visible_webhook(connection, principal, webhook_id)
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


async def send_test(service: Service, principal: Principal, webhook_id: uuid.UUID) -> Delivery:
    """Send a test message.

    Raises:
        ProblemError: 404, or 409 if the webhook is disabled.
    """
    async with service.pool.connection() as connection:
        endpoint = _check_enabled(await fetch_visible_webhook(connection, principal, webhook_id))
        data = {"webhook_id": str(endpoint.id)}
        return await rows.add_delivery(connection, endpoint.id, rows.TEST_EVENT, data)


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
    service: Service, principal: Principal, webhook_id: uuid.UUID, delivery_id: uuid.UUID
) -> Delivery:
    """Send a message again, with the same id and content.

    Raises:
        ProblemError: 404, or 409 if the webhook is disabled.
    """
    async with service.pool.connection() as connection, connection.transaction():
        _check_enabled(await fetch_visible_webhook(connection, principal, webhook_id))
        if await rows.get_delivery(connection, webhook_id, delivery_id) is None:
            raise not_found_error("message")
        return await rows.redeliver(connection, delivery_id)


def _check_enabled(endpoint: Endpoint) -> Endpoint:
    if not endpoint.enabled:
        raise ProblemError(
            409, "webhook-disabled", "The webhook is disabled; PATCH it with enabled true first."
        )
    return endpoint

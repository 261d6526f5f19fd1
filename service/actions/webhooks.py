"""Webhooks: made, listed, changed, tried out; and what became of their messages."""

import uuid
from dataclasses import dataclass

from octasplat.service.actions.access import owned_job, owned_webhook
from octasplat.service.actions.parts import Part, cut
from octasplat.service.auth import Principal
from octasplat.service.problems import Problem, not_found
from octasplat.service.schemas.webhooks import NewWebhook, WebhookChange
from octasplat.service.state import Service
from octasplat.service.webhook_addresses import check_address
from octasplat.workers.records.database import tried_again
from octasplat.workers.records.locks import lock_owner
from octasplat.workers.upkeep.webhooks import rows
from octasplat.workers.upkeep.webhooks.rows import Delivery, Endpoint
from octasplat.workers.upkeep.webhooks.signing import new_secret


@dataclass(frozen=True)
class NewEndpoint:
    """A webhook that was just made, with its secret."""

    row: Endpoint
    secret: str


@tried_again
async def create_webhook(service: Service, who: Principal, new: NewWebhook) -> NewEndpoint:
    """Be told of the asker's jobs, or of one job.

    Raises:
        Problem: 404, or 422 for an address that messages are not sent to.
    """
    check_address(service, new.url)
    secret = new.secret or new_secret()
    async with service.pool.connection() as connection, connection.transaction():
        owner = who.owner
        if new.job_id is not None:
            owner = (await owned_job(connection, who, new.job_id)).owner
        await lock_owner(connection, owner)
        if new.job_id is not None:
            await owned_job(connection, who, new.job_id, lock=True)
        made = await rows.add_endpoint(
            connection, owner=owner, url=new.url, secret=secret, events=new.events, job_id=new.job_id
        )
    return NewEndpoint(made, secret)


async def list_webhooks(
    service: Service, who: Principal, *, before: uuid.UUID | None, limit: int
) -> Part[Endpoint]:
    """Webhooks that the asker may see, the newest first, those made before ``before``."""
    async with service.pool.connection() as connection:
        found = await rows.list_endpoints(connection, owner=who.sees, before=before, limit=limit + 1)
    return cut(found, limit, lambda endpoint: endpoint.id)


async def get_webhook(service: Service, who: Principal, webhook_id: uuid.UUID) -> Endpoint:
    """A webhook.

    Raises:
        Problem: 404.
    """
    async with service.pool.connection() as connection:
        return await owned_webhook(connection, who, webhook_id)


@tried_again
async def change_webhook(
    service: Service, who: Principal, webhook_id: uuid.UUID, change: WebhookChange
) -> Endpoint:
    """Change a webhook, pause it, or enable it again.

    Raises:
        Problem: 404, or 422 for an address that messages are not sent to.
    """
    if change.url is not None:
        check_address(service, change.url)
    async with service.pool.connection() as connection:
        await owned_webhook(connection, who, webhook_id)
        return await rows.change_endpoint(connection, webhook_id, **change.model_dump(exclude_unset=True))


@tried_again
async def delete_webhook(service: Service, who: Principal, webhook_id: uuid.UUID) -> None:
    """Delete a webhook with its messages.

    Raises:
        Problem: 404.
    """
    async with service.pool.connection() as connection:
        await owned_webhook(connection, who, webhook_id)
        await rows.delete_endpoint(connection, webhook_id)


async def send_test(service: Service, who: Principal, webhook_id: uuid.UUID) -> Delivery:
    """Send a message that says nothing.

    Raises:
        Problem: 404, or 409 if the webhook is disabled.
    """
    async with service.pool.connection() as connection:
        endpoint = _enabled(await owned_webhook(connection, who, webhook_id))
        data = {"webhook_id": str(endpoint.id)}
        return await rows.add_delivery(connection, endpoint.id, rows.TEST, data)


async def list_deliveries(
    service: Service, who: Principal, webhook_id: uuid.UUID, limit: int
) -> list[Delivery]:
    """The newest messages and what became of them.

    Raises:
        Problem: 404.
    """
    async with service.pool.connection() as connection:
        await owned_webhook(connection, who, webhook_id)
        return await rows.list_deliveries(connection, webhook_id, limit)


@tried_again
async def send_again(
    service: Service, who: Principal, webhook_id: uuid.UUID, delivery_id: uuid.UUID
) -> Delivery:
    """Send a message once more, with the same id and content.

    Raises:
        Problem: 404, or 409 if the webhook is disabled.
    """
    async with service.pool.connection() as connection, connection.transaction():
        _enabled(await owned_webhook(connection, who, webhook_id))
        if await rows.get_delivery(connection, webhook_id, delivery_id) is None:
            raise not_found("message")
        return await rows.send_again(connection, delivery_id)


def _enabled(endpoint: Endpoint) -> Endpoint:
    if not endpoint.enabled:
        raise Problem(409, "webhook-disabled", "The webhook is disabled; PATCH it with enabled true first.")
    return endpoint

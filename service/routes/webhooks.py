"""Webhooks: other programs are told what happens to jobs (https://www.standardwebhooks.com)."""

import uuid
from typing import Annotated

from fastapi import APIRouter, Query, Request, Response

from service.auth import Principal, Reader, Writer
from service.paging import Cursor, Limit, link_next, read_id_cursor, write_cursor
from service.problems import Problem, not_found
from service.routes import problems
from service.routes.jobs import owned_job
from service.schemas.webhooks import (
    DeliveryList,
    DeliveryView,
    MadeWebhook,
    NewWebhook,
    WebhookChange,
    WebhookPage,
    WebhookView,
)
from service.state import ServiceDep
from service.webhook_addresses import check_address
from workers.records.database import Connection
from workers.upkeep.webhooks import rows
from workers.upkeep.webhooks.signing import new_secret

router = APIRouter(prefix="/v1/webhooks", tags=["webhooks"])


@router.post("", status_code=201, responses=problems(404))
async def create_webhook(
    new: NewWebhook, who: Writer, service: ServiceDep, response: Response
) -> MadeWebhook:
    """Be told of your jobs, or of one of them, at an address of yours.

    A message is a POST of JSON with the headers `webhook-id`, `webhook-timestamp` and `webhook-signature`. It
    says which job it is about; ask `GET /v1/jobs/{id}` for the rest. It may come more than once and is sent
    again for a day until the answer is 2xx within 15 seconds; an answer 410 disables the webhook.
    """
    check_address(service, new.url)
    secret = new.secret or new_secret()
    async with service.pool.connection() as connection, connection.transaction():
        owner = who.owner
        if new.job_id is not None:
            owner = (await owned_job(connection, who, new.job_id, lock=True)).owner
        made = await rows.add_endpoint(
            connection, owner=owner, url=new.url, secret=secret, events=new.events, job_id=new.job_id
        )
    response.headers["Location"] = f"/v1/webhooks/{made.id}"
    return MadeWebhook(**WebhookView.of(made).model_dump(), secret=secret)


@router.get("", responses=problems())
async def list_webhooks(
    who: Reader, service: ServiceDep, request: Request, response: Response, limit: Limit = 50,
    cursor: Cursor = None,
) -> WebhookPage:  # fmt: skip
    """Your webhooks, the newest first."""
    before = read_id_cursor(cursor)
    async with service.pool.connection() as connection:
        found = await rows.list_endpoints(connection, owner=who.sees, before=before, limit=limit + 1)
    following = write_cursor(str(found[limit - 1].id)) if len(found) > limit else None
    link_next(request, response, following)
    return WebhookPage(webhooks=[WebhookView.of(row) for row in found[:limit]], next=following)


@router.get("/{webhook_id}", responses=problems(404))
async def get_webhook(webhook_id: uuid.UUID, who: Reader, service: ServiceDep) -> WebhookView:
    """A webhook, without its secret."""
    async with service.pool.connection() as connection:
        return WebhookView.of(await _owned(connection, who, webhook_id))


@router.patch("/{webhook_id}", responses=problems(404))
async def change_webhook(
    webhook_id: uuid.UUID, change: WebhookChange, who: Writer, service: ServiceDep
) -> WebhookView:
    """Change a webhook, pause it, or enable it again after the service disabled it."""
    if change.url is not None:
        check_address(service, change.url)
    async with service.pool.connection() as connection:
        await _owned(connection, who, webhook_id)
        changed = await rows.change_endpoint(connection, webhook_id, **change.model_dump(exclude_unset=True))
    return WebhookView.of(changed)


@router.delete("/{webhook_id}", status_code=204, responses=problems(404))
async def delete_webhook(webhook_id: uuid.UUID, who: Writer, service: ServiceDep) -> None:
    """Delete a webhook; what was not delivered yet is not sent any more."""
    async with service.pool.connection() as connection:
        await _owned(connection, who, webhook_id)
        await rows.delete_endpoint(connection, webhook_id)


@router.post("/{webhook_id}/test", status_code=202, responses=problems(404, 409))
async def test_webhook(webhook_id: uuid.UUID, who: Writer, service: ServiceDep) -> DeliveryView:
    """Send a message of the type `webhook.test`; see `/deliveries` for what became of it."""
    async with service.pool.connection() as connection:
        endpoint = _enabled(await _owned(connection, who, webhook_id))
        data = {"webhook_id": str(endpoint.id)}
        return DeliveryView.of(await rows.add_delivery(connection, endpoint.id, rows.TEST, data))


@router.get("/{webhook_id}/deliveries", responses=problems(404))
async def list_deliveries(
    webhook_id: uuid.UUID, who: Reader, service: ServiceDep,
    limit: Annotated[int, Query(ge=1, le=200)] = 50,
) -> DeliveryList:  # fmt: skip
    """The newest messages and what became of them; they are kept for 30 days."""
    async with service.pool.connection() as connection:
        await _owned(connection, who, webhook_id)
        found = await rows.list_deliveries(connection, webhook_id, limit)
    return DeliveryList(deliveries=[DeliveryView.of(row) for row in found])


@router.post(
    "/{webhook_id}/deliveries/{delivery_id}/redeliver", status_code=202, responses=problems(404, 409)
)
async def redeliver(
    webhook_id: uuid.UUID, delivery_id: uuid.UUID, who: Writer, service: ServiceDep
) -> DeliveryView:
    """Send a message once more, with the same id and content."""
    async with service.pool.connection() as connection, connection.transaction():
        _enabled(await _owned(connection, who, webhook_id))
        if await rows.get_delivery(connection, webhook_id, delivery_id) is None:
            raise not_found("message")
        return DeliveryView.of(await rows.send_again(connection, delivery_id))


async def _owned(connection: Connection, who: Principal, webhook_id: uuid.UUID) -> rows.Endpoint:
    endpoint = await rows.get_endpoint(connection, webhook_id)
    if endpoint is None or not who.owns(endpoint.owner):
        raise not_found("webhook")
    return endpoint


def _enabled(endpoint: rows.Endpoint) -> rows.Endpoint:
    if not endpoint.enabled:
        raise Problem(409, "webhook-disabled", "The webhook is disabled; PATCH it with enabled true first.")
    return endpoint

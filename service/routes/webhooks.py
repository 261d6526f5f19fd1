"""Routes of webhooks, which notify other programs of job events (https://www.standardwebhooks.com)."""

import uuid
from typing import Annotated

from fastapi import APIRouter, Query, Request, Response

from octasplat.service.actions import webhooks as actions
from octasplat.service.auth import Reader, Writer
from octasplat.service.paging import Cursor, Limit, decode_id_cursor, set_next_link
from octasplat.service.routes import problem_responses
from octasplat.service.schemas.webhooks import (
    DeliveryList,
    DeliveryView,
    MadeWebhook,
    NewWebhook,
    WebhookChange,
    WebhookPage,
    WebhookView,
)
from octasplat.service.state import ServiceDep

router = APIRouter(prefix="/v1/webhooks", tags=["webhooks"])


@router.post("", status_code=201, responses=problem_responses(404))
async def create_webhook(
    new: NewWebhook, principal: Writer, service: ServiceDep, response: Response
) -> MadeWebhook:
    """Create a webhook for your jobs, or for one of them.

    A message is a POST of JSON with the headers `webhook-id`, `webhook-timestamp` and `webhook-signature`. It
    says which job it is about; ask `GET /v1/jobs/{id}` for the rest. It may come more than once and is sent
    again for a day until the answer is 2xx within 15 seconds; an answer 410 disables the webhook.
    """
    made = await actions.create_webhook(service, principal, new)
    response.headers["Location"] = f"/v1/webhooks/{made.row.id}"
    return MadeWebhook(**WebhookView.from_row(made.row).model_dump(), secret=made.secret)


@router.get("", responses=problem_responses())
async def list_webhooks(
    principal: Reader, service: ServiceDep, request: Request, response: Response, limit: Limit = 50,
    cursor: Cursor = None,
) -> WebhookPage:  # fmt: skip
    """List your webhooks, newest first."""
    part = await actions.list_webhooks(service, principal, before=decode_id_cursor(cursor), limit=limit)
    following = set_next_link(request, response, part.next_key)
    return WebhookPage(webhooks=[WebhookView.from_row(row) for row in part.rows], next=following)


@router.get("/{webhook_id}", responses=problem_responses(404))
async def get_webhook(webhook_id: uuid.UUID, principal: Reader, service: ServiceDep) -> WebhookView:
    """Return a webhook, without its secret."""
    return WebhookView.from_row(await actions.get_webhook(service, principal, webhook_id))


@router.patch("/{webhook_id}", responses=problem_responses(404))
async def change_webhook(
    webhook_id: uuid.UUID, change: WebhookChange, principal: Writer, service: ServiceDep
) -> WebhookView:
    """Change a webhook, pause it, or enable it again after the service disabled it."""
    return WebhookView.from_row(await actions.change_webhook(service, principal, webhook_id, change))


@router.delete("/{webhook_id}", status_code=204, responses=problem_responses(404))
async def delete_webhook(webhook_id: uuid.UUID, principal: Writer, service: ServiceDep) -> None:
    """Delete a webhook; what was not delivered yet is not sent any more."""
    await actions.delete_webhook(service, principal, webhook_id)


@router.post("/{webhook_id}/test", status_code=202, responses=problem_responses(404, 409))
async def test_webhook(webhook_id: uuid.UUID, principal: Writer, service: ServiceDep) -> DeliveryView:
    """Send a message of the type `webhook.test`; its outcome is in `/deliveries`."""
    return DeliveryView.from_row(await actions.send_test(service, principal, webhook_id))


@router.get("/{webhook_id}/deliveries", responses=problem_responses(404))
async def list_deliveries(
    webhook_id: uuid.UUID, principal: Reader, service: ServiceDep,
    limit: Annotated[int, Query(ge=1, le=200)] = 50,
) -> DeliveryList:  # fmt: skip
    """List the newest messages and their outcomes; they are kept for 30 days."""
    found = await actions.list_deliveries(service, principal, webhook_id, limit)
    return DeliveryList(deliveries=[DeliveryView.from_row(row) for row in found])


@router.post(
    "/{webhook_id}/deliveries/{delivery_id}/redeliver", status_code=202, responses=problem_responses(404, 409)
)
async def resend_delivery(
    webhook_id: uuid.UUID, delivery_id: uuid.UUID, principal: Writer, service: ServiceDep
) -> DeliveryView:
    """Send a message again, with the same id and content."""
    return DeliveryView.from_row(await actions.redeliver(service, principal, webhook_id, delivery_id))

"""Routes of webhooks, which notify other programs of job events (https://www.standardwebhooks.com)."""

from fastapi import APIRouter, Request, Response

from octasplat.service.actions import webhooks as actions
from octasplat.service.auth import Reader, Writer
from octasplat.service.etags import check_precondition, set_etag, unless_unchanged, view_etag
from octasplat.service.paging import Cursor, Limit, decode_id_cursor, set_next_link
from octasplat.service.routes import problem_responses
from octasplat.service.routes.parameters import DeliveryId, IdempotencyKey, IfMatch, IfNoneMatch, WebhookId
from octasplat.service.routes.response_headers import ETAG, LINK, LOCATION, not_modified, with_headers
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
from octasplat.workers.maintenance.webhooks.rows import Endpoint

router = APIRouter(prefix="/v1/webhooks", tags=["webhooks"])


@router.post("", status_code=201, responses={**with_headers(201, LOCATION), **problem_responses(404)})
async def create_webhook(
    new: NewWebhook, principal: Writer, service: ServiceDep, response: Response, key: IdempotencyKey = None
) -> MadeWebhook:
    """Create a webhook for your jobs, or for one of them.

    A message is a POST of JSON with the headers `webhook-id`, `webhook-timestamp` and `webhook-signature`. It
    says which job it is about; ask `GET /v1/jobs/{id}` for the rest. It may come more than once and is sent
    again for a day until the answer is 2xx within 15 seconds; an answer 410 disables the webhook.
    """
    made = await actions.create_webhook(service, principal, new, idempotency_key=key)
    response.headers["Location"] = f"/v1/webhooks/{made.id}"
    return MadeWebhook(**WebhookView.from_row(made).model_dump(), secret=made.secret)


@router.get("", responses={**with_headers(200, LINK), **problem_responses()})
async def list_webhooks(
    principal: Reader, service: ServiceDep, request: Request, response: Response, limit: Limit = 50,
    cursor: Cursor = None,
) -> WebhookPage:  # fmt: skip
    """List your webhooks, newest first."""
    part = await actions.list_webhooks(service, principal, before=decode_id_cursor(cursor), limit=limit)
    following = set_next_link(request, response, part.next_key)
    return WebhookPage(webhooks=[WebhookView.from_row(row) for row in part.rows], next=following)


@router.get(
    "/{webhook_id}", responses={**with_headers(200, ETAG), **not_modified(), **problem_responses(404)}
)
async def get_webhook(
    webhook_id: WebhookId, principal: Reader, service: ServiceDep, response: Response,
    if_none_match: IfNoneMatch = None,
) -> WebhookView:  # fmt: skip
    """Return a webhook, without its secret."""
    view = WebhookView.from_row(await actions.get_webhook(service, principal, webhook_id))
    return unless_unchanged(response, if_none_match, view_etag(view), view)


@router.patch("/{webhook_id}", responses={**with_headers(200, ETAG), **problem_responses(404, 412)})
async def change_webhook(
    webhook_id: WebhookId, change: WebhookChange, principal: Writer, service: ServiceDep, response: Response,
    if_match: IfMatch = None,
) -> WebhookView:  # fmt: skip
    """Change a webhook, pause it, or enable it again after the service disabled it."""

    def check(endpoint: Endpoint) -> None:
        check_precondition(if_match, view_etag(WebhookView.from_row(endpoint)))

    view = WebhookView.from_row(await actions.change_webhook(service, principal, webhook_id, change, check))
    set_etag(response, view_etag(view))
    return view


@router.delete("/{webhook_id}", status_code=204, responses=problem_responses(404))
async def delete_webhook(webhook_id: WebhookId, principal: Writer, service: ServiceDep) -> None:
    """Delete a webhook; what was not delivered yet is not sent any more."""
    await actions.delete_webhook(service, principal, webhook_id)


@router.post("/{webhook_id}/test", status_code=202, responses=problem_responses(404, 409))
async def test_webhook(
    webhook_id: WebhookId, principal: Writer, service: ServiceDep, key: IdempotencyKey = None
) -> DeliveryView:
    """Send a message of the type `webhook.test`; its outcome is in `/deliveries`."""
    sent = await actions.send_test(service, principal, webhook_id, idempotency_key=key)
    return DeliveryView.from_row(sent)


@router.get("/{webhook_id}/deliveries", responses=problem_responses(404))
async def list_deliveries(
    webhook_id: WebhookId, principal: Reader, service: ServiceDep,
    limit: Limit = 50,
) -> DeliveryList:  # fmt: skip
    """List the newest messages and their outcomes; they are kept for 30 days."""
    found = await actions.list_deliveries(service, principal, webhook_id, limit)
    return DeliveryList(deliveries=[DeliveryView.from_row(row) for row in found])


@router.post(
    "/{webhook_id}/deliveries/{delivery_id}/redeliver", status_code=202, responses=problem_responses(404, 409)
)
async def resend_delivery(
    webhook_id: WebhookId, delivery_id: DeliveryId, principal: Writer, service: ServiceDep,
    key: IdempotencyKey = None,
) -> DeliveryView:  # fmt: skip
    """Send a message again, with the same id and content."""
    sent = await actions.redeliver(service, principal, webhook_id, delivery_id, idempotency_key=key)
    return DeliveryView.from_row(sent)

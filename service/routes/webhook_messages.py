"""Messages that the service sends to webhooks, for the OpenAPI document; nothing here answers a request."""

from typing import Annotated, Any, get_args

from fastapi import APIRouter, Header

from octasplat.service.schemas.webhooks import JobEventMessage, TestMessage
from octasplat.workers.maintenance.webhooks.rows import EventName

router = APIRouter(tags=["webhooks"])

MessageId = Annotated[
    str, Header(alias="webhook-id", description="The same at every try, so that repetitions are known.")
]
Timestamp = Annotated[
    int, Header(alias="webhook-timestamp", description="When it was sent, in Unix seconds.")
]
Signature = Annotated[
    str, Header(alias="webhook-signature", description="`v1,` and the signature of id, time and body.")
]
_ANSWERS: dict[int | str, dict[str, Any]] = {
    200: {"description": "Any 2xx: it has arrived."},
    410: {"description": "Send no more: the webhook is disabled."},
    "default": {"description": "Anything else: it is sent again, for a day."},
}


def receive_job_event(
    message: JobEventMessage,
    webhook_id: MessageId,
    webhook_timestamp: Timestamp,
    webhook_signature: Signature,
) -> None:
    """Hear that a job has changed its state, if the webhook asks for this event.

    The headers are those of https://www.standardwebhooks.com.
    """


for _event in get_args(EventName):
    _name = f"on{''.join(word.title() for word in _event.split('.'))}"
    # What FastAPI calls the path of such a route is the name of the message in the document.
    router.add_api_route(_event, receive_job_event, methods=["POST"], operation_id=_name, responses=_ANSWERS)


@router.post("webhook.test", operation_id="onWebhookTest", responses=_ANSWERS)
def receive_test(
    message: TestMessage, webhook_id: MessageId, webhook_timestamp: Timestamp, webhook_signature: Signature
) -> None:
    """Hear the message that was asked for to try the webhook."""

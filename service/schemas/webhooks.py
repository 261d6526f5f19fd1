"""Bodies of the routes on webhooks and their messages."""

import uuid
from datetime import datetime
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, JsonValue

from octasplat.service.schemas.base import EXAMPLE_ID, EXAMPLE_TIME, RequestBody
from octasplat.workers.db.rows import JobState
from octasplat.workers.maintenance.webhooks.addresses import MAX_URL
from octasplat.workers.maintenance.webhooks.rows import (
    TERMINAL_EVENTS,
    Delivery,
    DeliveryState,
    Endpoint,
    EventName,
)
from octasplat.workers.maintenance.webhooks.signing import check_secret

_SECRET = "whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSwMfKQ9r8GKYo="  # noqa: S105 - an example

Secret = Annotated[str, Field(max_length=200), AfterValidator(check_secret)]
Url = Annotated[str, Field(min_length=1, max_length=MAX_URL)]
Events = Annotated[list[EventName], Field(min_length=1, max_length=6)]


class JobWebhook(RequestBody):
    """Webhook for the events of one job."""

    model_config = ConfigDict(extra="forbid")

    url: Url
    secret: Secret = Field(
        description="`whsec_` and the base64 of 24 to 64 random bytes; signs the messages."
    )
    events: Events = Field(list(TERMINAL_EVENTS))


class NewWebhook(RequestBody):
    """Webhook to create."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={"examples": [{"url": "https://example.org/hook", "events": ["job.succeeded"]}]},
    )

    url: Url = Field(description="https, port 443 or 8443, reachable from everywhere.")
    events: Events = Field(list(TERMINAL_EVENTS), description="By default the ends of jobs.")
    job_id: uuid.UUID | None = Field(None, description="Tell of this job only.")
    secret: Secret | None = Field(None, description="By default one is made.")


class WebhookChange(RequestBody):
    """Changes of a webhook."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": [{"enabled": True}]})

    url: Url | None = Field(None, description="https, port 443 or 8443, reachable from everywhere.")
    events: Events | None = Field(None, description="What it is told of.")
    secret: Secret | None = Field(None, description="Signs the messages from now on.")
    enabled: bool | None = Field(None, description="Whether messages are sent.")


class WebhookView(BaseModel):
    """A webhook: the URL that receives events of jobs."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "id": EXAMPLE_ID,
                    "url": "https://example.org/hook",
                    "events": ["job.succeeded", "job.failed", "job.canceled"],
                    "job_id": None,
                    "enabled": True,
                    "disabled_reason": None,
                    "created_at": EXAMPLE_TIME,
                }
            ]
        }
    )

    id: uuid.UUID
    url: str
    events: list[str]
    job_id: uuid.UUID | None
    enabled: bool
    disabled_reason: str | None
    created_at: datetime

    @classmethod
    def from_row(cls, row: Endpoint) -> "WebhookView":
        """Return the view of a database row."""
        return cls.model_validate(row, from_attributes=True)


class MadeWebhook(WebhookView):
    """A new webhook; its secret is shown this once."""

    secret: str


class WebhookPage(BaseModel):
    """A page of the list of webhooks."""

    webhooks: list[WebhookView]
    next: str | None


_MESSAGE_EXAMPLE: dict[str, JsonValue] = {
    "type": "job.succeeded",
    "timestamp": EXAMPLE_TIME,
    "data": {
        "job_id": EXAMPLE_ID,
        "kind": "reconstruct",
        "label": None,
        "state": "succeeded",
        "attempt": 1,
    },
}


class DeliveryView(BaseModel):
    """A message and its outcome; the body of the response is not shown."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "id": EXAMPLE_ID,
                    "message_id": "msg_01a1fcac4f59764b97e61be68502c58f",
                    "kind": "job.succeeded",
                    "payload": _MESSAGE_EXAMPLE,
                    "state": "delivered",
                    "tries": 1,
                    "due_at": None,
                    "status": 200,
                    "error": None,
                    "created_at": EXAMPLE_TIME,
                    "tried_at": EXAMPLE_TIME,
                }
            ]
        }
    )

    id: uuid.UUID
    message_id: str = Field(description="The header webhook-id; the same at every try.")
    kind: str
    payload: dict[str, Any]
    state: DeliveryState
    tries: int
    due_at: datetime | None = Field(description="When it is sent next.")
    status: int | None = Field(description="HTTP status of the last try.")
    error: str | None
    created_at: datetime
    tried_at: datetime | None

    @classmethod
    def from_row(cls, row: Delivery) -> "DeliveryView":
        """Return the view of a database row."""
        values = {name: getattr(row, name) for name in cls.model_fields if name != "message_id"}
        values["due_at"] = row.due_at if row.state == "pending" else None
        return cls(**values, message_id=f"msg_{row.id.hex}")


class DeliveryList(BaseModel):
    """The newest messages of a webhook."""

    deliveries: list[DeliveryView]


class JobEventData(BaseModel):
    """The job that a message is about."""

    job_id: uuid.UUID
    kind: str = Field(description="Of the job, such as reconstruct.")
    label: str | None
    state: JobState
    attempt: int


class JobEventMessage(BaseModel):
    """A message on a change of a job's state."""

    model_config = ConfigDict(json_schema_extra={"examples": [_MESSAGE_EXAMPLE]})

    type: EventName
    timestamp: datetime
    data: JobEventData


class TestMessageData(BaseModel):
    """The webhook that a test is about."""

    webhook_id: uuid.UUID


class TestMessage(BaseModel):
    """A message that was asked for by `POST /v1/webhooks/{webhook_id}/test`."""

    type: Literal["webhook.test"]
    timestamp: datetime
    data: TestMessageData

"""Parameters that several routes have."""

import uuid
from typing import Annotated

from fastapi import Header, Path

IdempotencyKey = Annotated[
    str | None,
    Header(
        alias="Idempotency-Key",
        min_length=1,
        max_length=255,
        pattern=r"^[\x21-\x7e]+$",
        description="A text of your choice; the same request sent again with it makes nothing new, and is "
        "answered 404 when what it made was deleted.",
    ),
]
IfMatch = Annotated[
    str | None,
    # However long conditions are: one that names no current ETag does not hold, as RFC 9110 says.
    Header(alias="If-Match", description="ETag that it must still have, else the answer is 412."),
]
IfNoneMatch = Annotated[
    str | None,
    Header(
        alias="If-None-Match",
        description="ETag that you have seen; as long as it is that, the answer is 304.",
    ),
]
Range = Annotated[
    str | None,
    # However long it is: one that has no sense is answered as RFC 9110 says.
    Header(alias="Range", description="A part of the content (RFC 9110), such as `bytes=1000-`."),
]
IfRange = Annotated[
    str | None,
    Header(alias="If-Range", description="ETag that must hold, else `Range` is ignored."),
]
DatasetId = Annotated[uuid.UUID, Path(description="Id of the dataset.")]
JobId = Annotated[uuid.UUID, Path(description="Id of the job.")]
TokenId = Annotated[uuid.UUID, Path(description="Id of the token, which is not its secret.")]
WebhookId = Annotated[uuid.UUID, Path(description="Id of the webhook.")]
DeliveryId = Annotated[uuid.UUID, Path(description="Id of the message.")]

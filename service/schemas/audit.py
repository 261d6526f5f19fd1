"""Bodies of the audit log's route."""

import uuid
from datetime import datetime

from pydantic import BaseModel, Field


class AuditView(BaseModel):
    """An entry of the audit log."""

    id: int
    at: datetime
    owner: str | None = Field(description="Who asked; null is nobody known.")
    token_id: uuid.UUID | None
    session_id: uuid.UUID | None = Field(description="Session of a browser.")
    address: str = Field(description="Where the request came from.")
    action: str = Field(description="Method and path, or the command of the command line.")
    target: str | None = Field(description="What was made.")
    status: int = Field(description="Status of the answer; 0 for commands.")


class AuditPage(BaseModel):
    """A page of the audit log."""

    entries: list[AuditView]
    next: str | None = Field(description="Cursor of the next part.")

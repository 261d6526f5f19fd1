"""Bodies of the routes on API tokens."""

import uuid
from datetime import datetime
from typing import Literal

from pydantic import AwareDatetime, BaseModel, ConfigDict, Field

from octasplat.service.schemas.base import RequestBody
from octasplat.workers.db.rows import Token

TokenScope = Literal["read", "write", "admin", "metrics"]


class NewToken(RequestBody):
    """Token to create."""

    name: str = Field(max_length=100, description="What to call it.")
    owner: str = Field(pattern=r"^[A-Za-z0-9._@-]{1,100}$", description="Whose things it shows.")
    scopes: list[TokenScope] = Field(
        min_length=1,
        description="`write` includes `read`, and `admin` everything. `metrics` is for monitoring: GET "
        "/metrics alone.",
    )
    hours: float | None = Field(
        None, gt=0, le=1_000_000, description="For how long it is valid; by default as the service is set."
    )


class TokenChange(RequestBody):
    """Changes of a token, which can become narrower but not wider."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": [{"scopes": ["read"]}]})

    name: str | None = Field(None, max_length=100, description="What to call it.")
    scopes: list[TokenScope] | None = Field(
        None, min_length=1, description="What it may still do; none but what it may do already."
    )
    expires_at: AwareDatetime | None = Field(
        None, description="When it ends, with a time zone; not later than it does already."
    )


class TokenView(BaseModel):
    """A token, without its secret."""

    id: uuid.UUID
    name: str
    owner: str = Field(description="Whose things it shows.")
    scopes: list[str] = Field(description="What it may do.")
    created_at: datetime
    expires_at: datetime | None = Field(description="When it ends by itself.")
    revoked_at: datetime | None = Field(description="When it was revoked.")

    @classmethod
    def from_row(cls, row: Token) -> "TokenView":
        """Return the view of a database row."""
        return cls.model_validate(row, from_attributes=True)


class MadeToken(TokenView):
    """A new token; its secret is shown this once."""

    token: str


class TokenList(BaseModel):
    """All tokens that the caller may see."""

    tokens: list[TokenView]


class SignInLink(BaseModel):
    """A sign-in link for a browser; until it is used it is as powerful as a token."""

    path: str = Field(description="Below the address of the service.")

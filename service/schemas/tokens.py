"""Bodies of the routes on API tokens."""

import uuid
from datetime import datetime
from typing import Literal

from pydantic import BaseModel, Field

from octasplat.service.schemas.base import RequestBody
from octasplat.workers.db.rows import Token


class NewToken(RequestBody):
    """Token to create."""

    name: str = Field(max_length=100)
    owner: str = Field(pattern=r"^[A-Za-z0-9._@-]{1,100}$", description="Whose things it shows.")
    scopes: list[Literal["read", "write", "admin"]] = Field(min_length=1)
    hours: float | None = Field(
        None, gt=0, le=1_000_000, description="For how long it is valid; by default as the service is set."
    )


class TokenView(BaseModel):
    """A token, without its secret."""

    id: uuid.UUID
    name: str
    owner: str
    scopes: list[str]
    created_at: datetime
    expires_at: datetime | None
    revoked_at: datetime | None

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

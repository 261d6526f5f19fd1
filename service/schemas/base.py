"""Base classes of all bodies."""

from pydantic import BaseModel, ConfigDict

EXAMPLE_ID = "01a1fcac-4f59-764b-97e6-1be68502c58f"
EXAMPLE_TIME = "2026-11-21T05:55:13.369313Z"


class RequestBody(BaseModel):
    """A request body: unknown names are refused."""

    model_config = ConfigDict(extra="forbid")

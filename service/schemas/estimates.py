"""Bodies of the estimate's route."""

import uuid
from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from octasplat.engine.operations.cost_model import Estimate
from octasplat.service.schemas.base import RequestBody


class PhotographSizes(BaseModel):
    """Photographs of one size."""

    model_config = ConfigDict(extra="forbid")

    width_px: int = Field(ge=1, le=65_536)
    height_px: int = Field(ge=1, le=65_536)
    count: int = Field(1, ge=1, le=1_000_000)


class NewEstimate(RequestBody):
    """Job to estimate; for photographs that are not uploaded yet their sizes suffice."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "examples": [
                {
                    "options": {"preset": "fast"},
                    "photographs": [{"width_px": 1920, "height_px": 1080, "count": 50}],
                }
            ]
        },
    )

    kind: str = Field("reconstruct", max_length=40)
    dataset_id: uuid.UUID | None = None
    source_id: uuid.UUID | None = None
    photographs: list[PhotographSizes] = Field(default_factory=list, max_length=1000)
    options: dict[str, Any] = Field(default_factory=dict)
    queue: str = Field("cpu", pattern="^[a-z][a-z0-9_-]{0,40}$")


class EstimateView(BaseModel):
    """Estimated cost of a job, within a factor of two; null where it is unknown."""

    estimate: Estimate | None

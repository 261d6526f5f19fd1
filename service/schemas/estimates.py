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

    kind: str = Field("reconstruct", max_length=40, description="One of GET /v1/options.")
    dataset_id: uuid.UUID | None = Field(None, description="The dataset whose photographs count.")
    source_id: uuid.UUID | None = Field(
        None, description="A job on whose results it works, and whose photographs count without `dataset_id`."
    )
    photographs: list[PhotographSizes] = Field(
        default_factory=list, max_length=1000, description="Sizes of photographs that are not sent yet."
    )
    options: dict[str, Any] = Field(default_factory=dict, description="See GET /v1/options/{kind}.")
    queue: str = Field(
        "cpu", pattern="^[a-z][a-z0-9_-]{0,40}$", description="Queue whose workers' cores are reckoned with."
    )


class EstimateView(BaseModel):
    """Estimated cost of a job, within a factor of two; null where it is unknown."""

    estimate: Estimate | None

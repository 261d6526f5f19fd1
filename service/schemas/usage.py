"""Body of the route on what an owner takes."""

from pydantic import BaseModel, ConfigDict, Field


class UsedView(BaseModel):
    """Use of something that has a limit."""

    used: int
    limit: int | None = Field(description="How much there may be; null is any number.")


class UsageView(BaseModel):
    """Use and limits of an owner; all tokens of an owner share it."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "owner": "anna",
                    "bytes": {"used": 734003200, "limit": 20000000000},
                    "datasets": {"used": 3, "limit": None},
                    "jobs": {"used": 1, "limit": 10},
                    "job_seconds": 5230.5,
                }
            ]
        }
    )

    owner: str
    bytes: UsedView = Field(
        description="Contents stored: files of datasets, results, checkpoints; the same content counts once."
    )
    datasets: UsedView = Field(description="Datasets.")
    jobs: UsedView = Field(description="Jobs that are queued or running.")
    job_seconds: float = Field(
        description="How long workers took for the jobs that are there, by the newest attempt of each."
    )

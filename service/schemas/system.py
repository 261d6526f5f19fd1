"""Bodies of the routes on the service: job kinds, formats, queues, health."""

from datetime import datetime
from typing import Any, Literal

from pydantic import BaseModel, Field

from octasplat.service.schemas.base import RequestBody


class KindView(BaseModel):
    """A kind of job."""

    name: str
    title: str
    needs: Literal["dataset", "result", "files"] = Field(
        description="What it works on: photographs, the results of a job, or nothing but the files that its "
        "options name."
    )
    options: dict[str, Any] = Field(description="JSON Schema of its options.")
    ceilings: dict[str, int] = Field(description="What options may ask for at most here, by their path.")


class KindList(BaseModel):
    """The kinds of jobs."""

    kinds: list[KindView]


class FormatView(BaseModel):
    """A format to export to."""

    name: str
    patterns: list[str]
    description: str


class InfoView(BaseModel):
    """Name, version and features of the service."""

    version: str
    kinds: list[str]
    formats: list[FormatView]
    max_upload_bytes: int
    max_archive_bytes: int
    owner: str
    scopes: list[str]
    isolation: dict[str, str | None] = Field(
        description="What keeps programs that read what others sent from the rest of this machine, by "
        "subject; null where its kernel takes no part. Workers say the same of theirs in their facts."
    )


class QueueView(BaseModel):
    """A queue and its workers."""

    queue: str = Field(description="Its name.")
    waiting: int = Field(description="Your jobs that wait; everybody's for administrators.")
    oldest_seconds: float | None = Field(description="How long the first of them has waited.")
    running: int = Field(description="Your jobs that run; everybody's for administrators.")
    slots: int = Field(description="Jobs that the live workers of the queue do at once.")
    paused: bool = Field(False, description="Whether it hands out no jobs; those that run go on.")


class WorkerView(BaseModel):
    """A live worker."""

    name: str
    queues: list[str]
    slots: int
    facts: dict[str, Any]
    running: int = Field(0, description="Jobs that it has.")
    drained: bool = Field(False, description="Whether it finishes what it has and takes nothing new.")
    started_at: datetime
    seen_at: datetime


class QueueList(BaseModel):
    """The queues and the workers."""

    queues: list[QueueView]
    workers: list[WorkerView] = Field(description="Shown to administrators; empty for others.")


class QueueChange(RequestBody):
    """Change of a queue."""

    paused: bool = Field(description="Whether it is to hand out no jobs.")


class WorkerChange(RequestBody):
    """Change of a worker."""

    drained: bool = Field(description="Whether it is to finish what it has and take nothing new.")


class Health(BaseModel):
    """Health of the service."""

    status: Literal["ok", "unready"]
    checks: dict[str, str] = {}

"""What the API takes and gives, with examples."""

import uuid
from collections.abc import Sequence
from datetime import datetime
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from service.webhook_views import JobWebhook
from workers.records.rows import (
    Artifact,
    Dataset,
    DatasetFile,
    DatasetState,
    Job,
    JobEvent,
    JobState,
    LogLine,
)
from workers.work.kinds.estimates import Estimate

_ID = "01a1fcac-4f59-764b-97e6-1be68502c58f"
_TIME = "2026-11-21T05:55:13.369313Z"


class Strict(BaseModel):
    """A request body: unknown names are refused."""

    model_config = ConfigDict(extra="forbid")


class NewDataset(Strict):
    """A dataset to make."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": [{"name": "fox"}]})

    name: str = Field("", max_length=200, description="What you call it.")


class DatasetChange(Strict):
    """What may be changed of a dataset."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": [{"pinned": True}]})

    name: str | None = Field(None, max_length=200)
    pinned: bool | None = Field(None, description="Keep it whatever its age.")


class DatasetView(BaseModel):
    """A dataset."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "id": _ID,
                    "name": "fox",
                    "state": "committed",
                    "has_poses": True,
                    "photographs": 50,
                    "facts": {"points": 8712, "camera_models": ["OPENCV"]},
                    "pinned": False,
                    "created_at": _TIME,
                    "committed_at": _TIME,
                    "expires_at": None,
                }
            ]
        }
    )

    id: uuid.UUID
    name: str
    state: DatasetState = Field(description="`open` takes files, `committed` never changes again.")
    has_poses: bool = Field(description="Whether it holds a COLMAP model; if not, ask for `poses: auto`.")
    photographs: int
    facts: dict[str, Any] = Field(description="What the check at commit found out.")
    pinned: bool
    created_at: datetime
    committed_at: datetime | None
    expires_at: datetime | None

    @classmethod
    def of(cls, row: Dataset) -> "DatasetView":
        """From its row."""
        return cls.model_validate(row, from_attributes=True)


class DatasetPage(BaseModel):
    """A part of the list of datasets."""

    datasets: list[DatasetView]
    next: str | None = Field(description="Cursor of the next part.")


class FileView(BaseModel):
    """A file that has arrived."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "path": "images/0001.jpg",
                    "sha256": "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855",
                    "size_bytes": 123456,
                    "facts": {"kind": "JPEG", "width_px": 1920, "height_px": 1080},
                    "uploaded_at": _TIME,
                }
            ]
        }
    )

    path: str
    sha256: str
    size_bytes: int
    facts: dict[str, Any]
    uploaded_at: datetime

    @classmethod
    def of(cls, row: DatasetFile) -> "FileView":
        """From its row."""
        return cls.model_validate(row, from_attributes=True)


class FilePage(BaseModel):
    """A part of the list of files; comparing it with your own files is how an upload goes on."""

    files: list[FileView]
    next: str | None


class ArchiveView(BaseModel):
    """What came out of an archive."""

    files: list[FileView]
    left_out: list[str] = Field(description="Files that are no part of a scene.")


class NewJob(Strict):
    """A job to accept."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "examples": [
                {"dataset_id": _ID, "options": {"preset": "fast"}},
                {"kind": "export", "source_id": _ID, "options": {"files": ["scene.glb"]}},
            ]
        },
    )

    kind: str = Field("reconstruct", max_length=40, description="One of GET /v1/options.")
    dataset_id: uuid.UUID | None = Field(None, description="A committed dataset, for kinds that need one.")
    source_id: uuid.UUID | None = Field(None, description="A job that succeeded, for kinds that work on one.")
    options: dict[str, Any] = Field(default_factory=dict, description="See GET /v1/options/{kind}.")
    label: str | None = Field(None, max_length=200)
    queue: str = Field("cpu", pattern="^[a-z][a-z0-9_-]{0,40}$", description="Workers that take this queue.")
    priority: int = Field(
        0, ge=-100, le=100, description="Higher goes first; high ones are for administrators."
    )
    webhook: JobWebhook | None = Field(None, description="Be told of this job; see POST /v1/webhooks.")


class JobChange(Strict):
    """What may be changed of a job."""

    label: str | None = Field(None, max_length=200)
    pinned: bool | None = Field(None, description="Keep it whatever its age.")


class RetryRequest(Strict):
    """Where a retried job begins, and what is to be different."""

    model_config = ConfigDict(
        extra="forbid",
        populate_by_name=True,
        json_schema_extra={
            "examples": [{"from": "checkpoint"}, {"options": {"exports": ["mesh.glb"]}}],
        },
    )

    start: Literal["checkpoint", "start"] = Field("checkpoint", alias="from")
    options: dict[str, Any] = Field(
        default_factory=dict,
        description="Settings in the place of the job's own. What changes the training needs `from: start`; "
        "a reconstruction goes on with other `exports`.",
    )


class PhotographSizes(Strict):
    """Photographs of one size."""

    width_px: int = Field(ge=1, le=65_536)
    height_px: int = Field(ge=1, le=65_536)
    count: int = Field(1, ge=1, le=1_000_000)


class NewEstimate(Strict):
    """A job that might be asked for; of photographs that are not here yet their sizes are enough."""

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
    """What a job will take, within a factor of two; null where nobody knows."""

    estimate: Estimate | None


class JobError(BaseModel):
    """Why a job failed."""

    model_config = ConfigDict(extra="allow")

    type: str
    message: str


class CheckpointView(BaseModel):
    """The newest point from which the job can go on."""

    stage: str
    step: int


class JobView(BaseModel):
    """A job."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "id": _ID,
                    "kind": "reconstruct",
                    "dataset_id": _ID,
                    "source_id": None,
                    "label": "fox, first try",
                    "options": {"preset": "fast"},
                    "queue": "cpu",
                    "priority": 0,
                    "state": "running",
                    "attempt": 1,
                    "rescues": 0,
                    "stage": "train",
                    "stages": ["load", "train", "evaluate", "export"],
                    "step": 400,
                    "total_steps": 1500,
                    "seconds_left": 41.2,
                    "psnr": 24.6,
                    "training_psnr": 25.1,
                    "worker": "host-4711",
                    "queue_position": None,
                    "estimate": {
                        "cpu_seconds": 88.0,
                        "seconds": 50.9,
                        "cores": 2,
                        "memory_bytes": 930000000,
                        "finds_poses": False,
                        "text": "about 51 s on 2 cores and 0.9 GB of memory",
                    },
                    "notes": [],
                    "error": None,
                    "checkpoint": {"stage": "train", "step": 250},
                    "preview": None,
                    "pinned": False,
                    "created_at": _TIME,
                    "queued_at": _TIME,
                    "started_at": _TIME,
                    "finished_at": None,
                    "expires_at": None,
                }
            ]
        }
    )

    id: uuid.UUID
    kind: str
    dataset_id: uuid.UUID | None
    source_id: uuid.UUID | None
    label: str | None
    options: dict[str, Any] = Field(description="Every setting, resolved when the job was accepted.")
    queue: str
    priority: int
    state: JobState
    attempt: int = Field(description="Counts starts.")
    rescues: int = Field(description="How often its worker was lost without a new checkpoint.")
    stage: str | None
    stages: list[str]
    step: int | None
    total_steps: int | None
    seconds_left: float | None = Field(description="Of the stage.")
    psnr: float | None = Field(
        description="Of the held-out views, dB: of some of their rays while it trains, the mean over all of "
        "them once they are measured."
    )
    training_psnr: float | None = Field(
        None, description="Running value over the rays that are trained on, dB; higher than `psnr` as a rule."
    )
    worker: str | None
    queue_position: int | None = Field(description="Jobs that go before it.")
    estimate: Estimate | None = Field(description="What it was reckoned to take when it was accepted.")
    notes: list[str] = Field(
        description="What its owner should know while it waits, e.g. for want of a worker."
    )
    error: JobError | None
    checkpoint: CheckpointView | None
    preview: dict[str, Any] | None = Field(description="`step` and `view` of GET /v1/jobs/{id}/preview.")
    pinned: bool
    created_at: datetime
    queued_at: datetime
    started_at: datetime | None
    finished_at: datetime | None
    expires_at: datetime | None

    @classmethod
    def of(
        cls, row: Job, stages: list[str], queue_position: int | None = None, notes: Sequence[str] = ()
    ) -> "JobView":
        """From its row."""
        names = {name for name in cls.model_fields if name not in ("stages", "queue_position", "notes")}
        values = {name: getattr(row, name) for name in names}
        return cls(**values, stages=stages, queue_position=queue_position, notes=list(notes))


class JobPage(BaseModel):
    """A part of the list of jobs, the newest first."""

    jobs: list[JobView]
    next: str | None


class LogLineView(BaseModel):
    """A line of a job's log."""

    id: int
    attempt: int
    text: str
    at: datetime

    @classmethod
    def of(cls, row: LogLine) -> "LogLineView":
        """From its row."""
        return cls.model_validate(row, from_attributes=True)


class LogPage(BaseModel):
    """A part of a job's log; ask again with `after` set to `next`."""

    lines: list[LogLineView]
    next: int


class EventView(BaseModel):
    """Something that happened to a job."""

    id: int
    attempt: int
    kind: str
    data: dict[str, Any]
    at: datetime

    @classmethod
    def of(cls, row: JobEvent) -> "EventView":
        """From its row."""
        return cls.model_validate(row, from_attributes=True)


class EventPage(BaseModel):
    """A part of what happened; ask again with `after` set to `next`."""

    events: list[EventView]
    next: int


class ArtifactView(BaseModel):
    """A result of a job."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "name": "mesh.glb",
                    "sha256": "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855",
                    "size_bytes": 7340032,
                    "media_type": "model/gltf-binary",
                }
            ]
        }
    )

    name: str
    sha256: str
    size_bytes: int
    media_type: str

    @classmethod
    def of(cls, row: Artifact) -> "ArtifactView":
        """From its row."""
        return cls.model_validate(row, from_attributes=True)


class ArtifactList(BaseModel):
    """The results of a job."""

    artifacts: list[ArtifactView]


class KindView(BaseModel):
    """A kind of job."""

    name: str
    title: str
    needs: Literal["dataset", "result"]
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
    """What this service is."""

    version: str
    kinds: list[str]
    formats: list[FormatView]
    max_upload_bytes: int
    max_archive_bytes: int
    needs_token: bool
    owner: str
    scopes: list[str]


class QueueView(BaseModel):
    """A queue and its workers."""

    queue: str
    waiting: int
    oldest_seconds: float | None
    running: int
    slots: int


class WorkerView(BaseModel):
    """A worker that lives."""

    name: str
    queues: list[str]
    slots: int
    facts: dict[str, Any]
    started_at: datetime
    seen_at: datetime


class QueueList(BaseModel):
    """The queues and the workers."""

    queues: list[QueueView]
    workers: list[WorkerView]


class NewToken(Strict):
    """A token to make."""

    name: str = Field(max_length=100)
    owner: str = Field(pattern=r"^[A-Za-z0-9._@-]{1,100}$", description="Whose things it shows.")
    scopes: list[Literal["read", "write", "admin"]] = Field(min_length=1)


class TokenView(BaseModel):
    """A token, without its secret."""

    id: uuid.UUID
    name: str
    owner: str
    scopes: list[str]
    created_at: datetime
    expires_at: datetime | None
    revoked_at: datetime | None


class MadeToken(TokenView):
    """A new token; its secret is shown this once."""

    token: str


class TokenList(BaseModel):
    """All tokens."""

    tokens: list[TokenView]


class Health(BaseModel):
    """How the service is."""

    status: Literal["ok", "unready"]
    checks: dict[str, str] = {}

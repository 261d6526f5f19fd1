"""Bodies of the routes on jobs."""

import uuid
from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field

from octasplat.engine.operations.cost_model import Estimate
from octasplat.service.schemas.base import EXAMPLE_ID, EXAMPLE_TIME, RequestBody
from octasplat.service.schemas.webhooks import JobWebhook
from octasplat.service.whole_progress import whole_progress
from octasplat.workers.db.rows import Job, JobState


class NewJob(RequestBody):
    """Job to create."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "examples": [
                {"dataset_id": EXAMPLE_ID, "options": {"preset": "fast"}},
                {"source_id": EXAMPLE_ID, "options": {"preset": "high"}},
                {"kind": "export", "source_id": EXAMPLE_ID, "options": {"files": ["scene.glb"]}},
                {
                    "kind": "render",
                    "source_id": EXAMPLE_ID,
                    "files_id": EXAMPLE_ID,
                    "options": {
                        "frames": 60,
                        "stage": {
                            "meshes": [{"file": "chair.glb", "material": {"kind": "mirror"}}],
                            "lights": [{"kind": "directional", "direction": [0, 1, 0], "irradiance": 2}],
                        },
                    },
                },
            ]
        },
    )

    kind: str = Field("reconstruct", max_length=40, description="One of GET /v1/options.")
    dataset_id: uuid.UUID | None = Field(
        None,
        description="A committed dataset, for kinds that need one; `evaluate` measures its photographs "
        "in the place of those that the job in `source_id` held out.",
    )
    source_id: uuid.UUID | None = Field(
        None,
        description="A job that succeeded, for kinds that work on one; `reconstruct` begins with the "
        "Gaussians of a reconstruction, finished or stopped, and without `dataset_id` takes its photographs.",
    )
    files_id: uuid.UUID | None = Field(
        None,
        description="A committed dataset that holds the files which the options name; kinds that work on "
        "files need nothing else.",
    )
    options: dict[str, Any] = Field(default_factory=dict, description="See GET /v1/options/{kind}.")
    label: str | None = Field(None, max_length=200, description="What you call it.")
    queue: str = Field("cpu", pattern="^[a-z][a-z0-9_-]{0,40}$", description="Workers that take this queue.")
    priority: int = Field(
        0,
        ge=-100,
        le=100,
        description="Among your jobs, higher goes first; high ones are for administrators.",
    )
    webhook: JobWebhook | None = Field(None, description="Be told of this job; see POST /v1/webhooks.")


Coordinate = Annotated[float, Field(allow_inf_nan=False)]
MAX_VIEW_NOTES = 100


class ViewNote(BaseModel):
    """What somebody wrote at a place of the 3D view."""

    model_config = ConfigDict(extra="forbid")

    text: str = Field(min_length=1, max_length=500)
    position: tuple[Coordinate, Coordinate, Coordinate] = Field(description="The place, in scene.ply.")
    camera: tuple[Coordinate, Coordinate, Coordinate, Coordinate, Coordinate, Coordinate] = Field(
        description="Where the camera was, and what it looked at."
    )


class JobChange(RequestBody):
    """Changes of a job."""

    label: str | None = Field(None, max_length=200, description="What to call it.")
    pinned: bool | None = Field(None, description="Keep it whatever its age.")
    view_notes: list[ViewNote] | None = Field(
        None, max_length=MAX_VIEW_NOTES, description="All notes in the 3D view, in place of those there are."
    )


class RetryRequest(RequestBody):
    """Retry of a job: the attempt's starting point and changed options."""

    model_config = ConfigDict(
        extra="forbid",
        populate_by_name=True,
        json_schema_extra={
            "examples": [{"from": "checkpoint"}, {"options": {"exports": ["viewer.glb"]}}],
        },
    )

    start: Literal["checkpoint", "start"] = Field(
        "checkpoint",
        alias="from",
        description="Where it goes on: at its newest checkpoint, or from the start.",
    )
    options: dict[str, Any] = Field(
        default_factory=dict,
        description="Settings in the place of the job's own. What changes the training needs `from: start`; "
        "a reconstruction goes on with other `exports`.",
    )


class JobError(BaseModel):
    """Error with which a job failed."""

    model_config = ConfigDict(extra="allow")

    type: str
    message: str


class CheckpointView(BaseModel):
    """The newest checkpoint from which the job can resume."""

    stage: str
    step: int


class JobSummary(BaseModel):
    """A job as lists have it, without its options."""

    id: uuid.UUID
    kind: str
    dataset_id: uuid.UUID | None
    source_id: uuid.UUID | None
    files_id: uuid.UUID | None = None
    label: str | None
    resolved_by: str | None = Field(description="Version of the worker that resolved the options.")
    queue: str
    priority: int
    state: JobState
    attempt: int = Field(description="Counts starts; merging blocks belongs to the start that planned them.")
    rescues: int = Field(description="How often its worker was lost without a new checkpoint.")
    stage: str | None
    stages: list[str]
    step: int | None
    total_steps: int | None
    seconds_left: float | None = Field(description="Of the stage.")
    progress: float | None = Field(None, description="Share of the whole job that is done, 0 to 1.")
    total_seconds_left: float | None = Field(None, description="Of the whole job, as far as that is known.")
    psnr: float | None = Field(
        description="Of the held-out views, dB: of some of their rays while it trains, the mean over all of "
        "them once they are measured."
    )
    training_psnr: float | None = Field(
        None, description="Running value over the rays that are trained on, dB; higher than `psnr` as a rule."
    )
    worker: str | None = Field(description="Which has it; shown to administrators, null for others.")
    queue_position: int | None = Field(description="Jobs that go before it.")
    estimate: Estimate | None = Field(description="What it was reckoned to take when it was accepted.")
    notes: list[str] = Field(
        description="What its owner should know: why it waits, and why it was begun anew, if it was."
    )
    error: JobError | None
    checkpoint: CheckpointView | None
    preview: dict[str, Any] | None = Field(
        description="`step` and `view` of GET /v1/jobs/{id}/preview; no view: a map of its blocks."
    )
    pinned: bool
    created_at: datetime
    queued_at: datetime
    started_at: datetime | None = Field(
        description="When the present attempt began; of a job in blocks the one that planned them."
    )
    finished_at: datetime | None
    expires_at: datetime | None

    @classmethod
    def from_row(
        cls,
        row: Job,
        stages: list[str],
        queue_position: int | None = None,
        notes: Sequence[str] = (),
        *,
        shows_worker: bool = False,
    ) -> Self:
        """Return the view of a database row."""
        whole = whole_progress(row, stages)
        made = ("stages", "queue_position", "notes", "progress", "total_seconds_left", "blocks")
        names = {name for name in cls.model_fields if name not in made}
        row = row if shows_worker else replace(row, worker=None)
        values = {name: getattr(row, name) for name in names}
        values["attempt"] = row.count_starts(row.attempt)
        values["started_at"] = row.begun_at or row.started_at
        if row.preview is not None:
            values["preview"] = {name: row.preview.get(name) for name in ("sha256", "step", "view")}
        return cls(
            **values,
            stages=stages,
            queue_position=queue_position,
            notes=list(notes),
            progress=whole.share,
            total_seconds_left=whole.seconds_left,
        )


class BlockView(BaseModel):
    """A block of a job that trains its scene in blocks."""

    number: int = Field(description="From 1.")
    name: str
    id: uuid.UUID = Field(description="Of the job that trains it, which is in no list; its log tells more.")
    state: JobState
    attempt: int
    step: int | None
    total_steps: int | None
    seconds_left: float | None
    error: JobError | None
    map_position: tuple[float, float] | None = Field(
        None,
        description="Its middle on the preview, a map while blocks are trained: 0 to 1 from left and top.",
    )

    @classmethod
    def from_row(cls, row: Job, root: Job) -> Self:
        """Return the view of the row of a block's job.

        Args:
            row: of the block.
            root: the whole.
        """
        number = int(row.options["number"])
        names = ["id", "state", "attempt", "error"]
        steps = ("step", "total_steps", "seconds_left")
        if row.stage == "train":  # else they would be photographs that it reads
            names += steps
        position = ((root.preview or {}).get("block_positions") or {}).get(str(number))
        return cls(
            number=number,
            name=f"block {number}",
            map_position=position,
            **{**dict.fromkeys(steps), **{name: getattr(row, name) for name in names}},
        )


class JobView(JobSummary):
    """A job."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "id": EXAMPLE_ID,
                    "kind": "reconstruct",
                    "dataset_id": EXAMPLE_ID,
                    "source_id": None,
                    "files_id": None,
                    "label": "fox, first try",
                    "options": {"preset": "fast"},
                    "requested": {"preset": "fast"},
                    "resolved_by": "0.1.0",
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
                    "progress": 0.32,
                    "total_seconds_left": 58.0,
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
                    "created_at": EXAMPLE_TIME,
                    "queued_at": EXAMPLE_TIME,
                    "started_at": EXAMPLE_TIME,
                    "finished_at": None,
                    "expires_at": None,
                }
            ]
        }
    )

    view_notes: list[ViewNote] = Field([], description="What people wrote at places of the 3D view.")
    blocks: list[BlockView] = Field(
        [], description="Of a scene that is trained in blocks, once they are planned; a job each trains them."
    )
    options: dict[str, Any] = Field(
        description="Every setting: as resolved where the job ran, or as this version would resolve it."
    )
    requested: dict[str, Any] | None = Field(
        None,
        description="The options that were asked for, under their present names; null for jobs of versions "
        "that kept only the resolved ones.",
    )


class JobPage(BaseModel):
    """A page of the list of jobs, newest first."""

    jobs: list[JobSummary]
    next: str | None = Field(description="Cursor of the next part; null at the end.")

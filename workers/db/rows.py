"""Rows of the tables, as they are read."""

import uuid
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any, Literal

from octasplat.workers.db.errors import ConflictError

JobState = Literal["queued", "running", "canceling", "succeeded", "failed", "canceled"]
DatasetState = Literal["open", "checking", "committed"]
DatasetHolds = Literal["photographs", "files"]
STATES: tuple[JobState, ...] = ("queued", "running", "canceling", "succeeded", "failed", "canceled")
TERMINAL: frozenset[str] = frozenset({"succeeded", "failed", "canceled"})


@dataclass(frozen=True)
class Dataset:
    """A dataset: photographs and perhaps their poses, or other files that the options of jobs name.

    Attributes:
        id: UUIDv7.
        owner: whose it is.
        name: what its owner calls it.
        state: ``open`` takes files, ``checking`` is being validated, ``committed`` never changes again.
        has_poses: whether it holds a COLMAP model.
        photographs: number of images, once committed.
        facts: what the validation found out.
        pinned: never removed by retention.
        created_at: when it was made.
        committed_at: when it was found sound.
        used_at: when a job last asked for it.
        expires_at: when retention may remove it.
        version: counts changes.
        holds: photographs, or files that the options of jobs name.
    """

    id: uuid.UUID
    owner: str
    name: str
    state: DatasetState
    has_poses: bool
    photographs: int
    facts: dict[str, Any]
    pinned: bool
    created_at: datetime
    committed_at: datetime | None
    used_at: datetime
    expires_at: datetime | None
    version: int
    holds: DatasetHolds = "photographs"


@dataclass(frozen=True)
class DatasetFile:
    """A file of a dataset: its path there, its content's SHA-256 and size, and what its header says."""

    dataset_id: uuid.UUID
    path: str
    sha256: str
    size_bytes: int
    facts: dict[str, Any]
    uploaded_at: datetime


@dataclass(frozen=True)
class Job:
    """A job and its progress.

    Attributes:
        id: UUIDv7.
        owner: whose it is.
        kind: name in the table of job kinds.
        dataset_id: what it works on.
        source_id: the finished job whose results it works on, or a job that is over with which it begins.
        label: what its owner calls it.
        requested: the options as they were asked for, which the version that runs the job completes; None
            where a front end of the last version queued it.
        options: the options as the front end completed them, without what is default: for workers of the
            last version, and to tell what is to be expected.
        settings: every option, as the version ``resolved_by`` completed them where the job ran last.
        resolved_by: that version.
        queue: which workers may take it.
        priority: higher goes first.
        slip: its current queue entry in the queue; others are stale.
        state: where it is in its life; the last three never change again except by a retry.
        attempt: counts starts; every write of a worker carries the number it began with.
        fresh_after: attempts up to this one had other options or are to be forgotten: what they published
            without getting to say so is not taken for the result.
        rescues: how often its worker was lost since it was last accepted.
        stage: what is being done.
        step: steps of the stage that are done.
        total_steps: steps of the stage.
        seconds_left: estimated, of the stage.
        psnr: of the held-out views: on some of their rays while it trains, of all views once they are
            measured, dB.
        training_psnr: running value over the training's own rays, dB.
        worker: name of the worker that has it.
        error: why it failed: ``type``, ``message``.
        checkpoint: manifest of the newest one that is stored.
        preview: newest preview picture: ``sha256``, ``step`` and ``view``, the photograph it answers to; of a
            map of blocks no view, and their ``block_positions``.
        estimate: what it was reckoned to take when it was accepted, see
            :class:`octasplat.engine.operations.cost_model.Estimate`.
        files_id: dataset of the files that its options name.
        traceparent: W3C trace context of the request.
        pinned: never removed by retention.
        created_at: when it was accepted.
        queued_at: when it was last put into the queue.
        started_at: when its current attempt began.
        heartbeat_at: when its worker was last heard of.
        finished_at: when it came to its end.
        expires_at: when retention may remove it.
        version: counts changes but heartbeats.
        waits_for: why it is in the queue again, or was left there by a worker; None for a job that waits for
            its turn.
        view_notes: what people wrote at places of the 3D view: ``text``, ``position``, ``camera``.
        begun_anew: why an attempt did not go on from the checkpoint that there was.
        root_id: the job of which it does a part; such jobs are in no list, and no quota counts them.
        role: ``root`` of a job in blocks, ``block`` of its parts; None for any other.
        place: in the queue, among the jobs of its owner: the entry with which it was queued, which it keeps
            when it is interrupted; of a block that of the whole. None where the last version queued it.
        continuations: attempts of a job in blocks that went on with what these had made.
        begun_at: when the attempt of a job in blocks began that planned them; None for any other.
    """

    id: uuid.UUID
    owner: str
    kind: str
    dataset_id: uuid.UUID | None
    source_id: uuid.UUID | None
    label: str | None
    options: dict[str, Any]
    queue: str
    priority: int
    slip: int | None
    state: JobState
    attempt: int
    fresh_after: int
    rescues: int
    stage: str | None
    step: int | None
    total_steps: int | None
    seconds_left: float | None
    psnr: float | None
    training_psnr: float | None
    worker: str | None
    error: dict[str, Any] | None
    checkpoint: dict[str, Any] | None
    preview: dict[str, Any] | None
    traceparent: str | None
    pinned: bool
    created_at: datetime
    queued_at: datetime
    started_at: datetime | None
    heartbeat_at: datetime | None
    finished_at: datetime | None
    expires_at: datetime | None
    version: int
    estimate: dict[str, Any] | None = None
    files_id: uuid.UUID | None = None
    settings: dict[str, Any] | None = None
    resolved_by: str | None = None
    waits_for: str | None = None
    begun_anew: str | None = None
    requested: dict[str, Any] | None = None
    view_notes: list[dict[str, Any]] = field(default_factory=list)
    root_id: uuid.UUID | None = None
    role: str | None = None
    place: int | None = None
    continuations: list[int] = field(default_factory=list)
    begun_at: datetime | None = None

    @property
    def is_over(self) -> bool:
        """Return whether the job is in a terminal state."""
        return self.state in TERMINAL

    def count_starts(self, attempt: int) -> int:
        """Return how many starts there were up to an attempt; to go on after one's blocks is no further one.

        >>> from types import SimpleNamespace
        >>> Job.count_starts(SimpleNamespace(continuations=[2]), 3)
        2
        """
        return attempt - sum(continued <= attempt for continued in self.continuations)

    @property
    def place_in_queue(self) -> int | None:
        """Return its place among the jobs of its owner; None if it was never queued or is over."""
        return self.slip if self.place is None else self.place

    @property
    def waits_for_blocks(self) -> bool:
        """Return whether the job is under way, but only its blocks are with workers."""
        return self.role == "root" and self.state in ("running", "canceling") and self.heartbeat_at is None

    def refuse_block(self) -> None:
        """Refuse to change a job that is a part of another.

        Raises:
            ConflictError: it is.
        """
        if self.root_id is not None:
            raise ConflictError(f"The job is a block of the job {self.root_id}; change that one.")


@dataclass(frozen=True)
class Artifact:
    """A result of a job: its name, content and media type."""

    job_id: uuid.UUID
    name: str
    sha256: str
    size_bytes: int
    media_type: str


@dataclass(frozen=True)
class JobEvent:
    """Something that happened to a job; numbers rise, by job."""

    number: int
    job_id: uuid.UUID
    attempt: int
    kind: str
    data: dict[str, Any]
    at: datetime


@dataclass(frozen=True)
class LogLine:
    """A line that a job's program wrote; numbers rise, by job."""

    number: int
    job_id: uuid.UUID
    attempt: int
    text: str
    at: datetime


@dataclass(frozen=True)
class Token:
    """An access token, known by the SHA-256 of its secret only."""

    id: uuid.UUID
    owner: str
    name: str
    sha256: str
    scopes: list[str]
    created_at: datetime
    expires_at: datetime | None
    revoked_at: datetime | None


@dataclass(frozen=True)
class WorkerRow:
    """A worker that was seen lately."""

    id: uuid.UUID
    name: str
    queues: list[str]
    slots: int
    facts: dict[str, Any]
    started_at: datetime
    seen_at: datetime

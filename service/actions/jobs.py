"""Jobs: listed, read, changed, cancelled, deleted."""

import uuid
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass

from pydantic import ValidationError

from octasplat.engine.errors import ConfigError
from octasplat.service.actions.access import owned_job
from octasplat.service.actions.parts import Part, cut
from octasplat.service.auth import Principal
from octasplat.service.limits import limit_notes
from octasplat.service.problems import Problem
from octasplat.service.queue_facts import waiting_notes, workers_of
from octasplat.service.schemas.jobs import JobChange, JobView
from octasplat.service.state import Service
from octasplat.workers.queue import jobs as rows
from octasplat.workers.records.database import Connection, tried_again
from octasplat.workers.records.rows import Job, JobState
from octasplat.workers.work.kinds import kind_named

BUSY_SECONDS = 2
"""After which a job that moves is worth another look."""


@dataclass(frozen=True)
class JobFilter:
    """Which jobs to list; what is None or empty does not matter.

    Attributes:
        states: any of these.
        kind: its kind.
        label: its label.
        dataset_id: what it works on.
    """

    states: Sequence[JobState] = ()
    kind: str | None = None
    label: str | None = None
    dataset_id: uuid.UUID | None = None


@dataclass(frozen=True)
class ShownJob:
    """A job with what is shown of it, both of one moment."""

    row: Job
    view: JobView


async def list_jobs(
    service: Service, who: Principal, wanted: JobFilter, *, before: uuid.UUID | None, limit: int
) -> Part[Job]:
    """Jobs that the asker may see, the newest first.

    Args:
        service: the service.
        who: asks.
        wanted: which of them.
        before: made before this one.
        limit: at most so many.
    """
    async with service.pool.connection() as connection:
        found = await rows.list_jobs(
            connection,
            owner=who.sees,
            states=wanted.states,
            kind=_storable(wanted.kind),
            label=_storable(wanted.label),
            dataset_id=wanted.dataset_id,
            before=before,
            limit=limit + 1,
        )
    return cut(found, limit, lambda job: job.id)


async def get_job(service: Service, who: Principal, job_id: uuid.UUID) -> ShownJob:
    """A job.

    Raises:
        Problem: 404.
    """
    async with service.pool.connection() as connection:
        job = await owned_job(connection, who, job_id)
        return ShownJob(job, await job_view(connection, service, job))


@tried_again
async def change_job(
    service: Service,
    who: Principal,
    job_id: uuid.UUID,
    change: JobChange,
    check: Callable[[ShownJob], None] = lambda _: None,
) -> JobView:
    """Rename a job, or keep it whatever its age.

    Args:
        service: the service.
        who: asks.
        job_id: the job.
        change: what is to be different.
        check: sees the job as it is, while nobody else can change it, and raises to leave it so.

    Raises:
        Problem: 404.
    """
    async with service.pool.connection() as connection, connection.transaction():
        job = await owned_job(connection, who, job_id, lock=True)
        check(ShownJob(job, await job_view(connection, service, job)))
        given = change.model_dump(exclude_unset=True)
        job = await rows.change_job(
            connection,
            job_id,
            label=given.get("label", job.label),
            pinned=bool(given["pinned"]) if given.get("pinned") is not None else job.pinned,
        )
        return await job_view(connection, service, job)


@tried_again
async def cancel_job(service: Service, who: Principal, job_id: uuid.UUID) -> JobView:
    """Ask a job to stop.

    Raises:
        Problem: 404.
        Conflict: it is over.
    """
    async with service.pool.connection() as connection:
        await owned_job(connection, who, job_id)
        job = await rows.cancel_job(connection, service.slips, job_id)
        return await job_view(connection, service, job)


@tried_again
async def delete_job(service: Service, who: Principal, job_id: uuid.UUID, *, cancel: bool = False) -> None:
    """Delete a finished job with its results.

    Args:
        service: the service.
        who: asks.
        job_id: the job.
        cancel: stop it first if it is not over.

    Raises:
        Problem: 404; 409 while it still stops.
        Conflict: it is not over.
    """
    async with service.pool.connection() as connection:
        job = await owned_job(connection, who, job_id)
        if cancel and not job.is_over:
            job = await rows.cancel_job(connection, service.slips, job_id)
    if cancel and not job.is_over:
        detail = "The job is being stopped; repeat the request in a moment."
        raise Problem(409, "stopping", detail, retry_seconds=BUSY_SECONDS)
    async with service.pool.connection() as connection:
        await rows.delete_job(connection, job_id)
    service.room.after_deletion()


def stages_of(job: Job) -> list[str]:
    """Names of the stages of a job, in order."""
    try:
        kind = kind_named(job.kind)
        return list(kind.stages(kind.options.model_validate(job.options)))
    except (ConfigError, ValidationError):  # of another version
        return []


async def job_view(connection: Connection, service: Service, job: Job) -> JobView:
    """A job as it is shown alone: with its place in the queue, and what to know while it waits."""
    notes: list[str] = []
    if job.state == "queued":
        with suppress(ConfigError, ValidationError):  # of another version
            kind = kind_named(job.kind)
            workers = await workers_of(connection, job.queue, service.settings.stale_seconds)
            notes = waiting_notes(kind, kind.options.model_validate(job.options), job.queue, workers)
            notes += limit_notes(job.estimate, workers, service.settings)
    return JobView.of(job, stages_of(job), await rows.queue_position(connection, job), notes)


def _storable(text: str | None) -> str | None:
    """Postgres holds no NUL, so nothing has it."""
    return text if text is None else text.replace("\0", "\N{REPLACEMENT CHARACTER}")

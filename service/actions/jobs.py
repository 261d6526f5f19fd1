"""Jobs: listed, read, changed, cancelled, deleted."""

import uuid
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

from pydantic import ValidationError

from octasplat.engine.core.errors import ConfigError
from octasplat.service.actions.access import fetch_visible_job
from octasplat.service.actions.pages import Page, page_of
from octasplat.service.auth import Principal
from octasplat.service.block_progress import with_block_progress
from octasplat.service.idempotency import create_once, fingerprint
from octasplat.service.job_limits import limit_notes
from octasplat.service.problems import ProblemError
from octasplat.service.queue_workers import (
    busy_workers_note,
    drained_workers_note,
    live_workers_of_queue,
    paused_queue_note,
    queued_job_notes,
)
from octasplat.service.schemas.jobs import BlockView, JobChange, JobView
from octasplat.service.state import Service
from octasplat.workers.db.connections import Connection, retry_on_deadlock
from octasplat.workers.db.holds import read_holds
from octasplat.workers.db.postgres_text import storable_text
from octasplat.workers.db.rows import Job, JobState
from octasplat.workers.queue import jobs as rows
from octasplat.workers.queue.block_jobs import ROOT, blocks_of
from octasplat.workers.queue.block_jobs import cancel_job as cancel_job_row
from octasplat.workers.queue.fair_share import queue_position
from octasplat.workers.queue.jobs import JobOrder
from octasplat.workers.queue.usage_figures import running_by_queue
from octasplat.workers.worker.job_kinds import get_job_kind
from octasplat.workers.worker.job_kinds.stored_options import expected_options
from octasplat.workers.worker.path_redaction import shorten_absolute_paths

BUSY_RETRY_SECONDS = 2
"""After which a job that moves is worth another look."""


@dataclass(frozen=True)
class JobFilter:
    """Filter of a list of jobs; fields that are None or empty match all.

    Attributes:
        states: any of these.
        kind: its kind.
        label: its label.
        dataset_id: what it works on.
        order: which come first.
        text: part of its label, its kind, the name of its dataset, or the end of its id.
    """

    states: Sequence[JobState] = ()
    kind: str | None = None
    label: str | None = None
    dataset_id: uuid.UUID | None = None
    text: str | None = None
    order: JobOrder = "newest"


@dataclass(frozen=True)
class JobWithView:
    """A job and its view, both of one moment."""

    row: Job
    view: JobView


async def list_jobs(
    service: Service, principal: Principal, job_filter: JobFilter, *, before: uuid.UUID | None, limit: int
) -> Page[Job]:
    """Return jobs that the principal may see, in the order of the filter.

    Args:
        service: the service.
        principal: asks.
        job_filter: which of them.
        before: that come behind this one.
        limit: at most so many.

    Raises:
        ProblemError: 422 if the order begins behind a job that there is no more.
    """
    async with service.pool.connection() as connection:
        found = await rows.list_jobs(
            connection,
            owner=principal.visible_owner,
            states=job_filter.states,
            kind=_searchable_text(job_filter.kind),
            label=_searchable_text(job_filter.label),
            dataset_id=job_filter.dataset_id,
            text=_searchable_text(job_filter.text),
            before=before,
            order=job_filter.order,
            limit=limit + 1,
        )
        if not found and before is not None and job_filter.order not in ("newest", "oldest"):
            last = await rows.get_job(connection, before)
            if last is None or not principal.may_see(last.owner):
                raise ProblemError(
                    422, "cursor", "The job behind which this part of the list begins is gone; begin again."
                )
        waiting = [job.id for job in found if job.waits_for_blocks]
        blocks = await blocks_of(connection, waiting)
    found = [
        with_block_progress(job, [block for block in blocks if block.root_id == job.id]) for job in found
    ]
    return page_of(found, limit, lambda job: job.id)


async def get_job(service: Service, principal: Principal, job_id: uuid.UUID) -> JobWithView:
    """Return the job with that id, if the principal may see it.

    Raises:
        ProblemError: 404 if it does not exist or the principal may not see it.
    """
    async with service.pool.connection() as connection:
        job = await fetch_visible_job(connection, principal, job_id)
        return JobWithView(job, await job_view(connection, service, principal, job))


@retry_on_deadlock
async def change_job(
    service: Service,
    principal: Principal,
    job_id: uuid.UUID,
    change: JobChange,
    check: Callable[[JobWithView], None] = lambda _: None,
) -> JobWithView:
    """Rename a job, pin it so that it does not expire, or replace its notes.

    Args:
        service: the service.
        principal: asks.
        job_id: the job.
        change: what is to be different.
        check: sees the job as it is, while nobody else can change it, and raises to leave it so.

    Raises:
        ProblemError: 404 if it does not exist or the principal may not see it.
    """
    async with service.pool.connection() as connection, connection.transaction():
        job = await fetch_visible_job(connection, principal, job_id, lock=True)
        check(JobWithView(job, await job_view(connection, service, principal, job)))
        # A label that is null is removed, and one that was not sent stays.
        given = change.model_dump(exclude_unset=True)
        job = await rows.change_job(
            connection,
            job_id,
            label=given.get("label", job.label),
            pinned=bool(given["pinned"]) if given.get("pinned") is not None else job.pinned,
            view_notes=given.get("view_notes"),
        )
        return JobWithView(job, await job_view(connection, service, principal, job))


@retry_on_deadlock
async def cancel_job(
    service: Service, principal: Principal, job_id: uuid.UUID, *, idempotency_key: str | None = None
) -> JobView:
    """Ask a job to stop; the same request with the key again does not stop what was begun anew since.

    Raises:
        ProblemError: 404 if it does not exist or the principal may not see it, 422 for a key used otherwise.
        ConflictError: it is over.
    """
    async with service.pool.connection() as connection, connection.transaction():
        await fetch_visible_job(connection, principal, job_id)

        async def cancel() -> uuid.UUID:
            await cancel_job_row(connection, service.job_queue, job_id)
            return job_id

        named = fingerprint("cancel", str(job_id))
        await create_once(connection, principal, idempotency_key, named, cancel)
        job = await fetch_visible_job(connection, principal, job_id)
        return await job_view(connection, service, principal, job)


@retry_on_deadlock
async def delete_job(
    service: Service, principal: Principal, job_id: uuid.UUID, *, cancel: bool = False
) -> None:
    """Delete a finished job with its results.

    Args:
        service: the service.
        principal: asks.
        job_id: the job.
        cancel: stop it first if it is not over.

    Raises:
        ProblemError: 404; 409 while it still stops.
        ConflictError: it is not over.
    """
    async with service.pool.connection() as connection:
        job = await fetch_visible_job(connection, principal, job_id)
        if cancel and not job.is_over:
            job = await cancel_job_row(connection, service.job_queue, job_id)
    if cancel and not job.is_over:
        detail = "The job is being stopped; repeat the request in a moment."
        raise ProblemError(409, "stopping", detail, retry_seconds=BUSY_RETRY_SECONDS)
    # In another transaction, so that the job stays stopped where its deletion is refused.
    async with service.pool.connection() as connection:
        await rows.delete_job(connection, job_id)
    service.evictor.evict_if_low_later()


def complete_options(job: Job) -> dict[str, Any]:
    """Return every option of a job: as it runs or ran, or as this version would run it."""
    if job.settings is not None:
        return job.settings
    try:
        return expected_options(get_job_kind(job.kind), job).model_dump(mode="json")
    except (ConfigError, ValidationError):  # of another version
        return job.options


def stages_of(job: Job) -> list[str]:
    """Return the names of a job's stages, in order."""
    try:
        kind = get_job_kind(job.kind)
        return list(kind.stages(expected_options(kind, job)))
    except (ConfigError, ValidationError):  # of another version
        return []


async def job_view(connection: Connection, service: Service, principal: Principal, job: Job) -> JobView:
    """Return the view of one job, with its position in the queue and notes while it waits.

    Its worker, which is named after its host, is for administrators.
    """
    notes = [job.begun_anew] if job.begun_anew is not None else []
    if job.state == "queued":
        holds = await read_holds(connection)
        if job.queue in holds.queues:
            notes.append(paused_queue_note(job.queue))
        elif job.waits_for is not None:
            notes.append(shorten_absolute_paths(job.waits_for))
        with suppress(ConfigError, ValidationError):  # of another version
            kind = get_job_kind(job.kind)
            workers = await live_workers_of_queue(connection, job.queue, service.settings.stale_seconds)
            notes += queued_job_notes(kind, expected_options(kind, job), job.queue, workers)
            notes += limit_notes(job.estimate, workers, service.settings)
            if not notes:
                notes += drained_workers_note(workers, holds.workers, job.queue)
            if not notes:
                notes += busy_workers_note(workers, await running_by_queue(connection), job.queue)
    blocks = await blocks_of(connection, [job.id]) if job.role == ROOT else []
    view = JobView.from_row(
        replace(with_block_progress(job, blocks), options=complete_options(job)),
        stages_of(job),
        await queue_position(connection, job),
        notes,
        shows_worker=principal.may("admin"),
    )
    return view.model_copy(update={"blocks": [BlockView.from_row(block, job) for block in blocks]})


def _searchable_text(text: str | None) -> str | None:
    """Return the text with characters replaced that Postgres refuses, so that it matches nothing."""
    return text if text is None else storable_text(text)

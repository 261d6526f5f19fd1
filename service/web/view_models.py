"""View models of the pages on jobs, gathered from the database and the storage."""

import urllib.parse
import uuid
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from psycopg.rows import class_row

from octasplat.service.actions.access import fetch_visible_job
from octasplat.service.actions.jobs import JobFilter, job_view, list_jobs, stages_of
from octasplat.service.actions.pages import Page
from octasplat.service.auth import Principal
from octasplat.service.schemas.jobs import JobView
from octasplat.service.state import Service
from octasplat.service.thread_pools import ThreadPurpose, run_in_pool
from octasplat.service.web.results import METRICS, mean_psnr, read_json
from octasplat.service.whole_progress import OPTIONAL_STAGE
from octasplat.workers.client.short_ids import short_id
from octasplat.workers.db.connections import Connection, select_columns
from octasplat.workers.db.datasets import files_of, get_dataset
from octasplat.workers.db.rows import Artifact, Dataset, DatasetFile, Job, JobEvent, JobState
from octasplat.workers.queue.block_jobs import ROOT
from octasplat.workers.queue.fair_share import queue_position
from octasplat.workers.queue.jobs import JobOrder

ACTIVE: tuple[JobState, ...] = ("queued", "running", "canceling")
STATE_FILTERS: dict[str, tuple[JobState, ...]] = {
    "all": (),
    "active": ACTIVE,
    "done": ("succeeded",),
    "failed": ("failed", "canceled"),
}
_MAX_EVENTS = 400
_STAGE_KINDS = ("stage_started", "stage_finished")


@dataclass(frozen=True)
class JobRow:
    """A job in the list.

    Attributes:
        job: the job.
        name: what people call it.
        psnr: of the held-out views, dB.
        gaussians: how many there are.
        picture: address of a small picture.
    """

    job: JobView
    name: str
    psnr: float | None
    gaussians: int | None
    picture: str | None


@dataclass(frozen=True)
class StageRow:
    """A stage of a job: ``done``, ``now`` or ``later``, and how long it took."""

    name: str
    state: str
    seconds: float | None


@dataclass(frozen=True)
class JobDetail:
    """A job on its own page."""

    line: JobRow
    dataset: Dataset | None
    stages: list[StageRow]
    notes: list[JobEvent]
    warnings: list[str]


async def list_job_rows(
    service: Service,
    principal: Principal,
    state_filter: str,
    before: uuid.UUID | None,
    limit: int,
    *,
    text: str | None = None,
    kind: str | None = None,
    order: JobOrder = "newest",
) -> Page[JobRow]:
    """Return jobs of one kind of state in an order, those with ``text`` in their names, kinds or ids."""
    job_filter = JobFilter(STATE_FILTERS[state_filter], kind=kind, text=text, order=order)
    part = await list_jobs(service, principal, job_filter, before=before, limit=limit)
    async with service.pool.connection() as connection:
        return Page(await _job_rows(service, connection, part.rows), part.next_key)


async def job_counts(service: Service, principal: Principal) -> dict[str, int]:
    """Return how many jobs there are of each kind of state."""
    async with service.pool.connection() as connection:
        cursor = await connection.execute(
            """
            SELECT state, count(*) AS n FROM jobs
            WHERE root_id IS NULL AND (%(owner)s::text IS NULL OR owner = %(owner)s) GROUP BY state
            """,
            {"owner": principal.visible_owner},
        )
        by_state = {row["state"]: row["n"] for row in await cursor.fetchall()}
    return {
        name: sum(n for state, n in by_state.items() if not states or state in states)
        for name, states in STATE_FILTERS.items()
    }


async def job_detail(service: Service, principal: Principal, job_id: uuid.UUID) -> JobDetail:
    """Return a job with what has happened to it.

    Raises:
        ProblemError: 404 if it does not exist or the principal may not see it.
    """
    async with service.pool.connection() as connection:
        job = await fetch_visible_job(connection, principal, job_id)
        [line] = await _job_rows(service, connection, [job])
        line = replace(line, job=await job_view(connection, service, principal, job))
        dataset = await get_dataset(connection, job.dataset_id) if job.dataset_id else None
        async with connection.cursor(row_factory=class_row(JobEvent)) as cursor:
            await cursor.execute(
                select_columns(
                    """
                SELECT {} FROM job_events
                WHERE job_id = %s AND kind NOT IN ('progress', 'preview', 'checkpoint')
                ORDER BY id DESC LIMIT %s
                """,
                    JobEvent,
                ),
                [job_id, _MAX_EVENTS],
            )
            # The newest so many, shown from the oldest on.
            events = (await cursor.fetchall())[::-1]
    # After a start from nothing, or by another worker, stages are gone through again.
    current = [event for event in events if job.count_starts(event.attempt) == line.job.attempt]
    spent = {str(e.data.get("stage")): e.data.get("seconds") for e in current if e.kind == "stage_finished"}
    # The training of all blocks begins in one attempt and ends in another.
    if job.role == ROOT and "train" in spent:
        times = [e.at for e in current if e.kind in _STAGE_KINDS and e.data.get("stage") == "train"]
        spent["train"] = (max(times) - min(times)).total_seconds()
    warnings = [str(e.data.get("message")) for e in events if e.kind == "warning"]
    if dataset is not None:
        warnings = [*dataset.facts.get("warnings", ()), *warnings]
    return JobDetail(
        line,
        dataset,
        _stage_rows(line.job, spent),
        [event for event in events if event.kind in ("rescued", "handed_back", "resumed")],
        list(dict.fromkeys(warnings)),
    )


async def photographs_of(service: Service, principal: Principal, job_id: uuid.UUID) -> list[DatasetFile]:
    """Return the files of the dataset that a job works on; none if it is gone.

    Raises:
        ProblemError: 404 if it does not exist or the principal may not see it.
    """
    async with service.pool.connection() as connection:
        job = await fetch_visible_job(connection, principal, job_id)
        return await files_of(connection, job.dataset_id) if job.dataset_id else []


async def _job_rows(service: Service, connection: Connection, jobs: Sequence[Job]) -> list[JobRow]:
    ids = [job.id for job in jobs]
    names = await _dataset_names(connection, jobs)
    counts = await _gaussian_counts(connection, ids)
    metrics = await _first_artifacts(connection, ids, METRICS)
    renders = await _first_artifacts(connection, ids, "renders/%.png")
    contents = await run_in_pool(
        ThreadPurpose.DOWNLOADS,
        lambda: {job_id: read_json(service.storage, row) for job_id, row in metrics.items()},
    )
    lines = []
    for job in jobs:
        view = JobView.from_row(job, stages_of(job), await queue_position(connection, job))
        measured = contents.get(job.id, {})
        gaussians = measured.get("gaussians")
        psnr = mean_psnr(measured)
        lines.append(
            JobRow(
                view,
                _display_name(job, names),
                # Until all views are measured, the row has the value over some of their rays.
                job.psnr if psnr is None else psnr,
                gaussians if isinstance(gaussians, int) else counts.get(job.id),
                _thumbnail_address(job, renders.get(job.id)),
            )
        )
    return lines


def _display_name(job: Job, names: dict[uuid.UUID, str]) -> str:
    named = job.label or (names.get(job.dataset_id) if job.dataset_id else None)
    if named and job.kind != "reconstruct" and not job.label:
        return f"{named} · {job.kind}"
    return named or f"{job.kind} {short_id(job.id)}"


def _thumbnail_address(job: Job, render: Artifact | None) -> str | None:
    if job.preview is not None:
        return f"/v1/jobs/{job.id}/preview?step={job.preview.get('step', 0)}"
    return None if render is None else f"/v1/jobs/{job.id}/artifacts/{urllib.parse.quote(render.name)}"


def _stage_rows(job: JobView, spent: dict[str, Any]) -> list[StageRow]:
    over = job.state == "succeeded"
    names = _with_unexpected_stages(job.stages, [*spent, *([job.stage] if job.stage else [])])
    place = names.index(job.stage) if job.stage in names else -1
    if OPTIONAL_STAGE in names and OPTIONAL_STAGE not in spent:
        skipped = names.index(OPTIONAL_STAGE)
        # trials before the training may have left materials out, or taken another recipe
        if over or place > skipped:
            del names[skipped]
            place -= place > skipped
    lines = []
    for k, name in enumerate(names):
        past = over or k < place or (k != place and name in spent)
        state = "done" if past else "now" if k == place else "later"
        if state == "now" and job.state not in ACTIVE:
            state = "stopped"
        seconds = spent.get(name)
        lines.append(StageRow(name, state, seconds if isinstance(seconds, int | float) else None))
    return lines


def _with_unexpected_stages(expected_stages: Sequence[str], reported: Sequence[str]) -> list[str]:
    """Return the expected stages, with unexpected ones inserted where they occurred."""
    names = list(expected_stages)
    # Each name with the one that was reported before it.
    for before, name in zip((None, *reported), reported, strict=False):
        if name not in names:
            names.insert(names.index(before) + 1 if before is not None else 0, name)
    return names


async def _dataset_names(connection: Connection, jobs: Sequence[Job]) -> dict[uuid.UUID, str]:
    ids = list({job.dataset_id for job in jobs if job.dataset_id is not None})
    cursor = await connection.execute("SELECT id, name FROM datasets WHERE id = ANY(%s)", [ids])
    return {row["id"]: row["name"] for row in await cursor.fetchall()}


async def _gaussian_counts(connection: Connection, ids: list[uuid.UUID]) -> dict[uuid.UUID, int]:
    """Return the newest reported number of Gaussians of each job."""
    cursor = await connection.execute(
        """
        SELECT wanted.id, (
            SELECT data->'gaussians' FROM job_events
            WHERE job_id = wanted.id AND kind = 'progress' AND data ? 'gaussians' ORDER BY id DESC LIMIT 1
        ) AS gaussians
        FROM unnest(%s::uuid[]) AS wanted(id)
        """,
        [ids],
    )
    return {
        row["id"]: row["gaussians"] for row in await cursor.fetchall() if isinstance(row["gaussians"], int)
    }


async def _first_artifacts(
    connection: Connection, ids: list[uuid.UUID], like: str
) -> dict[uuid.UUID, Artifact]:
    """Return the first result of each job whose name fits."""
    async with connection.cursor(row_factory=class_row(Artifact)) as cursor:
        await cursor.execute(
            select_columns(
                """
                SELECT DISTINCT ON (job_id) {} FROM artifacts WHERE job_id = ANY(%s) AND name LIKE %s
                ORDER BY job_id, name
                """,
                Artifact,
            ),
            [ids, like],
        )
        return {row.job_id: row for row in await cursor.fetchall()}

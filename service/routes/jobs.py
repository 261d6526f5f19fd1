"""Jobs: accepted, listed, read, cancelled, retried, deleted."""

import uuid
from collections.abc import Mapping
from contextlib import suppress
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, Response
from pydantic import BaseModel, ValidationError

from engine.errors import ConfigError
from service.auth import Principal, Reader, Writer
from service.etags import check_precondition, matches
from service.idempotency import IdempotencyKey, fingerprint, once
from service.limits import check_ceilings, check_priority, estimate_job, limit_notes
from service.paging import Cursor, Limit, link_next, read_id_cursor, write_cursor
from service.problems import Problem, not_found, refused_options
from service.queue_facts import check_writable, waiting_notes, workers_of
from service.routes import problems
from service.schemas.jobs import JobChange, JobPage, JobView, NewJob, RetryRequest
from service.state import Service, ServiceDep
from service.webhook_addresses import check_address
from workers.queue import jobs as rows
from workers.records.database import Connection
from workers.records.datasets import get_dataset, photograph_sizes
from workers.records.quotas import check_new_job
from workers.records.rows import Job, JobState
from workers.upkeep.webhooks.rows import add_endpoint
from workers.work.kinds import JobKind, kind_named

router = APIRouter(prefix="/v1/jobs", tags=["jobs"])

_BUSY_SECONDS = 2
_IDLE_SECONDS = 30


@router.post("", status_code=202, responses=problems(404, 409))
async def create_job(
    new: NewJob, who: Writer, service: ServiceDep, request: Request, response: Response,
    key: IdempotencyKey = None,
) -> JobView:  # fmt: skip
    """Accept a job; poll the address in `Location`, or listen to its `/events`."""
    if service.draining:
        raise Problem(503, "draining", "The service is about to stop.", headers={"Retry-After": "10"})
    kind = accepted_kind(new.kind)
    resolved(kind, new.options)
    check_priority(who, new.priority, service.settings)
    if new.webhook is not None:
        check_address(service, new.webhook.url, "#/webhook/url")
    async with service.pool.connection() as connection, connection.transaction():

        async def make() -> uuid.UUID:
            await check_new_job(connection, who.owner, service.settings.quota)
            dataset_id, source_id, options = await _inputs(connection, who, kind, new)
            workers = await workers_of(connection, new.queue, service.settings.stale_seconds)
            check_writable(kind, options, new.queue, workers)
            sizes = await photograph_sizes(connection, dataset_id) if dataset_id is not None else []
            check_ceilings(kind, options, sizes, service.settings)
            estimate = estimate_job(kind, options, sizes, workers)
            made = rows.NewJob(
                owner=who.owner,
                kind=kind.name,
                options=options.model_dump(mode="json"),
                queue=new.queue,
                priority=new.priority,
                dataset_id=dataset_id,
                source_id=source_id,
                label=new.label,
                estimate=None if estimate is None else estimate.model_dump(mode="json"),
                traceparent=request.headers.get("traceparent", "")[:100] or None,
            )
            job_id = (await rows.create_job(connection, service.slips, made)).id
            if new.webhook is not None:
                await add_endpoint(
                    connection,
                    owner=who.owner,
                    url=new.webhook.url,
                    secret=new.webhook.secret,
                    events=new.webhook.events,
                    job_id=job_id,
                )
            return job_id

        named = fingerprint("job", new.model_dump(mode="json"))
        job_id, _ = await once(connection, who, key, named, make)
        job = await owned_job(connection, who, job_id)
        view = await job_view(connection, service, job)
    response.headers["Location"] = f"/v1/jobs/{job_id}"
    _say_when(response, view)
    return view


@router.get("", responses=problems())
async def list_jobs(
    who: Reader, service: ServiceDep, request: Request, response: Response,
    state: Annotated[list[JobState] | None, Query(description="May be given several times.")] = None,
    kind: Annotated[str | None, Query(max_length=40)] = None,
    label: Annotated[str | None, Query(max_length=200)] = None,
    dataset_id: uuid.UUID | None = None,
    limit: Limit = 50,
    cursor: Cursor = None,
) -> JobPage:  # fmt: skip
    """Your jobs, the newest first."""
    before = read_id_cursor(cursor)
    async with service.pool.connection() as connection:
        found = await rows.list_jobs(
            connection,
            owner=who.sees,
            states=state or (),
            kind=_clean(kind),
            label=_clean(label),
            dataset_id=dataset_id,
            before=before,
            limit=limit + 1,
        )
    following = write_cursor(str(found[limit - 1].id)) if len(found) > limit else None
    link_next(request, response, following)
    return JobPage(jobs=[JobView.of(job, stages_of(job)) for job in found[:limit]], next=following)


@router.get("/{job_id}", responses={304: {"description": "Not changed"}, **problems(404)})
async def get_job(
    job_id: uuid.UUID, who: Reader, service: ServiceDep, request: Request, response: Response
) -> JobView:
    """A job. Polling with `If-None-Match` costs next to nothing."""
    async with service.pool.connection() as connection:
        job = await owned_job(connection, who, job_id)
        view = await job_view(connection, service, job)
    etag = _etag(job, view)
    headers = {"ETag": etag, "Cache-Control": "no-cache"}
    if matches(request.headers.get("if-none-match"), etag):
        return Response(status_code=304, headers=headers)  # type: ignore[return-value]
    response.headers.update(headers)
    if not job.is_over:
        _say_when(response, view)
    return view


@router.patch("/{job_id}", responses=problems(404, 412))
async def change_job(
    job_id: uuid.UUID, change: JobChange, who: Writer, service: ServiceDep, request: Request
) -> JobView:
    """Rename a job, or keep it whatever its age."""
    async with service.pool.connection() as connection, connection.transaction():
        job = await owned_job(connection, who, job_id, lock=True)
        check_precondition(request, _etag(job, await job_view(connection, service, job)))
        given = change.model_dump(exclude_unset=True)
        job = await rows.change_job(
            connection,
            job_id,
            label=given.get("label", job.label),
            pinned=bool(given["pinned"]) if given.get("pinned") is not None else job.pinned,
        )
        return await job_view(connection, service, job)


@router.post("/{job_id}/cancel", status_code=202, responses=problems(404, 409))
async def cancel_job(job_id: uuid.UUID, who: Writer, service: ServiceDep, response: Response) -> JobView:
    """Ask a job to stop; may be repeated. Its checkpoint stays, so that a retry goes on from it."""
    async with service.pool.connection() as connection:
        await owned_job(connection, who, job_id)
        job = await rows.cancel_job(connection, service.slips, job_id)
        view = await job_view(connection, service, job)
    response.headers["Location"] = f"/v1/jobs/{job_id}"
    _say_when(response, view)
    return view


@router.post("/{job_id}/retry", status_code=202, responses=problems(404, 409))
async def retry_job(
    job_id: uuid.UUID, who: Writer, service: ServiceDep, response: Response,
    retry: RetryRequest | None = None, key: IdempotencyKey = None,
) -> JobView:  # fmt: skip
    """Queue a failed or cancelled job again, from its newest checkpoint or from the start.

    With other options if some are given: a reconstruction whose files could not be written goes on from its
    trained scene with other `exports`.
    """
    asked = retry or RetryRequest(start="checkpoint")
    async with service.pool.connection() as connection, connection.transaction():
        owner = (await owned_job(connection, who, job_id)).owner

        async def make() -> uuid.UUID:
            await check_new_job(connection, owner, service.settings.quota)
            job = await owned_job(connection, who, job_id, lock=True)
            options, estimate = await _revised(connection, service, job, asked)
            await rows.retry_job(
                connection,
                service.slips,
                job_id,
                fresh=asked.start == "start",
                options=options,
                estimate=estimate,
            )
            return job_id

        named = fingerprint("retry", str(job_id), asked.start, *([asked.options] if asked.options else []))
        await once(connection, who, key, named, make)
        view = await job_view(connection, service, await owned_job(connection, who, job_id))
    response.headers["Location"] = f"/v1/jobs/{job_id}"
    _say_when(response, view)
    return view


@router.delete("/{job_id}", status_code=204, responses=problems(404, 409))
async def delete_job(
    job_id: uuid.UUID, who: Writer, service: ServiceDep, response: Response,
    cancel: Annotated[bool, Query(description="Stop it first if it is not over.")] = False,
) -> None:  # fmt: skip
    """Delete a finished job with its results; repeat the request for one that still stops."""
    async with service.pool.connection() as connection:
        job = await owned_job(connection, who, job_id)
        if cancel and not job.is_over:
            job = await rows.cancel_job(connection, service.slips, job_id)
            if not job.is_over:
                detail = "The job is being stopped; repeat the request in a moment."
                headers = {"Retry-After": str(_BUSY_SECONDS)}
                raise Problem(409, "stopping", detail, headers=headers)
        await rows.delete_job(connection, job_id)
    service.room.after_deletion()


async def owned_job(connection: Connection, who: Principal, job_id: uuid.UUID, *, lock: bool = False) -> Job:
    """The job, if it is the asker's to see.

    Raises:
        Problem: 404.
    """
    job = await rows.get_job(connection, job_id, lock=lock)
    if job is None or not who.owns(job.owner):
        raise not_found("job")
    return job


async def read_job(service: Service, who: Principal, job_id: uuid.UUID) -> Job:
    """As :func:`owned_job`, on a connection of its own."""
    async with service.pool.connection() as connection:
        return await owned_job(connection, who, job_id)


def stages_of(job: Job) -> list[str]:
    """Names of the stages of a job, in order."""
    try:
        kind = kind_named(job.kind)
        return list(kind.stages(kind.options.model_validate(job.options)))
    except (ConfigError, ValidationError):  # of another version
        return []


def accepted_kind(name: str) -> JobKind:
    """The kind of that name.

    Raises:
        Problem: 422.
    """
    try:
        return kind_named(name)
    except ConfigError as error:
        raise Problem(422, "kind", str(error), errors=[{"pointer": "#/kind", "detail": str(error)}]) from None


def resolved(kind: JobKind, asked: Mapping[str, Any]) -> BaseModel:
    """Complete options.

    Raises:
        Problem: 422.
    """
    try:
        return kind.options.model_validate(kind.resolve(asked).model_dump(mode="json"))
    except ValidationError as error:
        raise refused_options(error) from None


async def _inputs(
    connection: Connection, who: Principal, kind: JobKind, new: NewJob
) -> tuple[uuid.UUID | None, uuid.UUID | None, BaseModel]:
    """What the job works on, checked: dataset, source, and the complete options that fit these."""
    options = resolved(kind, new.options)
    if kind.needs == "result":
        if new.source_id is None or new.dataset_id is not None:
            raise _input_problem("source_id", f"The kind {kind.name} works on source_id, a finished job.")
        source = await rows.get_job(connection, new.source_id, lock=True)
        if source is None or not who.owns(source.owner):
            raise _input_problem("source_id", "There is no such job.")
        names = {artifact.name for artifact in await rows.artifacts_of(connection, source.id)}
        if source.state != "succeeded" and not (source.state == "failed" and names):
            raise Problem(409, "source", f"The job in source_id is {source.state} and has no results.")
        if kind.source_files and kind.source_files[0] not in names:
            raise _input_problem("source_id", f"The job in source_id has no {kind.source_files[0]}.")
        return source.dataset_id, source.id, options
    if new.dataset_id is None or new.source_id is not None:
        raise _input_problem("dataset_id", f"A job of the kind {kind.name} works on dataset_id, a dataset.")
    dataset = await get_dataset(connection, new.dataset_id, lock=True)
    if dataset is None or not who.owns(dataset.owner):
        raise _input_problem("dataset_id", "There is no such dataset.")
    if dataset.state != "committed":
        raise Problem(409, "dataset-open", "The dataset is not committed yet; POST to its /commit first.")
    if kind.needs_poses(options) and not dataset.has_poses:
        detail = "The dataset holds no COLMAP model; set the option poses to auto, or send a model."
        raise Problem(422, "poses", detail, errors=[{"pointer": "#/options/poses", "detail": detail}])
    return dataset.id, None, kind.settle(options, dataset.has_poses)


def _input_problem(name: str, detail: str) -> Problem:
    return Problem(422, "input", detail, errors=[{"pointer": f"#/{name}", "detail": detail}])


async def _revised(
    connection: Connection, service: Service, job: Job, asked: RetryRequest
) -> tuple[dict[str, Any] | None, dict[str, Any] | None]:
    """The options of a job that is tried again, checked, and their estimate; None leaves them as they are."""
    workers = await workers_of(connection, job.queue, service.settings.stale_seconds)
    try:
        kind = kind_named(job.kind)
        before = kind.options.model_validate(job.options)
    except (ConfigError, ValidationError):
        if not asked.options:
            return None, None
        detail = "The job is of another version, so its options cannot be changed; make a new one."
        raise Problem(409, "version", detail) from None
    try:
        options = kind.revised(job.options, asked.options) if asked.options else before
    except ValidationError as error:
        raise refused_options(error) from None
    check_writable(kind, options, job.queue, workers)
    sizes = await photograph_sizes(connection, job.dataset_id) if job.dataset_id is not None else []
    check_ceilings(kind, options, sizes, service.settings)
    if not asked.options:
        return None, None
    if kind.needs == "dataset" and job.dataset_id is not None:
        dataset = await get_dataset(connection, job.dataset_id)
        options = kind.settle(options, dataset is not None and dataset.has_poses)
    if asked.start == "checkpoint" and job.checkpoint is not None and not kind.goes_on(before, options):
        detail = "With these options the work begins anew; ask for that with from: start."
        raise Problem(422, "other-work", detail, errors=[{"pointer": "#/options", "detail": detail}])
    estimate = estimate_job(kind, options, sizes, workers)
    return options.model_dump(mode="json"), None if estimate is None else estimate.model_dump(mode="json")


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


def _etag(job: Job, view: JobView) -> str:
    place = "" if view.queue_position is None else f".{view.queue_position}.{len(view.notes)}"
    return f'"{job.version}{place}"'


def _say_when(response: Response, view: JobView) -> None:
    """Ask again sooner where something moves."""
    ahead = view.queue_position or 0
    response.headers["Retry-After"] = str(min(_IDLE_SECONDS, _BUSY_SECONDS + ahead))


def _clean(text: str | None) -> str | None:
    """Postgres holds no NUL, so nothing has it."""
    return text if text is None else text.replace("\0", "\N{REPLACEMENT CHARACTER}")

"""Submission of jobs: new ones, and retries."""

import uuid
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from pydantic import BaseModel, ValidationError

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.operations.cost_model import Estimate
from octasplat.engine.settings.renamed_settings import collect_notices
from octasplat.service.actions.access import check_not_draining, fetch_visible_job
from octasplat.service.actions.glass_meshes import check_glass_meshes
from octasplat.service.actions.jobs import job_view
from octasplat.service.actions.named_files import check_named_files
from octasplat.service.actions.start_sources import fetch_start_source, lacks_source, options_with_start
from octasplat.service.actions.validation import (
    ResolvedOptions,
    input_problem,
    resolve_options,
    revise_options,
    validate_kind,
)
from octasplat.service.auth import Principal
from octasplat.service.idempotency import create_once, fingerprint, is_repeated
from octasplat.service.job_limits import (
    check_job_limits,
    check_priority,
    check_workers_large_enough,
    estimate_job,
)
from octasplat.service.problems import ProblemError
from octasplat.service.queue_workers import check_formats_writable, live_workers_of_queue
from octasplat.service.schemas.jobs import JobView, NewJob, RetryRequest
from octasplat.service.state import Service
from octasplat.service.webhook_addresses import check_webhook_address
from octasplat.workers.db.connections import Connection, retry_on_deadlock
from octasplat.workers.db.datasets import get_dataset, photograph_sizes
from octasplat.workers.db.locks import lock_owner
from octasplat.workers.db.quotas import check_new_job
from octasplat.workers.db.rows import Dataset, Job
from octasplat.workers.maintenance.webhooks.rows import add_endpoint
from octasplat.workers.queue import jobs as rows
from octasplat.workers.worker.job_kinds import JobKind, get_job_kind
from octasplat.workers.worker.job_kinds.stored_options import (
    expected_options,
    with_decisions,
    without_defaults,
)


@dataclass(frozen=True)
class _RequestedJob:
    """A requested job: its kind, and its options complete and as they were asked for."""

    new: NewJob
    kind: JobKind
    options: BaseModel
    requested: Mapping[str, Any] | None
    traceparent: str | None


@dataclass(frozen=True)
class _JobInputs:
    """Inputs of a job, and the options completed for them."""

    dataset_id: uuid.UUID | None
    source_id: uuid.UUID | None
    options: BaseModel
    files_id: uuid.UUID | None = None


@retry_on_deadlock
async def submit_job(
    service: Service,
    principal: Principal,
    request: NewJob,
    *,
    idempotency_key: str | None = None,
    traceparent: str | None = None,
) -> JobView:
    """Create a job from a request.

    Args:
        service: the service.
        principal: asks.
        request: the job.
        idempotency_key: the same request with it makes nothing new.
        traceparent: what the job's log is to name (W3C Trace Context).

    Raises:
        ProblemError: 409, 422, or 503 if the service is about to stop.
        QuotaExceededError: the asker has too many jobs.
    """
    check_not_draining(service)
    kind = validate_kind(request.kind)
    with collect_notices() as notices:
        options = await resolve_options(kind, request.options)
    requested = _RequestedJob(request, kind, options.complete, options.requested, traceparent)
    check_priority(principal, request.priority, service.settings)
    if request.webhook is not None:
        check_webhook_address(service, request.webhook.url, "#/webhook/url")
    if not await _is_repeated(service, principal, idempotency_key):
        await check_glass_meshes(service, principal, kind, options.complete, request.files_id)
    async with service.pool.connection() as connection, connection.transaction():

        async def make() -> uuid.UUID:
            return await _create_job(connection, service, principal, requested)

        # Without what was not asked for: a version that knows more may get the repetition.
        named = fingerprint("job", request.model_dump(mode="json", exclude_defaults=True))
        job_id, _ = await create_once(connection, principal, idempotency_key, named, make)
        job = await fetch_visible_job(connection, principal, job_id)
        view = await job_view(connection, service, principal, job)
        return view.model_copy(update={"notes": [*view.notes, *notices]})


@retry_on_deadlock
async def retry_job(
    service: Service,
    principal: Principal,
    job_id: uuid.UUID,
    request: RetryRequest,
    *,
    idempotency_key: str | None = None,
) -> JobView:
    """Queue a failed or cancelled job again.

    Args:
        service: the service.
        principal: asks.
        job_id: the job.
        request: where it begins, and with which options.
        idempotency_key: the same request with it does nothing more.

    Raises:
        ProblemError: 404, 409 or 422.
        ConflictError: it waits, runs or has succeeded.
        QuotaExceededError: its owner has too many jobs.
    """
    if not await _is_repeated(service, principal, idempotency_key):
        await _check_retried_meshes(service, principal, job_id, request)
    async with service.pool.connection() as connection, connection.transaction():
        owner = (await fetch_visible_job(connection, principal, job_id)).owner

        async def make() -> uuid.UUID:
            await lock_owner(connection, owner)
            # Before the job that waited for them, see workers.db.locks.
            await rows.lock_blocks(connection, job_id)
            job = await fetch_visible_job(connection, principal, job_id, lock=True)
            await check_new_job(connection, owner, service.settings.quota)
            revised = await _revised_options(connection, service, principal, job, request)
            await rows.retry_job(
                connection, service.job_queue, job_id, from_start=request.start == "start", revised=revised
            )
            return job_id

        named = fingerprint(
            "retry", str(job_id), request.start, *([request.options] if request.options else [])
        )
        with collect_notices() as notices:
            await create_once(connection, principal, idempotency_key, named, make)
        job = await fetch_visible_job(connection, principal, job_id)
        view = await job_view(connection, service, principal, job)
        return view.model_copy(update={"notes": [*view.notes, *notices]})


async def _is_repeated(service: Service, principal: Principal, key: str | None) -> bool:
    """Return whether a request was answered before, on a connection of its own."""
    if key is None:
        return False
    async with service.pool.connection() as connection:
        return await is_repeated(connection, principal, key)


async def _create_job(
    connection: Connection, service: Service, principal: Principal, requested: _RequestedJob
) -> uuid.UUID:
    new, kind = requested.new, requested.kind
    # Before the rows of the inputs are locked, see workers.db.locks.
    await lock_owner(connection, principal.owner)
    inputs = await _check_inputs(connection, principal, requested)
    await check_new_job(connection, principal.owner, service.settings.quota)
    workers = await live_workers_of_queue(connection, new.queue, service.settings.stale_seconds)
    check_formats_writable(kind, inputs.options, new.queue, workers)
    sizes = await photograph_sizes(connection, inputs.dataset_id) if inputs.dataset_id is not None else []
    check_job_limits(kind, inputs.options, sizes, service.settings)
    estimate = estimate_job(kind, inputs.options, sizes, workers)
    check_workers_large_enough(kind.resource_demands(inputs.options, sizes), estimate, new.queue, workers)
    made = rows.NewJob(
        owner=principal.owner,
        kind=kind.name,
        options=without_defaults(inputs.options),
        requested=with_decisions(kind, requested.requested, requested.options, inputs.options),
        queue=new.queue,
        priority=new.priority,
        dataset_id=inputs.dataset_id,
        source_id=inputs.source_id,
        label=new.label,
        estimate=_estimate_as_json(estimate),
        files_id=inputs.files_id,
        traceparent=requested.traceparent,
    )
    job_id = (await rows.create_job(connection, service.job_queue, made)).id
    if new.webhook is not None:
        await add_endpoint(
            connection,
            owner=principal.owner,
            url=new.webhook.url,
            secret=new.webhook.secret,
            events=new.webhook.events,
            job_id=job_id,
        )
    return job_id


async def _check_inputs(connection: Connection, principal: Principal, requested: _RequestedJob) -> _JobInputs:
    """Return the inputs of the job, checked."""
    needed = {"result": _check_source, "dataset": _check_dataset, "files": _check_files}[requested.kind.needs]
    inputs = await needed(connection, principal, requested)
    files_id = requested.new.files_id
    await check_named_files(connection, principal, requested.kind, inputs.options, files_id)
    return replace(inputs, files_id=files_id)


async def _check_source(connection: Connection, principal: Principal, requested: _RequestedJob) -> _JobInputs:
    new, kind = requested.new, requested.kind
    if new.source_id is None:
        raise input_problem("source_id", f"The kind {kind.name} works on source_id, a finished job.")
    if new.dataset_id is not None and not kind.takes_other_photographs:
        detail = f"The kind {kind.name} works on source_id alone, a finished job."
        raise input_problem("dataset_id", detail)
    # Locked, so that it is not deleted before the new job refers to it.
    source = await rows.get_job(connection, new.source_id, lock=True)
    if source is None or not principal.may_see(source.owner):
        raise input_problem("source_id", "There is no such job.")
    names = {artifact.name for artifact in await rows.artifacts_of(connection, source.id)}
    # A job that failed may have finished a scene before.
    if source.state != "succeeded" and not (source.state == "failed" and names):
        raise ProblemError(409, "source", f"The job in source_id is {source.state} and has no results.")
    if kind.source_files and kind.source_files[0] not in names:
        raise input_problem("source_id", f"The job in source_id has no {kind.source_files[0]}.")
    if new.dataset_id is not None and kind.takes_other_photographs:
        dataset = await _get_photographs(connection, principal, new.dataset_id)
        if not dataset.has_poses:
            detail = "The dataset holds no COLMAP model, which says where in the scene its photographs are."
            raise input_problem("dataset_id", detail)
        return _JobInputs(dataset.id, source.id, kind.for_other_photographs(requested.options))
    if source.dataset_id is None and kind.needs_photographs(requested.options):
        detail = (
            "The scene of the job in source_id is not where photographs show it; name some as dataset_id."
        )
        raise input_problem("source_id", detail)
    # Where the result has moved, the photographs do not show it any more.
    return _JobInputs(source.dataset_id if kind.keeps_world_frame else None, source.id, requested.options)


async def _check_files(connection: Connection, principal: Principal, requested: _RequestedJob) -> _JobInputs:
    new, name = requested.new, requested.kind.name
    for place in ("source_id", "dataset_id"):
        if getattr(new, place) is not None:
            raise input_problem(place, f"A job of the kind {name} works on files_id alone.")
    if new.files_id is None:
        detail = f"A job of the kind {name} works on files_id, a dataset that holds files."
        raise input_problem("files_id", detail)
    return _JobInputs(None, None, requested.options)


async def _check_dataset(
    connection: Connection, principal: Principal, requested: _RequestedJob
) -> _JobInputs:
    new, kind, options = requested.new, requested.kind, requested.options
    source, dataset_id = None, new.dataset_id
    if kind.may_start_from_result and new.source_id is not None:
        source = await fetch_start_source(connection, principal, kind, new.source_id)
        options, dataset_id = options_with_start(kind, options), dataset_id or source.dataset_id
        if dataset_id is None:
            detail = "The photographs of the job in source_id were deleted; name some as dataset_id."
            raise input_problem("dataset_id", detail)
    elif kind.starts_from_result(options):
        raise input_problem("source_id", "The options are of a job that begins with another; name source_id.")
    elif dataset_id is None or new.source_id is not None:
        raise input_problem("dataset_id", f"A job of the kind {kind.name} works on dataset_id, a dataset.")
    dataset = await _get_photographs(connection, principal, dataset_id)
    if kind.needs_poses(options) and not dataset.has_poses:
        detail = "The dataset holds no COLMAP model; set the option poses to auto, or send a model."
        raise ProblemError(422, "poses", detail, errors=[{"pointer": "#/options/poses", "detail": detail}])
    source_id = None if source is None else source.id
    return _JobInputs(dataset.id, source_id, kind.with_poses_known(options, dataset.has_poses))


async def _get_photographs(connection: Connection, principal: Principal, dataset_id: uuid.UUID) -> Dataset:
    """Return a dataset of photographs that is ready."""
    dataset = await get_dataset(connection, dataset_id, lock=True)
    if dataset is None or not principal.may_see(dataset.owner):
        raise input_problem("dataset_id", "There is no such dataset.")
    if dataset.holds != "photographs":
        raise input_problem("dataset_id", "The dataset holds no photographs; give it as files_id.")
    if dataset.state != "committed":
        raise ProblemError(
            409, "dataset-open", "The dataset is not committed yet; POST to its /commit first."
        )
    return dataset


@dataclass(frozen=True)
class _Retry:
    """A job that is to be tried again: its kind, its options before and now, and whether it goes on."""

    kind: JobKind
    before: BaseModel
    revised: ResolvedOptions
    is_resumed: bool


async def _resolve_retry(job: Job, request: RetryRequest) -> _Retry | None:
    """Return what a retry asks for, validated; None where a job of another version is left as it is.

    Raises:
        ProblemError: 409 or 422.
    """
    try:
        kind = get_job_kind(job.kind)
        before = expected_options(kind, job)
    except (ConfigError, ValidationError):
        if not request.options:
            return None
        detail = "The job is of another version, so its options cannot be changed; make a new one."
        raise ProblemError(409, "version", detail) from None
    is_resumed = request.start == "checkpoint" and job.checkpoint is not None
    if lacks_source(kind, before, job, is_resumed=is_resumed):
        raise ProblemError(409, "source", "The job whose results it works on was deleted; make a new job.")
    revised = ResolvedOptions(before, job.requested)
    if request.options:
        revised = await revise_options(kind, revised, request.options, is_resumed=is_resumed)
    return _Retry(kind, before, revised, is_resumed)


async def _check_retried_meshes(
    service: Service, principal: Principal, job_id: uuid.UUID, request: RetryRequest
) -> None:
    """Check the meshes of a job that is to be tried again; see :func:`check_glass_meshes`."""
    async with service.pool.connection() as connection:
        job = await fetch_visible_job(connection, principal, job_id)
    # Without files it has no meshes; one that waits, runs or has succeeded is not tried again.
    if job.files_id is None or job.state not in ("failed", "canceled"):
        return
    if (retry := await _resolve_retry(job, request)) is not None:
        await check_glass_meshes(service, principal, retry.kind, retry.revised.complete, job.files_id)


async def _revised_options(
    connection: Connection, service: Service, principal: Principal, job: Job, request: RetryRequest
) -> rows.RevisedOptions | None:
    """Return the checked options of a retried job; None leaves them as they are."""
    workers = await live_workers_of_queue(connection, job.queue, service.settings.stale_seconds)
    retry = await _resolve_retry(job, request)
    if retry is None:
        return None
    kind, before, revised, is_resumed = retry.kind, retry.before, retry.revised, retry.is_resumed
    options = revised.complete
    # Also where nothing is changed: workers and limits may be others than when the job was accepted.
    check_formats_writable(kind, options, job.queue, workers)
    await check_named_files(connection, principal, kind, options, job.files_id)
    sizes = await photograph_sizes(connection, job.dataset_id) if job.dataset_id is not None else []
    check_job_limits(kind, options, sizes, service.settings)
    estimate = estimate_job(kind, options, sizes, workers)
    check_workers_large_enough(kind.resource_demands(options, sizes), estimate, job.queue, workers)
    if not request.options:
        return None
    if kind.needs == "dataset" and job.dataset_id is not None:
        dataset = await get_dataset(connection, job.dataset_id)
        options = kind.with_poses_known(options, dataset is not None and dataset.has_poses)
    if is_resumed and not kind.is_resumable_with(before, options):
        detail = "With these options the work begins anew; ask for that with from: start."
        raise ProblemError(422, "other-work", detail, errors=[{"pointer": "#/options", "detail": detail}])
    return rows.RevisedOptions(
        options=without_defaults(options),
        requested=with_decisions(kind, revised.requested, revised.complete, options),
        settings=options.model_dump(mode="json") if is_resumed else None,
        estimate=_estimate_as_json(estimate),
    )


def _estimate_as_json(estimate: Estimate | None) -> dict[str, Any] | None:
    """Return an estimate as the table keeps it."""
    return None if estimate is None else estimate.model_dump(mode="json")

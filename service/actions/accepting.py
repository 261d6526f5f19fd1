"""Jobs taken on: new ones, and those that are tried again."""

import uuid
from dataclasses import dataclass, replace
from typing import Any

from pydantic import BaseModel, ValidationError

from octasplat.engine.errors import ConfigError
from octasplat.engine.operations.costs import Estimate
from octasplat.engine.refusals import SettingsRefused
from octasplat.engine.renamed_settings import collected_notices
from octasplat.service.actions.access import owned_job, refuse_while_draining
from octasplat.service.actions.asked import accepted_kind, input_problem, resolved
from octasplat.service.actions.jobs import job_view
from octasplat.service.actions.named_files import check_named_files
from octasplat.service.auth import Principal
from octasplat.service.idempotency import fingerprint, once
from octasplat.service.limits import check_ceilings, check_priority, estimate_job
from octasplat.service.problems import Problem, refused_options
from octasplat.service.queue_facts import check_writable, workers_of
from octasplat.service.schemas.jobs import JobView, NewJob, RetryRequest
from octasplat.service.state import Service
from octasplat.service.webhook_addresses import check_address
from octasplat.workers.queue import jobs as rows
from octasplat.workers.records.database import Connection, tried_again
from octasplat.workers.records.datasets import get_dataset, photograph_sizes
from octasplat.workers.records.locks import lock_owner
from octasplat.workers.records.quotas import check_new_job
from octasplat.workers.records.rows import Dataset, Job
from octasplat.workers.upkeep.webhooks.rows import add_endpoint
from octasplat.workers.work.kinds import JobKind, kind_named


@dataclass(frozen=True)
class _Asked:
    """A new job as it was asked for: its kind and the complete options."""

    new: NewJob
    kind: JobKind
    options: BaseModel
    traceparent: str | None


@dataclass(frozen=True)
class _Inputs:
    """What a job works on, and the options that fit it."""

    dataset_id: uuid.UUID | None
    source_id: uuid.UUID | None
    options: BaseModel
    files_id: uuid.UUID | None = None


@tried_again
async def accept_job(
    service: Service, who: Principal, new: NewJob, *, key: str | None = None, traceparent: str | None = None
) -> JobView:
    """Accept a job.

    Args:
        service: the service.
        who: asks.
        new: the job.
        key: the same request with it makes nothing new.
        traceparent: what the job's log is to name (W3C Trace Context).

    Raises:
        Problem: 409, 422, or 503 if the service is about to stop.
        QuotaExceeded: the asker has too many jobs.
    """
    refuse_while_draining(service)
    kind = accepted_kind(new.kind)
    with collected_notices() as notices:
        asked = _Asked(new, kind, resolved(kind, new.options), traceparent)
    check_priority(who, new.priority, service.settings)
    if new.webhook is not None:
        check_address(service, new.webhook.url, "#/webhook/url")
    async with service.pool.connection() as connection, connection.transaction():

        async def make() -> uuid.UUID:
            return await _make_job(connection, service, who, asked)

        # Without what was not asked for: a version that knows more may get the repetition.
        named = fingerprint("job", new.model_dump(mode="json", exclude_defaults=True))
        job_id, _ = await once(connection, who, key, named, make)
        view = await job_view(connection, service, await owned_job(connection, who, job_id))
        return view.model_copy(update={"notes": [*view.notes, *notices]})


@tried_again
async def retry_job(
    service: Service, who: Principal, job_id: uuid.UUID, asked: RetryRequest, *, key: str | None = None
) -> JobView:
    """Queue a failed or cancelled job again.

    Args:
        service: the service.
        who: asks.
        job_id: the job.
        asked: where it begins, and with which options.
        key: the same request with it does nothing more.

    Raises:
        Problem: 404, 409 or 422.
        Conflict: it waits, runs or has succeeded.
        QuotaExceeded: its owner has too many jobs.
    """
    async with service.pool.connection() as connection, connection.transaction():
        owner = (await owned_job(connection, who, job_id)).owner

        async def make() -> uuid.UUID:
            await lock_owner(connection, owner)
            job = await owned_job(connection, who, job_id, lock=True)
            await check_new_job(connection, owner, service.settings.quota)
            options, estimate = await _revised(connection, service, who, job, asked)
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
        with collected_notices() as notices:
            await once(connection, who, key, named, make)
        view = await job_view(connection, service, await owned_job(connection, who, job_id))
        return view.model_copy(update={"notes": [*view.notes, *notices]})


async def _make_job(connection: Connection, service: Service, who: Principal, asked: _Asked) -> uuid.UUID:
    new, kind = asked.new, asked.kind
    await lock_owner(connection, who.owner)
    inputs = await _inputs(connection, who, asked)
    await check_new_job(connection, who.owner, service.settings.quota)
    workers = await workers_of(connection, new.queue, service.settings.stale_seconds)
    check_writable(kind, inputs.options, new.queue, workers)
    sizes = await photograph_sizes(connection, inputs.dataset_id) if inputs.dataset_id is not None else []
    check_ceilings(kind, inputs.options, sizes, service.settings)
    made = rows.NewJob(
        owner=who.owner,
        kind=kind.name,
        options=inputs.options.model_dump(mode="json"),
        queue=new.queue,
        priority=new.priority,
        dataset_id=inputs.dataset_id,
        source_id=inputs.source_id,
        label=new.label,
        estimate=_stored(estimate_job(kind, inputs.options, sizes, workers)),
        files_id=inputs.files_id,
        traceparent=asked.traceparent,
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


async def _inputs(connection: Connection, who: Principal, asked: _Asked) -> _Inputs:
    """What the job works on, checked."""
    needed = {"result": _source, "dataset": _dataset, "files": _files}[asked.kind.needs]
    inputs = await needed(connection, who, asked)
    files_id = asked.new.files_id
    await check_named_files(connection, who, asked.kind, inputs.options, files_id)
    return replace(inputs, files_id=files_id)


async def _source(connection: Connection, who: Principal, asked: _Asked) -> _Inputs:
    new, kind = asked.new, asked.kind
    if new.source_id is None:
        raise input_problem("source_id", f"The kind {kind.name} works on source_id, a finished job.")
    if new.dataset_id is not None and not kind.takes_other_photographs:
        detail = f"The kind {kind.name} works on source_id alone, a finished job."
        raise input_problem("dataset_id", detail)
    source = await rows.get_job(connection, new.source_id, lock=True)
    if source is None or not who.owns(source.owner):
        raise input_problem("source_id", "There is no such job.")
    names = {artifact.name for artifact in await rows.artifacts_of(connection, source.id)}
    if source.state != "succeeded" and not (source.state == "failed" and names):
        raise Problem(409, "source", f"The job in source_id is {source.state} and has no results.")
    if kind.source_files and kind.source_files[0] not in names:
        raise input_problem("source_id", f"The job in source_id has no {kind.source_files[0]}.")
    if new.dataset_id is not None and kind.takes_other_photographs:
        dataset = await _photographs(connection, who, new.dataset_id)
        if not dataset.has_poses:
            detail = "The dataset holds no COLMAP model, which says where in the scene its photographs are."
            raise input_problem("dataset_id", detail)
        return _Inputs(dataset.id, source.id, kind.on_other_photographs(asked.options))
    if source.dataset_id is None and kind.needs_photographs(asked.options):
        detail = (
            "The scene of the job in source_id is not where photographs show it; name some as dataset_id."
        )
        raise input_problem("source_id", detail)
    return _Inputs(source.dataset_id if kind.keeps_world else None, source.id, asked.options)


async def _files(connection: Connection, who: Principal, asked: _Asked) -> _Inputs:
    new, name = asked.new, asked.kind.name
    for place in ("source_id", "dataset_id"):
        if getattr(new, place) is not None:
            raise input_problem(place, f"A job of the kind {name} works on files_id alone.")
    if new.files_id is None:
        detail = f"A job of the kind {name} works on files_id, a dataset that holds files."
        raise input_problem("files_id", detail)
    return _Inputs(None, None, asked.options)


async def _dataset(connection: Connection, who: Principal, asked: _Asked) -> _Inputs:
    new, kind = asked.new, asked.kind
    if new.dataset_id is None or new.source_id is not None:
        raise input_problem("dataset_id", f"A job of the kind {kind.name} works on dataset_id, a dataset.")
    dataset = await _photographs(connection, who, new.dataset_id)
    if kind.needs_poses(asked.options) and not dataset.has_poses:
        detail = "The dataset holds no COLMAP model; set the option poses to auto, or send a model."
        raise Problem(422, "poses", detail, errors=[{"pointer": "#/options/poses", "detail": detail}])
    return _Inputs(dataset.id, None, kind.settle(asked.options, dataset.has_poses))


async def _photographs(connection: Connection, who: Principal, dataset_id: uuid.UUID) -> Dataset:
    """A dataset of photographs that is ready."""
    dataset = await get_dataset(connection, dataset_id, lock=True)
    if dataset is None or not who.owns(dataset.owner):
        raise input_problem("dataset_id", "There is no such dataset.")
    if dataset.holds != "photographs":
        raise input_problem("dataset_id", "The dataset holds no photographs; give it as files_id.")
    if dataset.state != "committed":
        raise Problem(409, "dataset-open", "The dataset is not committed yet; POST to its /commit first.")
    return dataset


async def _revised(
    connection: Connection, service: Service, who: Principal, job: Job, asked: RetryRequest
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
    if kind.needs == "result" and job.source_id is None:
        raise Problem(409, "source", "The job whose results it works on was deleted; make a new job.")
    try:
        options = kind.revised(job.options, asked.options) if asked.options else before
    except (ValidationError, SettingsRefused) as error:
        raise refused_options(error) from None
    check_writable(kind, options, job.queue, workers)
    await check_named_files(connection, who, kind, options, job.files_id)
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
    return options.model_dump(mode="json"), _stored(estimate_job(kind, options, sizes, workers))


def _stored(estimate: Estimate | None) -> dict[str, Any] | None:
    """An estimate as the table keeps it."""
    return None if estimate is None else estimate.model_dump(mode="json")

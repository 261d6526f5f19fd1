"""Routes of jobs: created, listed, read, cancelled, retried, deleted."""

import hashlib
import json
import uuid
from typing import Annotated

from fastapi import APIRouter, Query, Request, Response

from octasplat.service.actions import jobs as actions
from octasplat.service.actions.jobs import BUSY_RETRY_SECONDS, JobFilter, JobWithView, stages_of
from octasplat.service.actions.submission import retry_job as retry_again
from octasplat.service.actions.submission import submit_job
from octasplat.service.actions.usage import rate_limit_headers
from octasplat.service.auth import Reader, Writer
from octasplat.service.etags import check_precondition, set_etag, unless_unchanged
from octasplat.service.paging import Cursor, Limit, decode_id_cursor, set_next_link
from octasplat.service.routes import problem_responses
from octasplat.service.routes.parameters import IdempotencyKey, IfMatch, IfNoneMatch, JobId
from octasplat.service.routes.response_headers import (
    ETAG,
    LINK,
    LOCATION,
    RATE_LIMIT,
    RETRY_AFTER,
    not_modified,
    with_headers,
)
from octasplat.service.schemas.jobs import JobChange, JobPage, JobSummary, JobView, NewJob, RetryRequest
from octasplat.service.state import ServiceDep
from octasplat.workers.db.rows import JobState
from octasplat.workers.queue.jobs import JobOrder

router = APIRouter(prefix="/v1/jobs", tags=["jobs"])

_MAX_RETRY_SECONDS = 30
ACCEPTED = with_headers(202, LOCATION, RETRY_AFTER)
ACCEPTED_NEW = with_headers(202, LOCATION, RETRY_AFTER, *RATE_LIMIT)


@router.post("", status_code=202, responses={**ACCEPTED_NEW, **problem_responses(404, 409)})
async def create_job(
    new: NewJob, principal: Writer, service: ServiceDep, request: Request, response: Response,
    key: IdempotencyKey = None,
) -> JobView:  # fmt: skip
    """Create a job; poll the address in `Location`, or listen to its `/events`."""
    traceparent = request.headers.get("traceparent", "")[:100] or None
    view = await submit_job(service, principal, new, idempotency_key=key, traceparent=traceparent)
    _set_location(response, view)
    response.headers.update(await rate_limit_headers(service, principal, "jobs"))
    return view


@router.get("", responses={**with_headers(200, LINK), **problem_responses()})
async def list_jobs(
    principal: Reader, service: ServiceDep, request: Request, response: Response,
    state: Annotated[
        list[JobState] | None, Query(description="Jobs in this state; may be given several times.")
    ] = None,
    kind: Annotated[str | None, Query(max_length=40, description="Jobs of this kind.")] = None,
    label: Annotated[str | None, Query(max_length=200, description="Jobs of this label.")] = None,
    dataset_id: Annotated[uuid.UUID | None, Query(description="Jobs on this dataset.")] = None,
    order: Annotated[
        JobOrder,
        Query(description="Newest first, oldest first, by name, best PSNR first, longest work first."),
    ] = "newest",
    limit: Limit = 50,
    cursor: Cursor = None,
) -> JobPage:  # fmt: skip
    """List your jobs, newest first unless asked otherwise; their options are at the address of each."""
    job_filter = JobFilter(state or (), kind, label, dataset_id, order=order)
    part = await actions.list_jobs(
        service, principal, job_filter, before=decode_id_cursor(cursor), limit=limit
    )
    following = set_next_link(request, response, part.next_key)
    shows_worker = principal.may("admin")
    views = [JobSummary.from_row(job, stages_of(job), shows_worker=shows_worker) for job in part.rows]
    return JobPage(jobs=views, next=following)


@router.get(
    "/{job_id}",
    responses={**with_headers(200, ETAG, RETRY_AFTER), **not_modified(), **problem_responses(404)},
)
async def get_job(
    job_id: JobId,
    principal: Reader,
    service: ServiceDep,
    response: Response,
    if_none_match: IfNoneMatch = None,
) -> JobView:
    """Return a job; polling with `If-None-Match` is cheap."""
    job = await actions.get_job(service, principal, job_id)
    if not job.row.is_over:
        _set_retry_after(response, job.view)
    return unless_unchanged(response, if_none_match, _job_etag(job), job.view)


@router.patch("/{job_id}", responses={**with_headers(200, ETAG), **problem_responses(404, 412)})
async def change_job(
    job_id: JobId, change: JobChange, principal: Writer, service: ServiceDep, response: Response,
    if_match: IfMatch = None,
) -> JobView:  # fmt: skip
    """Rename a job, pin it so that it does not expire, or replace the notes in its 3D view."""

    def check(job: JobWithView) -> None:
        check_precondition(if_match, _job_etag(job))

    changed = await actions.change_job(service, principal, job_id, change, check)
    set_etag(response, _job_etag(changed))
    return changed.view


@router.post("/{job_id}/cancel", status_code=202, responses={**ACCEPTED, **problem_responses(404, 409)})
async def cancel_job(
    job_id: JobId, principal: Writer, service: ServiceDep, response: Response, key: IdempotencyKey = None
) -> JobView:
    """Cancel a job; may be repeated. Its checkpoint stays, so that a retry resumes from it."""
    view = await actions.cancel_job(service, principal, job_id, idempotency_key=key)
    _set_location(response, view)
    return view


@router.post("/{job_id}/retry", status_code=202, responses={**ACCEPTED, **problem_responses(404, 409)})
async def retry_job(
    job_id: JobId, principal: Writer, service: ServiceDep, response: Response,
    retry: RetryRequest | None = None, key: IdempotencyKey = None,
) -> JobView:  # fmt: skip
    """Queue a failed or cancelled job again, from its newest checkpoint or from the start.

    With other options if some are given: a reconstruction whose files could not be written goes on from its
    trained scene with other `exports`.
    """
    request_body = retry or RetryRequest(start="checkpoint")
    view = await retry_again(service, principal, job_id, request_body, idempotency_key=key)
    _set_location(response, view)
    return view


@router.delete("/{job_id}", status_code=204, responses=problem_responses(404, 409))
async def delete_job(
    job_id: JobId, principal: Writer, service: ServiceDep,
    cancel: Annotated[bool, Query(description="Stop it first if it is not over.")] = False,
) -> None:  # fmt: skip
    """Delete a finished job with its results; repeat the request for one that is still stopping."""
    await actions.delete_job(service, principal, job_id, cancel=cancel)


def _job_etag(job: JobWithView) -> str:
    view = job.view
    # The version of the row counts neither other jobs, as those of its blocks, nor what notes say of workers.
    place = "" if view.queue_position is None else f".{view.queue_position}"
    if view.blocks and not job.row.is_over:
        blocks = json.dumps([block.model_dump(mode="json") for block in view.blocks])
        place += f".{hashlib.sha256(blocks.encode()).hexdigest()[:16]}"
    if view.notes:
        place += f".{hashlib.sha256(json.dumps(view.notes).encode()).hexdigest()[:16]}"
    return f'"{job.row.version}{place}"'


def _set_location(response: Response, view: JobView) -> None:
    response.headers["Location"] = f"/v1/jobs/{view.id}"
    _set_retry_after(response, view)


def _set_retry_after(response: Response, view: JobView) -> None:
    """Set `Retry-After`, shorter for jobs that advance."""
    ahead = view.queue_position or 0
    response.headers["Retry-After"] = str(min(_MAX_RETRY_SECONDS, BUSY_RETRY_SECONDS + ahead))

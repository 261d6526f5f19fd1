"""Pages besides those of single jobs: variants, datasets, usage, administration, several jobs at once."""

import urllib.parse
import uuid
from typing import Annotated, Literal

from fastapi import APIRouter, Query, Request, Response

from octasplat.engine.core.errors import OctasplatError
from octasplat.service.actions import datasets as dataset_actions
from octasplat.service.actions import jobs as job_actions
from octasplat.service.actions.system import list_queues, set_queue_paused, set_worker_drained
from octasplat.service.actions.usage import read_usage
from octasplat.service.auth import Admin, Reader, Writer
from octasplat.service.paging import decode_id_cursor, encode_cursor
from octasplat.service.problems import ProblemError, problem_from_error
from octasplat.service.state import ServiceDep
from octasplat.service.web.comparison import compare_jobs
from octasplat.service.web.routing import PageRoute, redirect
from octasplat.service.web.templating import render_page
from octasplat.workers.db.datasets import dataset_sizes

router = APIRouter(route_class=PageRoute, include_in_schema=False)

PAGE_SIZE = 50
MAX_COMPARED = 8
_MAX_FORM_BYTES = 1 << 16
Cursor = Annotated[str | None, Query(max_length=200)]


@router.get("/compare")
async def show_comparison(
    request: Request,
    principal: Reader,
    service: ServiceDep,
    job: Annotated[list[uuid.UUID] | None, Query(max_length=MAX_COMPARED)] = None,
    view: Annotated[str | None, Query(max_length=1000)] = None,
) -> Response:
    """Return the page that shows jobs side by side: figures, settings that differ, renders."""
    compared = await compare_jobs(service, principal, list(dict.fromkeys(job or ())), view)
    return render_page(request, "compare.html", principal, compared=compared)


@router.get("/datasets")
async def show_datasets(
    request: Request, principal: Reader, service: ServiceDep, cursor: Cursor = None
) -> Response:
    """Return the page of the datasets, with what each takes on the disk."""
    part = await dataset_actions.list_datasets(
        service, principal, before=decode_id_cursor(cursor), limit=PAGE_SIZE
    )
    async with service.pool.connection() as connection:
        sizes = await dataset_sizes(connection, [row.id for row in part.rows])
    return render_page(
        request,
        "datasets.html",
        principal,
        datasets=part.rows,
        sizes=sizes,
        next=None if part.next_key is None else encode_cursor(part.next_key),
        cursor=cursor,
    )


@router.post("/datasets/{dataset_id}/delete")
async def delete_dataset(
    request: Request, dataset_id: uuid.UUID, principal: Writer, service: ServiceDep
) -> Response:
    """Delete a dataset and return to the list."""
    await dataset_actions.delete_dataset(service, principal, dataset_id)
    return redirect(request, "/datasets")


@router.get("/usage")
async def show_usage(request: Request, principal: Reader, service: ServiceDep) -> Response:
    """Return the page of what the owner takes and may take, and the queues."""
    return render_page(
        request,
        "usage.html",
        principal,
        usage=await read_usage(service, principal),
        queues=await list_queues(service, principal),
    )


@router.get("/admin")
async def show_admin(request: Request, principal: Admin, service: ServiceDep) -> Response:
    """Return the page of the queues and the workers, with what pauses and drains them."""
    queues = await list_queues(service, principal)
    return render_page(request, "admin.html", principal, queues=queues)


@router.post("/admin/queues/{queue}")
async def pause_queue(
    request: Request, queue: str, principal: Admin, service: ServiceDep, paused: bool
) -> Response:
    """Pause a queue or let it go on, and return to the page."""
    await set_queue_paused(service, principal, queue, paused)
    return redirect(request, "/admin")


@router.post("/admin/workers/{worker:path}")
async def drain_worker(
    request: Request, worker: str, principal: Admin, service: ServiceDep, drained: bool
) -> Response:
    """Drain a worker or let it take jobs again, and return to the page."""
    await set_worker_drained(service, principal, worker, drained)
    return redirect(request, "/admin")


@router.post("/jobs/chosen")
async def change_chosen_jobs(
    request: Request, principal: Writer, service: ServiceDep, do: Literal["cancel", "delete"]
) -> Response:
    """Cancel or delete the jobs that are chosen in the list, as far as that is possible."""
    body = (await request.body())[:_MAX_FORM_BYTES].decode(errors="replace")
    refusals = []
    for text in urllib.parse.parse_qs(body).get("job", ()):
        # What can be done is done, and all refusals are told together at the end.
        try:
            job_id = uuid.UUID(text)
        except ValueError:
            refusals.append(f"{text[:40]} is no id of a job.")
            continue
        try:
            if do == "cancel":
                await job_actions.cancel_job(service, principal, job_id)
            else:
                await job_actions.delete_job(service, principal, job_id, cancel=True)
        except ProblemError as problem:
            refusals.append(problem.detail)
        except OctasplatError as error:
            refusals.append(problem_from_error(error).detail)
    if refusals:
        raise ProblemError(409, "some-refused", " ".join(dict.fromkeys(refusals)))
    return redirect(request, "/")

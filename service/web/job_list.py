"""The page with the list of jobs: searched, narrowed to states and a kind, sorted, a part at a time."""

import urllib.parse
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Depends, Query, Request, Response
from pydantic import BaseModel, Field

from octasplat.service.auth import Reader
from octasplat.service.paging import decode_id_cursor, encode_cursor
from octasplat.service.state import ServiceDep
from octasplat.service.web.routing import PageRoute
from octasplat.service.web.templating import render_page
from octasplat.service.web.view_models import job_counts, list_job_rows
from octasplat.workers.queue.jobs import JobOrder
from octasplat.workers.worker.job_kinds import job_kinds

router = APIRouter(route_class=PageRoute, include_in_schema=False)

PAGE_SIZE = 30
ORDERS = {
    "newest": "Newest first",
    "oldest": "Oldest first",
    "name": "By name",
    "psnr": "Best PSNR first",
    "longest": "Longest work first",
}
"""How the list may be sorted, in words."""


class ListChoice(BaseModel):
    """What the list shows, by the address."""

    show: Literal["all", "active", "done", "failed"] = "all"
    q: str = Field("", max_length=100)
    kind: str = Field("", max_length=40)
    order: JobOrder = "newest"
    cursor: str | None = Field(None, max_length=200)


async def _job_list_context(
    principal: Reader, service: ServiceDep, choice: Annotated[ListChoice, Query()]
) -> dict[str, Any]:
    """Return what the list of jobs shows."""
    text = choice.q.strip()
    part = await list_job_rows(
        service,
        principal,
        choice.show,
        decode_id_cursor(choice.cursor),
        PAGE_SIZE,
        text=text or None,
        kind=choice.kind or None,
        order=choice.order,
    )
    given = {"q": text, "kind": choice.kind, "order": "" if choice.order == "newest" else choice.order}
    given = {name: value for name, value in given.items() if value}
    return {
        "lines": part.rows,
        "next": None if part.next_key is None else encode_cursor(part.next_key),
        "counts": await job_counts(service, principal),
        "show": choice.show,
        "cursor": choice.cursor,
        "search": text,
        "kind": choice.kind,
        "kinds": [kind.name for kind in job_kinds()],
        "order": choice.order,
        "orders": ORDERS,
        "narrowed": urllib.parse.urlencode(given),
        "query": urllib.parse.urlencode({"show": choice.show, **given}),
    }


JobListContext = Annotated[dict[str, Any], Depends(_job_list_context)]


@router.get("/")
async def show_jobs(request: Request, principal: Reader, context: JobListContext) -> Response:
    """Return the page with the list of jobs."""
    return render_page(request, "jobs.html", principal, **context)


@router.get("/parts/jobs")
async def show_job_list(request: Request, principal: Reader, context: JobListContext) -> Response:
    """Return the list of jobs without its page."""
    return render_page(request, "_jobs.html", principal, **context)

"""Routes of pages: what is a problem document elsewhere is a page here, and who is unknown signs in."""

import json
import logging
import urllib.parse
from collections.abc import Callable, Coroutine
from typing import Any

import psycopg
from fastapi import Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import RedirectResponse
from fastapi.routing import APIRoute
from psycopg_pool import PoolTimeout

from octasplat.engine.errors import OctasplatError
from octasplat.service.problems import Problem, not_found, problem_of
from octasplat.service.web.templating import page

logger = logging.getLogger(__name__)
Handler = Callable[[Request], Coroutine[Any, Any, Response]]


class PageRoute(APIRoute):
    """A route whose errors are pages, or, for parts of pages, a notice on the page that asked."""

    def get_route_handler(self) -> Handler:
        """The handler with its errors caught."""
        inner = super().get_route_handler()

        async def handler(request: Request) -> Response:
            try:
                return await inner(request)
            except Problem as problem:
                return _answer(request, problem)
            except RequestValidationError:
                return _answer(request, not_found("page"))
            except OctasplatError as error:
                return _answer(request, problem_of(error))
            except (psycopg.OperationalError, PoolTimeout) as error:
                logger.warning("the database: %s", " ".join(str(error).split()))
                detail = "The database does not answer; try again in a moment."
                return _answer(request, Problem(503, "database", detail))

        return handler


def is_part(request: Request) -> bool:
    """Whether htmx asks, to change a part of a page."""
    return request.headers.get("hx-request") == "true"


def go_to(request: Request, address: str) -> Response:
    """Send the browser to another page."""
    if is_part(request):
        return Response(headers={"HX-Redirect": address, "HX-Reswap": "none"})
    return RedirectResponse(address, 303)


def local_address(address: str | None) -> str:
    """``address`` if it is a place on this site, else the first page."""
    if not address or not address.startswith("/") or address[1:2] in ("/", "\\"):
        return "/"
    return address if address.isprintable() else "/"


def _answer(request: Request, problem: Problem) -> Response:
    if problem.status == 401:
        where = request.url.path if request.method == "GET" and not is_part(request) else "/"
        if is_part(request):
            where = urllib.parse.urlsplit(request.headers.get("hx-current-url", "/")).path
        return go_to(request, f"/sign-in?next={urllib.parse.quote(local_address(where), safe='/')}")
    if is_part(request):
        notice = json.dumps({"notice": {"text": problem.detail, "bad": True}})
        return Response(status_code=problem.status, headers={"HX-Reswap": "none", "HX-Trigger": notice})
    title = {404: "Not here", 403: "Not allowed", 503: "Not now"}.get(problem.status, "That did not work")
    return page(request, "error.html", status=problem.status, title=title, detail=problem.detail)

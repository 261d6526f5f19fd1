"""Routes of pages: errors are shown as pages, and unauthenticated users are sent to sign in."""

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
from starlette.datastructures import Headers
from starlette.routing import Match, Route
from starlette.types import Scope

from octasplat.engine.core.errors import OctasplatError
from octasplat.service.problems import ProblemError, not_found_error, problem_from_error
from octasplat.service.web.templating import render_page

logger = logging.getLogger(__name__)

MAX_NEXT = 2000
"""Longest address, in characters, that is gone to after a sign-in."""
Handler = Callable[[Request], Coroutine[Any, Any, Response]]


class PageRoute(APIRoute):
    """A route whose errors are pages, or, for parts of pages, a notice on the page that asked."""

    def get_route_handler(self) -> Handler:
        """Return the handler with its errors caught."""
        inner = super().get_route_handler()

        async def handler(request: Request) -> Response:
            try:
                return await inner(request)
            except ProblemError as problem:
                return _error_response(request, problem)
            except RequestValidationError:
                # An address with a part that fits no route's types is that of no page.
                return _error_response(request, not_found_error("page"))
            except OctasplatError as error:
                return _error_response(request, problem_from_error(error))
            except (psycopg.OperationalError, PoolTimeout) as error:
                logger.warning("the database: %s", " ".join(str(error).split()))
                detail = "The database does not answer; try again in a moment."
                return _error_response(request, ProblemError(503, "database", detail))

        return handler


class UnknownPage(Route):
    """The page at addresses that nothing else has, for browsers; programs and the API get a problem."""

    def __init__(self) -> None:
        super().__init__("/{path:path}", _show_unknown_page, include_in_schema=False)

    def matches(self, scope: Scope) -> tuple[Match, Scope]:
        """Match requests of browsers for pages."""
        accepts = Headers(scope=scope).get("accept", "") if scope["type"] == "http" else ""
        is_page = "text/html" in accepts and not scope["path"].startswith("/v1/")
        return super().matches(scope) if is_page and scope["method"] == "GET" else (Match.NONE, {})


async def _show_unknown_page(request: Request) -> Response:
    return _error_response(request, ProblemError(404, "not-found", "There is nothing at this address."))


def is_htmx_request(request: Request) -> bool:
    """Return whether htmx sent the request, to replace a part of a page."""
    return request.headers.get("hx-request") == "true"


def redirect(request: Request, address: str) -> Response:
    """Send the browser to another page."""
    # htmx would follow a redirection itself, and put the page into the part that asked.
    if is_htmx_request(request):
        return Response(headers={"HX-Redirect": address, "HX-Reswap": "none"})
    return RedirectResponse(address, 303)


def safe_local_path(address: str | None) -> str:
    """Return ``address`` if it is a path on this site, else the first page."""
    # Browsers take //host and /\host for other sites.
    if not address or not address.startswith("/") or address[1:2] in ("/", "\\"):
        return "/"
    return address if address.isprintable() else "/"


def _page_of(address: str) -> str:
    """Return path and query of an address on this site, the path alone where that is all that fits."""
    parts = urllib.parse.urlsplit(address)
    whole = f"{parts.path}?{parts.query}" if parts.query else parts.path
    return safe_local_path(whole if len(whole) <= MAX_NEXT else parts.path)


def _error_response(request: Request, problem: ProblemError) -> Response:
    if problem.status == 401:
        # After the sign-in to the page that was asked for, not to an action or a part of a page.
        where = str(request.url) if request.method == "GET" and not is_htmx_request(request) else "/"
        if is_htmx_request(request):
            where = request.headers.get("hx-current-url", "/")
        return redirect(request, f"/sign-in?next={urllib.parse.quote(_page_of(where), safe='/')}")
    if is_htmx_request(request):
        notice = json.dumps({"notice": {"text": problem.detail, "bad": True}})
        return Response(status_code=problem.status, headers={"HX-Reswap": "none", "HX-Trigger": notice})
    title = {404: "Not here", 403: "Not allowed", 503: "Not now"}.get(problem.status, "That did not work")
    return render_page(request, "error.html", status=problem.status, title=title, detail=problem.detail)

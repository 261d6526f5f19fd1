"""Signing in with a token, for browsers: it is kept in a cookie that scripts cannot read."""

import urllib.parse
from typing import Annotated

from fastapi import APIRouter, Query, Request, Response

from service.auth import COOKIE
from service.state import ServiceDep
from service.web.routing import PageRoute, go_to, local_address
from service.web.templating import page
from workers.records.tokens import find_token

router = APIRouter(route_class=PageRoute, include_in_schema=False)

_DAYS = 30
_MAX_FORM_BYTES = 4096


@router.get("/sign-in")
async def show_sign_in(
    request: Request, next: Annotated[str | None, Query(max_length=500)] = None
) -> Response:
    """The form."""
    return page(request, "sign_in.html", next=local_address(next), refused=False)


@router.post("/sign-in")
async def sign_in(request: Request, service: ServiceDep) -> Response:
    """Keep a valid token."""
    body = (await request.body())[:_MAX_FORM_BYTES].decode(errors="replace")
    form = urllib.parse.parse_qs(body)
    secret = form.get("token", [""])[0].strip()
    following = local_address(form.get("next", ["/"])[0])
    async with service.pool.connection() as connection:
        token = await find_token(connection, secret) if secret else None
    if token is None:
        return page(request, "sign_in.html", status=403, next=following, refused=True)
    response = go_to(request, following)
    response.set_cookie(
        COOKIE,
        secret,
        max_age=_DAYS * 86_400,
        httponly=True,
        samesite="strict",
        secure=request.url.scheme == "https",
    )
    return response


@router.post("/sign-out")
async def sign_out(request: Request) -> Response:
    """Forget the token; it stays valid."""
    response = go_to(request, "/sign-in")
    response.delete_cookie(COOKIE, httponly=True, samesite="strict")
    return response

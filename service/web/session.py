"""Sign-in of browsers with a token or a link; the session cookie is not readable by scripts."""

import urllib.parse
from typing import Annotated

from fastapi import APIRouter, Query, Request, Response

from octasplat.service.auth import (
    SECURE_SESSION_COOKIE,
    SESSION_COOKIE,
    Principal,
    authenticate_token,
    principal_of_session,
    session_secret,
)
from octasplat.service.state import Service, ServiceDep
from octasplat.service.web.routing import MAX_NEXT, PageRoute, redirect, safe_local_path
from octasplat.service.web.templating import render_page
from octasplat.workers.db.rows import Token
from octasplat.workers.db.sessions import begin_session, end_session, use_link
from octasplat.workers.db.tokens import get_token

router = APIRouter(route_class=PageRoute, include_in_schema=False)

_MAX_FORM_BYTES = 4096


@router.get("/sign-in")
async def show_sign_in(
    request: Request, next: Annotated[str | None, Query(max_length=MAX_NEXT)] = None
) -> Response:
    """Return the sign-in form."""
    return render_page(request, "sign_in.html", next=safe_local_path(next), refused=False)


@router.post("/sign-in")
async def sign_in(request: Request, service: ServiceDep) -> Response:
    """Begin a session with a valid token."""
    body = (await request.body())[:_MAX_FORM_BYTES].decode(errors="replace")
    form = urllib.parse.parse_qs(body)
    secret = form.get("token", [""])[0].strip()
    following = safe_local_path(form.get("next", ["/"])[0])
    token = await authenticate_token(request, service, secret) if secret else None
    if token is None:
        return render_page(request, "sign_in.html", status=403, next=following, refused=True)
    response = redirect(request, following)
    await _begin_session(request, response, service, token)
    return response


@router.get("/sign-in/once")
async def sign_in_once(
    request: Request, service: ServiceDep, key: Annotated[str, Query(max_length=100)] = ""
) -> Response:
    """Begin a session with a sign-in link, which is used up."""
    # A GET that changes something, which the audit would leave out.
    request.state.is_change = True
    async with service.pool.connection() as connection:
        token_id = await use_link(connection, key)
        token = None if token_id is None else await get_token(connection, token_id)
    if token is None:
        return render_page(
            request,
            "error.html",
            status=403,
            title="Used already",
            detail="This link was opened before or is too old; octasplat open makes another.",
        )
    # A page, as browsers do not send the new cookie to where another program's link is forwarded to.
    response: Response = render_page(request, "signed_in.html")
    await _begin_session(request, response, service, token)
    return response


@router.post("/sign-out")
async def sign_out(request: Request, service: ServiceDep) -> Response:
    """End the session; the API token it was begun with stays valid."""
    secret = session_secret(request)
    if secret is not None:
        # For the audit log, which names who signed out.
        request.state.principal = await principal_of_session(service, secret)
        async with service.pool.connection() as connection:
            await end_session(connection, secret)
    response = redirect(request, "/sign-in")
    # Under both names, as the session may have begun with or without TLS.
    response.delete_cookie(SESSION_COOKIE, httponly=True, samesite="strict")
    response.delete_cookie(SECURE_SESSION_COOKIE, httponly=True, samesite="strict", secure=True)
    return response


async def _begin_session(request: Request, response: Response, service: Service, token: Token) -> None:
    hours = service.settings.session_hours
    async with service.pool.connection() as connection:
        session_id, secret = await begin_session(connection, token, hours)
    request.state.principal = Principal(token.owner, frozenset(token.scopes), token.id, session_id)
    is_secure = request.url.scheme == "https"
    response.set_cookie(
        SECURE_SESSION_COOKIE if is_secure else SESSION_COOKIE,
        secret,
        max_age=int(3600 * hours),
        httponly=True,
        samesite="strict",
        secure=is_secure,
    )

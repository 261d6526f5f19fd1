"""Authentication and rights: tokens with scopes, and sessions begun with one."""

import uuid
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated, Literal

from fastapi import Depends, Request, Security
from fastapi.security import APIKeyCookie, HTTPAuthorizationCredentials, HTTPBearer

from octasplat.service.problems import ProblemError
from octasplat.service.state import Service, ServiceDep
from octasplat.workers.db.audit import add_entry
from octasplat.workers.db.connections import Connection
from octasplat.workers.db.rows import Token
from octasplat.workers.db.sessions import find_session, is_session_valid
from octasplat.workers.db.tokens import find_token, get_token

Scope = Literal["read", "write", "admin", "metrics"]
SESSION_COOKIE = "octasplat_session"
SECURE_SESSION_COOKIE = f"__Host-{SESSION_COOKIE}"
"""Where there is TLS: browsers take it from this very host only, and send it nowhere else."""
_SUFFICIENT_SCOPES: dict[str, frozenset[str]] = {
    "read": frozenset({"read", "write", "admin"}),
    "write": frozenset({"write", "admin"}),
    "admin": frozenset({"admin"}),
    "metrics": frozenset({"metrics", "admin"}),
}
_THROTTLE_RETRY_SECONDS = 5

_bearer = HTTPBearer(auto_error=False, description="A token made with `octasplat token create`.")
_cookie = APIKeyCookie(
    name=SESSION_COOKIE,
    auto_error=False,
    description=f"A browser's session; with TLS it is called {SECURE_SESSION_COOKIE}.",
)


def covered_scopes(scopes: Iterable[str]) -> frozenset[str]:
    """Return these scopes and those that they include."""
    given = set(scopes)
    return frozenset(scope for scope, sufficient in _SUFFICIENT_SCOPES.items() if given & sufficient)


@dataclass(frozen=True)
class Principal:
    """The authenticated caller of a request.

    Attributes:
        owner: whose things they see and make.
        scopes: what they may do.
        token_id: the token that was shown, or that the session was begun with.
        session_id: the session of a browser.
    """

    owner: str
    scopes: frozenset[str]
    token_id: uuid.UUID
    session_id: uuid.UUID | None = None

    def may(self, scope: Scope) -> bool:
        """Return whether the principal has the rights of ``scope``."""
        return scope in covered_scopes(self.scopes)

    @property
    def visible_owner(self) -> str | None:
        """Return the owner whose rows are listed; None lists all owners."""
        return None if self.may("admin") else self.owner

    def may_see(self, owner: str) -> bool:
        """Return whether the principal may see objects of ``owner``."""
        return self.may("admin") or owner == self.owner


async def authenticate(
    request: Request,
    service: ServiceDep,
    bearer: Annotated[HTTPAuthorizationCredentials | None, Security(_bearer)],
    # Only for the OpenAPI document, as the name of the cookie depends on whether there is TLS.
    _described: Annotated[str | None, Security(_cookie)],
) -> Principal:
    """Return the principal of a request.

    Raises:
        ProblemError: 401 without a valid token or session, 429 after too many wrong tokens.
    """
    principal = None
    # A header wins over the cookie that a browser sends along.
    if bearer is not None:
        token = await authenticate_token(request, service, bearer.credentials)
        principal = None if token is None else Principal(token.owner, frozenset(token.scopes), token.id)
    elif (secret := session_secret(request)) is not None:
        principal = await principal_of_session(service, secret)
    if principal is None:
        detail = "A valid token is needed: send the header Authorization: Bearer <token>."
        raise ProblemError(
            401, "unauthorized", detail, headers={"WWW-Authenticate": 'Bearer realm="octasplat"'}
        )
    request.state.principal = principal  # for the audit
    return principal


async def authenticate_token(request: Request, service: Service, secret: str) -> Token | None:
    """Return the valid token of that secret; None after a delay.

    It is looked up before anything is limited, so wrong tokens of the same address, which may be that of a
    whole network, never keep a valid one out.

    Raises:
        ProblemError: 429 for a wrong one while too many of the same address wait for their answer.
    """
    async with service.pool.connection() as connection:
        token = await find_token(connection, secret)
    if token is not None:
        return token
    address = client_address(request)
    if service.login_throttle.is_refused(address):
        detail = "Too many wrong tokens came from this address; try again in a moment."
        raise ProblemError(429, "too-many-guesses", detail, retry_seconds=_THROTTLE_RETRY_SECONDS)
    # Only the first one of a while is recorded, or guesses would fill the table.
    if await service.login_throttle.delay_failure(address):
        async with service.pool.connection() as connection:
            await add_entry(connection, address=address, action="wrong token", status=401)
    return None


def client_address(request: Request) -> str:
    """Return the client's address, as a trusted proxy reports it if there is one."""
    return request.client.host if request.client is not None else "unknown"


def session_secret(request: Request) -> str | None:
    """Return the secret in the session cookie; with TLS, only the host-only cookie counts."""
    return request.cookies.get(SECURE_SESSION_COOKIE if request.url.scheme == "https" else SESSION_COOKIE)


async def principal_of_session(service: Service, secret: str) -> Principal | None:
    """Return the principal of the session with that secret; None if it has expired."""
    async with service.pool.connection() as connection:
        session = await find_session(connection, secret)
        token = None if session is None else await get_token(connection, session.token_id)
    if session is None or token is None:
        return None
    return Principal(token.owner, frozenset(token.scopes), token.id, session.id)


async def is_still_valid(connection: Connection, principal: Principal) -> bool:
    """Return whether the token and the session of a principal still are what they were when it asked."""
    token = await get_token(connection, principal.token_id)
    if token is None or frozenset(token.scopes) != principal.scopes or token.owner != principal.owner:
        return False
    return principal.session_id is None or await is_session_valid(connection, principal.session_id)


class _RequireScope:
    def __init__(self, scope: Scope) -> None:
        self._scope = scope

    def __call__(self, principal: Annotated[Principal, Depends(authenticate)]) -> Principal:
        if not principal.may(self._scope):
            detail = f"This token may not do that; one with the scope '{self._scope}' is needed."
            raise ProblemError(403, "scope", detail)
        return principal


Reader = Annotated[Principal, Depends(_RequireScope("read"))]
Writer = Annotated[Principal, Depends(_RequireScope("write"))]
Admin = Annotated[Principal, Depends(_RequireScope("admin"))]
Monitor = Annotated[Principal, Depends(_RequireScope("metrics"))]

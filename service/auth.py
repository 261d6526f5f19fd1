"""Who asks, and what they may do: bearer tokens with scopes, or nobody in particular on one's own machine."""

import time
from dataclasses import dataclass
from typing import Annotated, Literal

from fastapi import Depends, Request, Security
from fastapi.security import APIKeyCookie, HTTPAuthorizationCredentials, HTTPBearer

from service.problems import Problem
from service.state import Service, ServiceDep
from workers.records.tokens import any_token, find_token

Scope = Literal["read", "write", "admin"]
LOCAL_OWNER = "local"
COOKIE = "octasplat_token"
_IMPLIED: dict[str, frozenset[str]] = {
    "read": frozenset({"read", "write", "admin"}),
    "write": frozenset({"write", "admin"}),
    "admin": frozenset({"admin"}),
}
_OPEN_SECONDS = 2.0

_bearer = HTTPBearer(auto_error=False, description="A token made with `octasplat token create`.")
_cookie = APIKeyCookie(name=COOKIE, auto_error=False, description="The same token, for browsers.")


@dataclass(frozen=True)
class Principal:
    """Who asks.

    Attributes:
        owner: whose things they see and make.
        scopes: what they may do.
    """

    owner: str
    scopes: frozenset[str]

    def may(self, scope: Scope) -> bool:
        """Whether they may do what needs ``scope``."""
        return bool(self.scopes & _IMPLIED[scope])

    @property
    def sees(self) -> str | None:
        """Whose things are listed; None lists everybody's."""
        return None if self.may("admin") else self.owner

    def owns(self, owner: str) -> bool:
        """Whether something of ``owner`` is theirs to see."""
        return self.may("admin") or owner == self.owner


async def principal(
    request: Request,
    service: ServiceDep,
    bearer: Annotated[HTTPAuthorizationCredentials | None, Security(_bearer)],
    cookie: Annotated[str | None, Security(_cookie)],
) -> Principal:
    """Who asks.

    Raises:
        Problem: 401 without a valid token where one is needed.
    """
    secret = bearer.credentials if bearer is not None else cookie
    if secret is None and request.headers.get("authorization") is None and await _is_open(service):
        return Principal(LOCAL_OWNER, frozenset({"admin"}))
    token = None
    if secret is not None:
        async with service.pool.connection() as connection:
            token = await find_token(connection, secret)
    if token is None:
        detail = "A valid token is needed: send the header Authorization: Bearer <token>."
        raise Problem(401, "unauthorized", detail, headers={"WWW-Authenticate": 'Bearer realm="octasplat"'})
    return Principal(token.owner, frozenset(token.scopes))


class _Needs:
    def __init__(self, scope: Scope) -> None:
        self._scope = scope

    def __call__(self, who: Annotated[Principal, Depends(principal)]) -> Principal:
        if not who.may(self._scope):
            detail = f"This token may not do that; one with the scope '{self._scope}' is needed."
            raise Problem(403, "scope", detail)
        return who


Reader = Annotated[Principal, Depends(_Needs("read"))]
Writer = Annotated[Principal, Depends(_Needs("write"))]
Admin = Annotated[Principal, Depends(_Needs("admin"))]


async def _is_open(service: Service) -> bool:
    """Whether whoever reaches the service may use it: only from this machine, and only without any tokens."""
    if not service.settings.is_private:
        return False
    now = time.monotonic()
    if now - service.tokens_seen > _OPEN_SECONDS:
        async with service.pool.connection() as connection:
            service.has_tokens = await any_token(connection)
        service.tokens_seen = now
    return not service.has_tokens

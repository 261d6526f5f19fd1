"""Tokens: created, listed, made narrower, revoked."""

import uuid
from collections.abc import Awaitable, Callable

from octasplat.service.auth import Principal, covered_scopes
from octasplat.service.idempotency import create_once, fingerprint
from octasplat.service.problems import ProblemError, not_found_error
from octasplat.service.schemas.tokens import MadeToken, NewToken, SignInLink, TokenChange, TokenView
from octasplat.service.state import Service
from octasplat.workers.db import tokens as rows
from octasplat.workers.db.connections import Connection
from octasplat.workers.db.rows import Token
from octasplat.workers.db.sessions import add_link


async def list_tokens(service: Service, principal: Principal) -> list[Token]:
    """Return the tokens that the principal may see, without their secrets."""
    async with service.pool.connection() as connection:
        return await rows.list_tokens(connection, principal.visible_owner)


async def get_token(service: Service, principal: Principal, token_id: uuid.UUID) -> Token:
    """Return a token, without its secret.

    Raises:
        ProblemError: 404 if it does not exist or the principal may not see it.
    """
    async with service.pool.connection() as connection:
        return await _fetch_visible_token(connection, principal, token_id)


async def create_token(
    service: Service, principal: Principal, new: NewToken, *, idempotency_key: str | None = None
) -> MadeToken:
    """Create a token.

    Raises:
        ProblemError: 409 if the key has made one already, as its secret is shown once; 422 for a key used
            otherwise.
    """
    secret = rows.new_secret()
    async with service.pool.connection() as connection, connection.transaction():

        async def make() -> uuid.UUID:
            token = await rows.add_token(
                connection,
                secret,
                owner=new.owner,
                name=new.name,
                scopes=new.scopes,
                hours=new.hours or service.settings.token_hours or None,
            )
            return token.id

        named = fingerprint("token", new.model_dump(mode="json", exclude_defaults=True))
        token_id = await _make_secret_once(connection, principal, idempotency_key, named, make)
        token = await _fetch_visible_token(connection, principal, token_id)
    return MadeToken(**TokenView.from_row(token).model_dump(), token=secret)


async def change_token(
    service: Service,
    principal: Principal,
    token_id: uuid.UUID,
    change: TokenChange,
    check: Callable[[Token], None] = lambda _: None,
) -> Token:
    """Rename a token, or make it narrower: fewer scopes, an earlier end.

    Args:
        service: the service.
        principal: asks.
        token_id: the token.
        change: what is to be different.
        check: sees the token as it is, while nobody else can change it, and raises to leave it so.

    Raises:
        ProblemError: 403 if the principal may do less than the token, 404, 409 for a revoked one, 422 if it
            would become wider.
    """
    async with service.pool.connection() as connection, connection.transaction():
        token = await _fetch_changeable_token(connection, principal, token_id)
        check(token)
        if token.revoked_at is not None:
            raise ProblemError(409, "conflict", "The token is revoked, so it does not change any more.")
        scopes = token.scopes if change.scopes is None else list(dict.fromkeys(change.scopes))
        if not set(scopes) <= covered_scopes(token.scopes):
            raise _wider_error("scopes", f"The token has the scopes {', '.join(token.scopes)}; name fewer.")
        expires_at = token.expires_at if change.expires_at is None else change.expires_at
        if expires_at is not None and token.expires_at is not None and expires_at > token.expires_at:
            raise _wider_error(
                "expires_at", f"The token ends at {token.expires_at.isoformat()}; name an earlier time."
            )
        name = token.name if change.name is None else change.name
        return await rows.change_token(connection, token_id, name=name, scopes=scopes, expires_at=expires_at)


async def revoke_token(service: Service, principal: Principal, token_id: uuid.UUID) -> None:
    """Revoke a token.

    Raises:
        ProblemError: 403 if the principal may do less than the token; 404 if it does not exist, is revoked
            already, or the principal may not see it.
    """
    async with service.pool.connection() as connection, connection.transaction():
        await _fetch_changeable_token(connection, principal, token_id)
        if not await rows.revoke_token(connection, token_id):
            raise not_found_error("token")


async def create_sign_in_link(
    service: Service, principal: Principal, *, idempotency_key: str | None = None
) -> SignInLink:
    """Create a link that signs in once.

    Raises:
        ProblemError: 409 if the key has made one already; 422 for a key used otherwise.
    """
    secret = ""
    async with service.pool.connection() as connection, connection.transaction():

        async def make() -> uuid.UUID:
            nonlocal secret
            secret = await add_link(connection, principal.token_id)
            return principal.token_id

        named = fingerprint("sign-in link", str(principal.token_id))
        await _make_secret_once(connection, principal, idempotency_key, named, make)
    return SignInLink(path=f"/sign-in/once?key={secret}")


async def _fetch_visible_token(
    connection: Connection, principal: Principal, token_id: uuid.UUID, *, lock: bool = False
) -> Token:
    token = await rows.get_any_token(connection, token_id, lock=lock)
    if token is None or not principal.may_see(token.owner):
        raise not_found_error("token")
    return token


async def _fetch_changeable_token(connection: Connection, principal: Principal, token_id: uuid.UUID) -> Token:
    """Return a token of the principal, locked, that can do no more than the principal."""
    token = await _fetch_visible_token(connection, principal, token_id, lock=True)
    if not set(token.scopes) <= covered_scopes(principal.scopes):
        detail = f"That token has the scopes {', '.join(token.scopes)}; one with as many rights is needed."
        raise ProblemError(403, "scope", detail)
    return token


async def _make_secret_once(
    connection: Connection,
    principal: Principal,
    key: str | None,
    request: str,
    make: Callable[[], Awaitable[uuid.UUID]],
) -> uuid.UUID:
    """Make something whose secret is shown once, so that a repetition cannot be answered as the first was."""
    made, is_new = await create_once(connection, principal, key, request, make)
    if not is_new:
        detail = "This Idempotency-Key has made it already, and a secret is shown once; take another key."
        raise ProblemError(409, "secret-shown", detail, errors=[{"detail": f"It has the id {made}."}])
    return made


def _wider_error(name: str, detail: str) -> ProblemError:
    return ProblemError(422, "wider", detail, errors=[{"pointer": f"#/{name}", "detail": detail}])

"""Tokens: created, listed, revoked."""

import uuid

from octasplat.service.auth import Principal
from octasplat.service.problems import not_found_error
from octasplat.service.schemas.tokens import MadeToken, NewToken, SignInLink, TokenView
from octasplat.service.state import Service
from octasplat.workers.db import tokens as rows
from octasplat.workers.db.rows import Token
from octasplat.workers.db.sessions import add_link


async def list_tokens(service: Service) -> list[Token]:
    """Return all tokens, without their secrets."""
    async with service.pool.connection() as connection:
        return await rows.list_tokens(connection)


async def create_token(service: Service, new: NewToken) -> MadeToken:
    """Create a token."""
    secret = rows.new_secret()
    async with service.pool.connection() as connection:
        token = await rows.add_token(
            connection,
            secret,
            owner=new.owner,
            name=new.name,
            scopes=new.scopes,
            hours=new.hours or service.settings.token_hours or None,
        )
    return MadeToken(**TokenView.from_row(token).model_dump(), token=secret)


async def revoke_token(service: Service, token_id: uuid.UUID) -> None:
    """Revoke a token.

    Raises:
        ProblemError: 404 if it does not exist or the principal may not see it.
    """
    async with service.pool.connection() as connection:
        if not await rows.revoke_token(connection, token_id):
            raise not_found_error("token")


async def create_sign_in_link(service: Service, principal: Principal) -> SignInLink:
    """Create a link that signs in once."""
    async with service.pool.connection() as connection:
        secret = await add_link(connection, principal.token_id)
    return SignInLink(path=f"/sign-in/once?key={secret}")

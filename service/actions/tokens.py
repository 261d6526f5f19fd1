"""Tokens: made, listed, shut out."""

import uuid

from service.problems import not_found
from service.schemas.tokens import MadeToken, NewToken, TokenView
from service.state import Service
from workers.records import tokens as rows
from workers.records.rows import Token


async def list_tokens(service: Service) -> list[Token]:
    """All tokens, without their secrets."""
    async with service.pool.connection() as connection:
        return await rows.list_tokens(connection)


async def make_token(service: Service, new: NewToken) -> MadeToken:
    """Make a token. From the first one on, nobody gets in without."""
    secret = rows.new_secret()
    async with service.pool.connection() as connection:
        token = await rows.add_token(connection, secret, owner=new.owner, name=new.name, scopes=new.scopes)
    service.forget_tokens()
    return MadeToken(**TokenView.of(token).model_dump(), token=secret)


async def revoke_token(service: Service, token_id: uuid.UUID) -> None:
    """Shut a token out.

    Raises:
        Problem: 404.
    """
    async with service.pool.connection() as connection:
        if not await rows.revoke_token(connection, token_id):
            raise not_found("token")
    service.forget_tokens()

"""Routes of access tokens, and of links that sign a browser in."""

from fastapi import APIRouter, Response

from octasplat.service.actions import tokens as actions
from octasplat.service.auth import Admin, Reader, Writer
from octasplat.service.etags import check_precondition, set_etag, unless_unchanged, view_etag
from octasplat.service.routes import problem_responses
from octasplat.service.routes.parameters import IdempotencyKey, IfMatch, IfNoneMatch, TokenId
from octasplat.service.routes.response_headers import ETAG, LOCATION, not_modified, with_headers
from octasplat.service.schemas.tokens import (
    MadeToken,
    NewToken,
    SignInLink,
    TokenChange,
    TokenList,
    TokenView,
)
from octasplat.service.state import ServiceDep
from octasplat.workers.db.rows import Token

router = APIRouter(prefix="/v1", tags=["tokens"])


@router.get("/tokens", responses=problem_responses())
async def list_tokens(principal: Reader, service: ServiceDep) -> TokenList:
    """List your tokens, without their secrets; for administrators everybody's."""
    found = await actions.list_tokens(service, principal)
    return TokenList(tokens=[TokenView.from_row(row) for row in found])


@router.post("/tokens", status_code=201, responses={**with_headers(201, LOCATION), **problem_responses(409)})
async def create_token(
    new: NewToken, principal: Admin, service: ServiceDep, response: Response, key: IdempotencyKey = None
) -> MadeToken:
    """Create a token, whose secret is shown this once; a repetition with the same key is answered 409.

    The token that asks must be an administrator's.
    """
    made = await actions.create_token(service, principal, new, idempotency_key=key)
    response.headers["Location"] = f"/v1/tokens/{made.id}"
    return made


@router.get(
    "/tokens/{token_id}", responses={**with_headers(200, ETAG), **not_modified(), **problem_responses(404)}
)
async def get_token(
    token_id: TokenId, principal: Reader, service: ServiceDep, response: Response,
    if_none_match: IfNoneMatch = None,
) -> TokenView:  # fmt: skip
    """Return one of your tokens, without its secret."""
    view = TokenView.from_row(await actions.get_token(service, principal, token_id))
    return unless_unchanged(response, if_none_match, view_etag(view), view)


@router.patch("/tokens/{token_id}", responses={**with_headers(200, ETAG), **problem_responses(404, 409, 412)})
async def change_token(
    token_id: TokenId, change: TokenChange, principal: Writer, service: ServiceDep, response: Response,
    if_match: IfMatch = None,
) -> TokenView:  # fmt: skip
    """Rename one of your tokens, or make it narrower: fewer scopes, an earlier end. It never gets wider."""

    def check(token: Token) -> None:
        check_precondition(if_match, view_etag(TokenView.from_row(token)))

    view = TokenView.from_row(await actions.change_token(service, principal, token_id, change, check))
    set_etag(response, view_etag(view))
    return view


@router.delete("/tokens/{token_id}", status_code=204, responses=problem_responses(404))
async def delete_token(token_id: TokenId, principal: Writer, service: ServiceDep) -> None:
    """Revoke one of your tokens, with the sessions of browsers that were begun with it."""
    await actions.revoke_token(service, principal, token_id)


@router.post("/sign-in-links", status_code=201, responses=problem_responses(409))
async def create_sign_in_link(
    principal: Writer, service: ServiceDep, key: IdempotencyKey = None
) -> SignInLink:
    """Create a link that signs a browser in with your token, once, within five minutes."""
    return await actions.create_sign_in_link(service, principal, idempotency_key=key)

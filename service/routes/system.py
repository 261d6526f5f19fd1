"""Routes on the service: job kinds, formats, queues, tokens, health."""

import uuid

from fastapi import APIRouter, Response

from octasplat.service.actions import system as actions
from octasplat.service.actions import tokens
from octasplat.service.auth import Admin, Reader, Writer
from octasplat.service.routes import problem_responses
from octasplat.service.schemas.system import Health, InfoView, KindList, KindView, QueueList
from octasplat.service.schemas.tokens import MadeToken, NewToken, SignInLink, TokenList, TokenView
from octasplat.service.state import ServiceDep

router = APIRouter(prefix="/v1", tags=["service"])
health_router = APIRouter(tags=["health"])


@router.get("/options", responses=problem_responses())
async def list_options(_principal: Reader, service: ServiceDep) -> KindList:
    """Return the kinds of jobs with their options as JSON Schema."""
    return KindList(kinds=actions.list_kinds(service))


@router.get("/options/{kind}", responses=problem_responses(404))
async def get_options(kind: str, _principal: Reader, service: ServiceDep) -> KindView:
    """Return one kind of job with its options as JSON Schema."""
    return actions.get_kind(service, kind)


@router.get("/info", responses=problem_responses())
async def get_info(principal: Reader, service: ServiceDep) -> InfoView:
    """Return versions, limits, formats, and your identity."""
    return actions.describe(service, principal)


@router.get("/queues", responses=problem_responses())
async def list_queues(_principal: Reader, service: ServiceDep) -> QueueList:
    """List the queues with their waiting and running jobs, and the workers."""
    return await actions.list_queues(service)


@router.get("/tokens", responses=problem_responses())
async def list_tokens(_principal: Admin, service: ServiceDep) -> TokenList:
    """Return all tokens, without their secrets."""
    return TokenList(tokens=[TokenView.from_row(row) for row in await tokens.list_tokens(service)])


@router.post("/tokens", status_code=201, responses=problem_responses())
async def create_token(
    new: NewToken, _principal: Admin, service: ServiceDep, response: Response
) -> MadeToken:
    """Create a token; from the first one on, every request needs one."""
    made = await tokens.create_token(service, new)
    response.headers["Location"] = f"/v1/tokens/{made.id}"
    return made


@router.delete("/tokens/{token_id}", status_code=204, responses=problem_responses(404))
async def delete_token(token_id: uuid.UUID, _principal: Admin, service: ServiceDep) -> None:
    """Revoke a token, with the sessions of browsers that were begun with it."""
    await tokens.revoke_token(service, token_id)


@router.post("/sign-in-links", status_code=201, responses=problem_responses())
async def create_sign_in_link(principal: Writer, service: ServiceDep) -> SignInLink:
    """Create a link that signs a browser in with your token, once, within five minutes."""
    return await tokens.create_sign_in_link(service, principal)


@health_router.get("/healthz")
async def healthz() -> Health:
    """Return whether the process is alive; uses nothing else."""
    return Health(status="ok")


@health_router.get("/readyz", responses={503: {"model": Health, "description": "Not ready"}})
async def readyz(service: ServiceDep, response: Response) -> Health:
    """Return whether requests can be served: the database answers, and the disk has space."""
    checks = await actions.check_readiness(service)
    ready = all(state == "ok" for state in checks.values())
    if not ready:
        response.status_code = 503
        response.headers["Retry-After"] = "5"
    return Health(status="ok" if ready else "unready", checks=checks)

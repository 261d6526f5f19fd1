"""What the service is and how it fares: kinds of jobs, formats, queues, tokens, health."""

import asyncio
import uuid

from fastapi import APIRouter, Response

import engine
from engine.errors import ConfigError
from engine.files import exporters
from service.auth import Admin, Reader
from service.limits import ceilings_by_path
from service.problems import not_found
from service.routes import problems
from service.schemas.system import (
    FormatView,
    Health,
    InfoView,
    KindList,
    KindView,
    QueueList,
    QueueView,
    WorkerView,
)
from service.schemas.tokens import MadeToken, NewToken, TokenList, TokenView
from service.state import Service, ServiceDep
from workers.queue.jobs import queue_depths, running_by_queue
from workers.records.migrate import missing_steps
from workers.records.tokens import add_token, list_tokens, new_secret, revoke_token
from workers.records.workers import live_workers
from workers.store.errors import StorageError
from workers.work.kinds import JobKind, job_kinds, kind_named

router = APIRouter(prefix="/v1", tags=["service"])
health_router = APIRouter(tags=["health"])


@router.get("/options", responses=problems())
async def list_options(_who: Reader, service: ServiceDep) -> KindList:
    """The kinds of jobs with their options as JSON Schema."""
    return KindList(kinds=[_kind_view(kind, service) for kind in job_kinds()])


@router.get("/options/{kind}", responses=problems(404))
async def get_options(kind: str, _who: Reader, service: ServiceDep) -> KindView:
    """One kind of job with its options as JSON Schema."""
    try:
        return _kind_view(kind_named(kind), service)
    except ConfigError:
        raise not_found("kind of job") from None


@router.get("/info", responses=problems())
async def get_info(who: Reader, service: ServiceDep) -> InfoView:
    """Versions, limits, formats, and who you are."""
    return InfoView(
        version=engine.__version__,
        kinds=[kind.name for kind in job_kinds()],
        formats=[
            FormatView(name=e.name, patterns=list(e.patterns), description=e.description) for e in exporters()
        ],
        max_upload_bytes=service.settings.max_upload_bytes,
        max_archive_bytes=service.settings.max_archive_bytes,
        needs_token=service.has_tokens or not service.settings.is_private,
        owner=who.owner,
        scopes=sorted(who.scopes),
    )


@router.get("/queues", responses=problems())
async def list_queues(_who: Reader, service: ServiceDep) -> QueueList:
    """What waits, what runs, and who works."""
    async with service.pool.connection() as connection:
        depths = {depth.queue: depth for depth in await queue_depths(connection)}
        running = await running_by_queue(connection)
        workers = await live_workers(connection, service.settings.stale_seconds)
    slots: dict[str, int] = {}
    for worker in workers:
        for queue in worker.queues:
            slots[queue] = slots.get(queue, 0) + worker.slots
    names = sorted({"cpu", *depths, *running, *slots})
    return QueueList(
        queues=[
            QueueView(
                queue=name,
                waiting=depths[name].waiting if name in depths else 0,
                oldest_seconds=depths[name].oldest_seconds if name in depths else None,
                running=running.get(name, 0),
                slots=slots.get(name, 0),
            )
            for name in names
        ],
        workers=[WorkerView.model_validate(worker, from_attributes=True) for worker in workers],
    )


@router.get("/tokens", responses=problems())
async def get_tokens(_who: Admin, service: ServiceDep) -> TokenList:
    """All tokens, without their secrets."""
    async with service.pool.connection() as connection:
        found = await list_tokens(connection)
    return TokenList(tokens=[TokenView.model_validate(token, from_attributes=True) for token in found])


@router.post("/tokens", status_code=201, responses=problems())
async def make_token(new: NewToken, _who: Admin, service: ServiceDep) -> MadeToken:
    """Make a token. From the first one on, nobody gets in without."""
    secret = new_secret()
    async with service.pool.connection() as connection:
        token = await add_token(connection, secret, owner=new.owner, name=new.name, scopes=new.scopes)
    service.tokens_seen = -1e9
    return MadeToken(**TokenView.model_validate(token, from_attributes=True).model_dump(), token=secret)


@router.delete("/tokens/{token_id}", status_code=204, responses=problems(404))
async def delete_token(token_id: uuid.UUID, _who: Admin, service: ServiceDep) -> None:
    """Shut a token out."""
    async with service.pool.connection() as connection:
        if not await revoke_token(connection, token_id):
            raise not_found("token")
    service.tokens_seen = -1e9


@health_router.get("/healthz")
async def healthz() -> Health:
    """Whether the process lives; touches nothing."""
    return Health(status="ok")


@health_router.get("/readyz", responses={503: {"model": Health, "description": "Not ready"}})
async def readyz(service: ServiceDep, response: Response) -> Health:
    """Whether requests can be served: the database answers and fits, and the disk has room."""
    checks = {
        "database": await _check_database(service),
        "storage": await asyncio.to_thread(_check_storage, service),
        "service": "draining" if service.draining else "ok",
    }
    ready = all(state == "ok" for state in checks.values())
    if not ready:
        response.status_code = 503
        response.headers["Retry-After"] = "5"
    return Health(status="ok" if ready else "unready", checks=checks)


async def _check_database(service: Service) -> str:
    try:
        async with asyncio.timeout(3), service.pool.connection(timeout=3) as connection:
            cursor = await connection.execute("SELECT component, name FROM schema_steps")
            applied = {(row["component"], row["name"]) for row in await cursor.fetchall()}
    except Exception:  # noqa: BLE001 - whatever it is, the service is not ready
        return "unreachable"
    return "ok" if not missing_steps(applied) else "outdated"


def _check_storage(service: Service) -> str:
    try:
        free = service.storage.free_bytes()
    except StorageError:
        return "unreachable"
    return "ok" if free is None or free > 0 else "full"


def _kind_view(kind: JobKind, service: Service) -> KindView:
    schema = kind.options.model_json_schema()
    ceilings = ceilings_by_path(kind, service.settings)
    return KindView(name=kind.name, title=kind.title, needs=kind.needs, options=schema, ceilings=ceilings)

"""Routes on the service: job kinds, formats, queues, health."""

from typing import Annotated

from fastapi import APIRouter, Path, Response

from octasplat.service.actions import system as actions
from octasplat.service.actions.usage import read_usage
from octasplat.service.auth import Admin, Reader
from octasplat.service.routes import problem_responses
from octasplat.service.schemas.system import (
    Health,
    InfoView,
    KindList,
    KindView,
    QueueChange,
    QueueList,
    QueueView,
    WorkerChange,
    WorkerView,
)
from octasplat.service.schemas.usage import UsageView
from octasplat.service.state import ServiceDep

router = APIRouter(prefix="/v1", tags=["service"])
health_router = APIRouter(tags=["health"])

KindName = Annotated[str, Path(description="Name of the kind, such as reconstruct.")]

QueueName = Annotated[
    str, Path(pattern="^[a-z][a-z0-9_-]{0,40}$", description="Name of the queue, such as cpu.")
]
WorkerName = Annotated[str, Path(max_length=200, description="Name of a live worker.")]


@router.get("/options", responses=problem_responses())
async def list_options(_principal: Reader, service: ServiceDep) -> KindList:
    """Return the kinds of jobs with their options as JSON Schema."""
    return KindList(kinds=await actions.list_kinds(service))


@router.get("/options/{kind}", responses=problem_responses(404))
async def get_options(kind: KindName, _principal: Reader, service: ServiceDep) -> KindView:
    """Return one kind of job with its options as JSON Schema."""
    return await actions.get_kind(service, kind)


@router.get("/info", responses=problem_responses())
async def get_info(principal: Reader, service: ServiceDep) -> InfoView:
    """Return versions, limits, formats, and your identity."""
    return actions.describe(service, principal)


@router.get("/usage", responses=problem_responses())
async def get_usage(principal: Reader, service: ServiceDep) -> UsageView:
    """Return what you have stored and asked for, how much you may, and the time that your jobs took."""
    return await read_usage(service, principal)


@router.get("/queues", responses=problem_responses())
async def list_queues(principal: Reader, service: ServiceDep) -> QueueList:
    """List the queues with your waiting and running jobs; for administrators everybody's, and the workers."""
    return await actions.list_queues(service, principal)


@router.patch("/queues/{queue}", responses=problem_responses())
async def change_queue(
    queue: QueueName, change: QueueChange, principal: Admin, service: ServiceDep
) -> QueueView:
    """Pause a queue, so that it hands out no jobs, or let it go on; jobs that run are left alone.

    It stays so when the service is restarted. The token must be an administrator's.
    """
    return await actions.set_queue_paused(service, principal, queue, change.paused)


@router.patch("/workers/{worker:path}", responses=problem_responses(404))
async def change_worker(
    worker: WorkerName, change: WorkerChange, principal: Admin, service: ServiceDep
) -> WorkerView:
    """Drain a worker, so that it finishes what it has and takes nothing new, or let it take jobs again.

    A worker of the same name (`octasplat worker --name`) is still drained when it starts again. The token
    must be an administrator's.
    """
    return await actions.set_worker_drained(service, principal, worker, change.drained)


@health_router.get("/healthz")
async def healthz() -> Health:
    """Return whether the process is alive; uses nothing else."""
    return Health(status="ok")


@health_router.get("/readyz", responses={503: {"model": Health, "description": "Not ready"}})
async def readyz(service: ServiceDep, response: Response) -> Health:
    """Return whether requests can be served.

    Where only ``uploads`` is not ``ok``, as the store is full, the service is ready: jobs are listed, results
    are downloaded and deleted.
    """
    checks = await actions.check_readiness(service)
    ready = all(state == "ok" for name, state in checks.items() if name != "uploads")
    if not ready:
        response.status_code = 503
        response.headers["Retry-After"] = "5"
    return Health(status="ok" if ready else "unready", checks=checks)

"""What the service is and how it fares: kinds of jobs, formats, queues, health, numbers."""

import asyncio

from octasplat.engine import __version__
from octasplat.engine.errors import ConfigError
from octasplat.engine.files import exporters
from octasplat.service.auth import Principal
from octasplat.service.limits import ceilings_by_path
from octasplat.service.problems import not_found
from octasplat.service.schemas.system import FormatView, InfoView, KindView, QueueList, QueueView, WorkerView
from octasplat.service.state import Service
from octasplat.service.threads import Threads, in_thread
from octasplat.workers.isolation.abilities import abilities
from octasplat.workers.queue.jobs import queue_depths, running_by_queue
from octasplat.workers.queue.numbers import read_numbers
from octasplat.workers.records.migrate import missing_steps
from octasplat.workers.records.rows import WorkerRow
from octasplat.workers.records.workers import live_workers
from octasplat.workers.store.errors import StorageError
from octasplat.workers.work.kinds import JobKind, job_kinds, kind_named

STORAGE_SECONDS = 3.0
"""A store that takes longer to answer is not ready."""


def list_kinds(service: Service) -> list[KindView]:
    """The kinds of jobs with their options."""
    return [_kind_view(kind, service) for kind in job_kinds()]


def get_kind(service: Service, name: str) -> KindView:
    """One kind of job with its options.

    Raises:
        Problem: 404.
    """
    try:
        return _kind_view(kind_named(name), service)
    except ConfigError:
        raise not_found("kind of job") from None


def describe(service: Service, who: Principal) -> InfoView:
    """Versions, limits, formats, and who asks."""
    return InfoView(
        version=__version__,
        kinds=[kind.name for kind in job_kinds()],
        formats=[
            FormatView(name=e.name, patterns=list(e.patterns), description=e.description) for e in exporters()
        ],
        max_upload_bytes=service.settings.max_upload_bytes,
        max_archive_bytes=service.settings.max_archive_bytes,
        needs_token=service.has_tokens or not service.settings.is_private,
        owner=who.owner,
        scopes=sorted(who.scopes),
        isolation=abilities(),
    )


async def living_workers(service: Service) -> list[WorkerRow]:
    """The workers that have been heard of lately."""
    async with service.pool.connection() as connection:
        return await live_workers(connection, service.settings.stale_seconds)


async def list_queues(service: Service) -> QueueList:
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


async def check_readiness(service: Service) -> dict[str, str]:
    """Whether requests can be served, part by part: ``ok``, or what ails it."""
    return {
        "database": await _check_database(service),
        "storage": await _check_storage(service),
        "service": "draining" if service.draining else "ok",
    }


async def render_metrics(service: Service) -> bytes:
    """How the service fares, in the format of Prometheus."""
    async with service.pool.connection() as connection:
        numbers = await read_numbers(connection, service.settings.stale_seconds)
    free_bytes = await in_thread(Threads.LOOKS, _free_bytes, service)
    return service.metrics.render(numbers, streams=service.hub.streams, free_bytes=free_bytes)


def _kind_view(kind: JobKind, service: Service) -> KindView:
    schema = kind.asked.model_json_schema()
    ceilings = ceilings_by_path(kind, service.settings)
    return KindView(name=kind.name, title=kind.title, needs=kind.needs, options=schema, ceilings=ceilings)


async def _check_database(service: Service) -> str:
    try:
        async with asyncio.timeout(3), service.pool.connection(timeout=3) as connection:
            cursor = await connection.execute("SELECT component, name FROM schema_steps")
            applied = {(row["component"], row["name"]) for row in await cursor.fetchall()}
    except Exception:  # noqa: BLE001 - whatever it is, the service is not ready
        return "unreachable"
    return "ok" if not missing_steps(applied) else "outdated"


async def _check_storage(service: Service) -> str:
    """Looked at once for all who ask meanwhile; a store that hangs takes no more than one thread."""
    if service.storage_look is None or service.storage_look.done():
        service.storage_look = asyncio.ensure_future(in_thread(Threads.LOOKS, _look_at_storage, service))
    try:
        async with asyncio.timeout(STORAGE_SECONDS):
            return await asyncio.shield(service.storage_look)
    except TimeoutError:
        return "unreachable"


def _look_at_storage(service: Service) -> str:
    try:
        service.storage.check()
        free = service.storage.free_bytes()
    except StorageError:
        return "unreachable"
    return "ok" if free is None or free > 0 else "full"


def _free_bytes(service: Service) -> int | None:
    try:
        return service.storage.free_bytes()
    except StorageError:
        return None  # readiness tells of it

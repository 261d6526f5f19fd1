"""Properties and state of the service: job kinds, formats, queues, health, metrics."""

import asyncio

from octasplat.engine import __version__
from octasplat.engine.core.errors import ConfigError
from octasplat.engine.files import exporters
from octasplat.service.auth import Principal
from octasplat.service.job_limits import limits_by_path
from octasplat.service.problems import not_found_error
from octasplat.service.schemas.system import FormatView, InfoView, KindView, QueueList, QueueView, WorkerView
from octasplat.service.state import Service
from octasplat.service.thread_pools import ThreadPurpose, run_in_pool
from octasplat.workers.db.connections import Connection
from octasplat.workers.db.holds import read_holds
from octasplat.workers.db.holds import set_queue_paused as write_queue_paused
from octasplat.workers.db.holds import set_worker_drained as write_worker_drained
from octasplat.workers.db.migrate import missing_migrations
from octasplat.workers.db.rows import WorkerRow
from octasplat.workers.db.workers import live_workers
from octasplat.workers.queue.service_stats import read_service_stats
from octasplat.workers.queue.usage_figures import queue_depths, running_by_queue, running_by_worker
from octasplat.workers.sandbox.capabilities import sandbox_capabilities
from octasplat.workers.storage.errors import StorageError
from octasplat.workers.worker.job_kinds import JobKind, get_job_kind, job_kinds

STORAGE_TIMEOUT_SECONDS = 3.0
"""A store that takes longer to answer is not ready."""


async def list_kinds(service: Service) -> list[KindView]:
    """Return the kinds of jobs with their options."""
    return await run_in_pool(
        ThreadPurpose.OPTIONS, lambda: [_kind_view(kind, service) for kind in job_kinds()]
    )


async def get_kind(service: Service, name: str) -> KindView:
    """Return one kind of job with its options.

    Raises:
        ProblemError: 404 if it does not exist or the principal may not see it.
    """
    try:
        kind = get_job_kind(name, is_asked_for=True)
        return await run_in_pool(ThreadPurpose.OPTIONS, _kind_view, kind, service)
    except ConfigError:
        raise not_found_error("kind of job") from None


def describe(service: Service, principal: Principal) -> InfoView:
    """Return versions, limits, formats, and the caller's identity."""
    return InfoView(
        version=__version__,
        kinds=[kind.name for kind in job_kinds()],
        formats=[
            FormatView(name=e.name, patterns=list(e.patterns), description=e.description) for e in exporters()
        ],
        max_upload_bytes=service.settings.max_upload_bytes,
        max_archive_bytes=service.settings.max_archive_bytes,
        owner=principal.owner,
        scopes=sorted(principal.scopes),
        isolation=sandbox_capabilities(service.settings.job_uids),
    )


async def list_live_workers(service: Service) -> list[WorkerRow]:
    """Return the live workers."""
    async with service.pool.connection() as connection:
        return await live_workers(connection, service.settings.stale_seconds)


async def list_queues(service: Service, principal: Principal) -> QueueList:
    """Return the queues with the waiting and running jobs that the principal may see.

    Workers, which are named after their hosts, are for administrators.
    """
    async with service.pool.connection() as connection:
        return await _queue_list(connection, service, principal)


async def set_queue_paused(service: Service, principal: Principal, queue: str, paused: bool) -> QueueView:
    """Pause a queue or let it go on; returns it as it is now.

    Also a queue that nothing is in and no worker takes yet, so that it is paused before its first job.
    """
    async with service.pool.connection() as connection, connection.transaction():
        await write_queue_paused(connection, queue, paused)
        found = await _queue_list(connection, service, principal, also=queue)
    return next(view for view in found.queues if view.queue == queue)


async def set_worker_drained(service: Service, principal: Principal, name: str, drained: bool) -> WorkerView:
    """Drain a live worker or let it take jobs again; returns it as it is now.

    Raises:
        ProblemError: 404 if no live worker has that name.
    """
    async with service.pool.connection() as connection, connection.transaction():
        await write_worker_drained(connection, name, drained)
        found = await _queue_list(connection, service, principal)
        workers = [view for view in found.workers if view.name == name]
        if not workers:
            raise not_found_error("live worker")
    return workers[0]


async def _queue_list(
    connection: Connection, service: Service, principal: Principal, *, also: str = "cpu"
) -> QueueList:
    owner = principal.visible_owner
    depths = {depth.queue: depth for depth in await queue_depths(connection, owner)}
    running = await running_by_queue(connection, owner)
    workers = await live_workers(connection, service.settings.stale_seconds)
    holds = await read_holds(connection)
    busy = await running_by_worker(connection)
    slots: dict[str, int] = {}
    for worker in workers:
        for queue in worker.queues:
            slots[queue] = slots.get(queue, 0) + worker.slots
    names = sorted({"cpu", also, *depths, *running, *slots, *holds.queues})
    return QueueList(
        queues=[
            QueueView(
                queue=name,
                waiting=depths[name].waiting if name in depths else 0,
                oldest_seconds=depths[name].oldest_seconds if name in depths else None,
                running=running.get(name, 0),
                slots=slots.get(name, 0),
                paused=name in holds.queues,
            )
            for name in names
        ],
        workers=[
            WorkerView(
                name=worker.name,
                queues=worker.queues,
                slots=worker.slots,
                facts=worker.facts,
                running=busy.get(worker.name, 0),
                drained=worker.name in holds.workers,
                started_at=worker.started_at,
                seen_at=worker.seen_at,
            )
            for worker in workers
            if principal.may("admin")
        ],
    )


async def check_readiness(service: Service) -> dict[str, str]:
    """Return the readiness of each part: ``ok``, or the fault.

    ``uploads`` tells whether files are taken, which a full store does not; everything else works then, so
    that the service is ready.
    """
    storage = await _check_storage(service)
    return {
        "database": await _check_database(service),
        "storage": "unreachable" if storage == "unreachable" else "ok",
        "uploads": storage,
        "service": "draining" if service.is_draining else "ok",
    }


async def render_metrics(service: Service) -> bytes:
    """Return the metrics of the service in the Prometheus format."""
    async with service.pool.connection() as connection:
        numbers = await read_service_stats(connection, service.settings.stale_seconds)
    free_bytes = await run_in_pool(ThreadPurpose.STORE_CHECKS, _free_bytes, service)
    return service.metrics.render(
        numbers, streams=service.event_broker.subscriber_count, free_bytes=free_bytes
    )


def _kind_view(kind: JobKind, service: Service) -> KindView:
    schema = kind.user_options.model_json_schema()
    ceilings = limits_by_path(kind, service.settings)
    return KindView(name=kind.name, title=kind.title, needs=kind.needs, options=schema, ceilings=ceilings)


async def _check_database(service: Service) -> str:
    try:
        async with asyncio.timeout(3), service.pool.connection(timeout=3) as connection:
            cursor = await connection.execute("SELECT component, name FROM schema_steps")
            applied = {(row["component"], row["name"]) for row in await cursor.fetchall()}
    except Exception:  # noqa: BLE001 - whatever it is, the service is not ready
        return "unreachable"
    return "ok" if not missing_migrations(applied) else "outdated"


async def _check_storage(service: Service) -> str:
    """Check the storage once for all concurrent requests; a storage that hangs blocks one thread only."""
    if service.storage_check is None or service.storage_check.done():
        service.storage_check = asyncio.ensure_future(
            run_in_pool(ThreadPurpose.STORE_CHECKS, _storage_state, service)
        )
    try:
        async with asyncio.timeout(STORAGE_TIMEOUT_SECONDS):
            # Shielded, as other requests wait for the same check.
            return await asyncio.shield(service.storage_check)
    except TimeoutError:
        return "unreachable"


def _storage_state(service: Service) -> str:
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

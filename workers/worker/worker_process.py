"""Worker process: takes entries from its queues, supervises attempts, and recovers lost jobs."""

import asyncio
import contextlib
import importlib
import logging
import os
import platform
import signal
import socket
import time
import uuid
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import psutil
from procrastinate.exceptions import ConnectorException

from octasplat.engine import __version__
from octasplat.engine.core.threads import available_threads
from octasplat.engine.files import writable_formats
from octasplat.engine.operations.precompile import cold_start_seconds, kernel_groups
from octasplat.workers.cancellation import cancel_and_wait
from octasplat.workers.db.connections import Pool, open_pool
from octasplat.workers.db.holds import read_holds
from octasplat.workers.db.ids import new_id
from octasplat.workers.db.migrate import wait_for_tables
from octasplat.workers.db.workers import record_worker_heartbeat, remove_worker
from octasplat.workers.parent_death_signal import die_with_local_service
from octasplat.workers.queue.attempts import Attempt, FencedError
from octasplat.workers.queue.block_jobs import settle_root
from octasplat.workers.queue.claims import claim
from octasplat.workers.queue.fair_share import choose_job
from octasplat.workers.queue.procrastinate_queue import ProcrastinateQueue
from octasplat.workers.sandbox.capabilities import log_missing_capabilities, sandbox_capabilities
from octasplat.workers.sandbox.hiding import forbid_memory_access
from octasplat.workers.sandbox.job_users import check_job_users
from octasplat.workers.settings import WorkerSettings, worker_connections
from octasplat.workers.storage.disk_space import DiskSpace
from octasplat.workers.storage.errors import StorageError
from octasplat.workers.storage.factory import open_storage
from octasplat.workers.storage.local import LocalStorage
from octasplat.workers.worker.admission import Admission, defer_job
from octasplat.workers.worker.capability import reason_incapable, version_facts
from octasplat.workers.worker.context import DatabaseLostError, WorkerContext
from octasplat.workers.worker.heartbeat import DATABASE_ERRORS
from octasplat.workers.worker.host_health import HostHealth
from octasplat.workers.worker.housekeeping import Housekeeping
from octasplat.workers.worker.kernels import compile_in_background
from octasplat.workers.worker.memory_limit import memory_limit_bytes
from octasplat.workers.worker.periodic_tasks import PeriodicTask, PeriodicTaskError, run_periodically
from octasplat.workers.worker.supervisor import Supervisor

logger = logging.getLogger(__name__)

SPACE_CHECK_SECONDS = 5.0
DEFERRAL_POLLS = 3
"""A job that is left to workers of another version is kept from all for so many looks at the queue ..."""
MAX_DEFERRAL_SECONDS = 15.0
"""... and for twice as many each further time, up to this time."""
EXIT_DATABASE_LOST = 69
MAX_FORGIVEN_FAILURES = 3
"""So many failures of workers over one job, one after another, are taken for their own fault."""


def make_job_queue(settings: WorkerSettings, pool: Pool | None = None) -> ProcrastinateQueue:
    """Return the queue that the settings select."""
    return ProcrastinateQueue(
        pool,
        heartbeat_seconds=settings.heartbeat_seconds,
        stale_seconds=settings.stale_seconds,
        poll_seconds=settings.poll_seconds,
        listen=settings.listen,
    )


async def run_worker(settings: WorkerSettings, queues: Mapping[str, int], *, name: str | None = None) -> int:
    """Work until asked to stop.

    Lost jobs are recovered as well, whatever the running jobs do. With no queues that is all.

    Args:
        settings: of this worker.
        queues: names of queues and how many of their jobs may run at once.
        name: of this worker; by default host and process id.

    Returns:
        Exit code: 0 after a request to stop, 69 if the database was lost and the worker should be restarted.

    Raises:
        DatabaseError: the database cannot be reached or is of another version.
        StorageError: the store cannot be used.
    """
    forbid_memory_access()
    is_alone = not die_with_local_service()
    settings.checked()
    slots = sum(queues.values())
    if settings.job_uids is not None:
        await asyncio.to_thread(check_job_users, settings.job_uids, slots, settings.work_folder)
    for module in settings.kind_modules:
        importlib.import_module(module)
    conninfo = settings.conninfo()
    await asyncio.to_thread(wait_for_tables, conninfo)
    floor_bytes = settings.floor_bytes // 4  # the rest of it is for what jobs under way have to store
    storage = await asyncio.to_thread(lambda: open_storage(settings.storage_address, floor_bytes=floor_bytes))
    if is_alone:
        log_missing_capabilities(settings.job_uids)
    name = name or f"{socket.gethostname()}-{os.getpid()}"
    room = DiskSpace(
        storage, settings.work_folder, settings.floor_bytes,
        store_margin_bytes=settings.floor_bytes - floor_bytes, reserve_bytes=floor_bytes,
        store_folder=storage.root if isinstance(storage, LocalStorage) else None,
    )  # fmt: skip
    host = HostHealth(
        name, settings.work_folder, storage,
        kind_modules=settings.kind_modules, cooldown_seconds=settings.recover_seconds,
    )  # fmt: skip
    async with open_pool(
        conninfo, max_size=worker_connections(queues), wait_seconds=settings.stale_seconds
    ) as pool:
        worker = _Worker(
            settings,
            pool,
            WorkerContext(
                settings=settings,
                job_queue=make_job_queue(settings, pool),
                storage=storage,
                disk_space=room,
                host_health=host,
                draining=asyncio.Event(),
                memory_limit_bytes=memory_limit_bytes(settings.memory_limit_bytes, slots),
            ),
            name,
            queues,
        )
        return await worker.run()


class _Worker:
    def __init__(
        self,
        settings: WorkerSettings,
        pool: Pool,
        context: WorkerContext,
        name: str,
        queues: Mapping[str, int],
    ) -> None:
        self._settings = settings
        self._pool = pool
        self._context = context
        self._name = name
        self._queues = queues
        self._id = new_id()
        self._is_database_lost = False
        self._admission = Admission(name, pool, context)
        self._deferrals: Counter[uuid.UUID] = Counter()
        self._housekeeping = Housekeeping(settings, pool, context)

    async def run(self) -> int:
        loop = asyncio.get_running_loop()
        loop.set_exception_handler(_on_unhandled_exception)
        for number in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(number, self._start_draining)
        settings = self._settings
        periodic = [
            asyncio.create_task(run_periodically(task))
            for task in (
                PeriodicTask(
                    self._send_heartbeat, settings.heartbeat_seconds, max(60.0, settings.stale_seconds)
                ),
                *self._housekeeping.tasks(),
                PeriodicTask(self._admission.free_space_if_short, SPACE_CHECK_SECONDS),
            )
        ]
        logger.info("worker %s takes %s", self._name, dict(self._queues) or "no jobs, only care of lost ones")
        try:
            async with compile_in_background() if self._queues else contextlib.nullcontext():
                await self._take_jobs(periodic)
        finally:
            for outcome in await cancel_and_wait(periodic):
                if isinstance(outcome, PeriodicTaskError):
                    logger.error("worker %s ends, as %s", self._name, outcome)
            await self._housekeeping.close()
        if self._is_database_lost:
            return EXIT_DATABASE_LOST
        # Else others would count this worker as live for a while; nothing depends on it.
        with contextlib.suppress(*DATABASE_ERRORS):
            async with asyncio.timeout(5), self._pool.connection() as connection:
                await remove_worker(connection, self._id)
        return 0

    async def _take_jobs(self, tasks: Sequence["asyncio.Task[None]"]) -> None:
        """Take jobs until asked to stop, or the database is lost; none while the machine has a fault."""
        host, job_queue = self._context.host_health, self._context.job_queue
        left = asyncio.create_task(self._context.draining.wait())
        while not self._context.draining.is_set() and not self._is_database_lost:
            host.changed.clear()
            ails = asyncio.create_task(host.changed.wait())
            takers = [
                asyncio.create_task(job_queue.consume(queue, slots, partial(self._deliver, queue)))
                for queue, slots in self._queues.items()
            ]
            await asyncio.wait({left, ails, *tasks, *takers}, return_when=asyncio.FIRST_COMPLETED)
            # A queue that ends by itself has lost the database; running jobs go on as long as they may. What
            # a periodic task did nobody does any more after its end, so that they are handed back.
            self._is_database_lost = self._is_database_lost or not (
                self._context.draining.is_set() or host.fault
            )
            if any(task.done() for task in tasks):
                self._is_database_lost = True
                self._context.draining.set()
            job_queue.pause()
            for outcome in await asyncio.gather(*takers, return_exceptions=True):
                if isinstance(outcome, Exception):
                    logger.warning("a queue ended: %s", outcome)
            ails.cancel()
            while host.fault and not self._context.draining.is_set() and not self._is_database_lost:
                seconds = self._settings.recover_seconds
                await asyncio.wait({left, *tasks}, timeout=seconds, return_when=asyncio.FIRST_COMPLETED)
                if any(task.done() for task in tasks) or await host.try_recover():
                    break
        left.cancel()

    def _start_draining(self) -> None:
        logger.info("worker %s stops and hands back its jobs", self._name)
        self._context.draining.set()
        self._context.job_queue.stop()

    async def _deliver(self, queue: str, job_id: uuid.UUID, entry_id: int) -> None:
        if self._context.draining.is_set():
            await self._return_to_queue(job_id, entry_id)
            return
        if await self._held_back(queue) is not None:
            # The entry is free for others at once, while this slot asks for no other one.
            await self._return_to_queue(job_id, entry_id)
            await self._wait_while_held_back(queue)
            return
        if (fault := await self._context.host_health.check_work_folder()) is not None:
            self._context.host_health.mark_faulty(fault)
        if self._context.host_health.fault is not None:
            await self._return_to_queue(job_id, entry_id)
            return
        chosen = await choose_job(self._pool, self._context.job_queue, job_id, entry_id)
        if (
            chosen is None
            or await self._defer_if_incapable(*chosen)
            or not await self._admission.admit(*chosen)
        ):
            return
        job_id, entry_id = chosen
        if await self._held_back(queue) is not None:  # room may have been waited for
            await self._return_to_queue(job_id, entry_id)
            return
        # Before the claim is sent: heartbeats are counted from here, see Heartbeat.
        since = time.monotonic()
        attempt = await claim(self._pool, job_id, entry_id, self._name)
        if attempt is None:
            return
        await self._attempt_job(attempt, since)
        if attempt.job.root_id is not None:
            # Else the recovery does it a little later.
            with contextlib.suppress(*DATABASE_ERRORS):
                async with self._pool.connection() as connection:
                    await settle_root(connection, self._context.job_queue, attempt.job.root_id)

    async def _attempt_job(self, attempt: Attempt, since: float) -> None:
        """Run an attempt, which was asked for at ``since`` by ``time.monotonic()``."""
        job_id = attempt.job.id
        try:
            await Supervisor(attempt, self._context, since).run()
        except DatabaseLostError as error:
            logger.warning("job %s was let go: %s", job_id, error)
            self._is_database_lost = True
            self._context.job_queue.stop()
        except Exception as error:
            # A fault of this program, or of what it runs on, and not of the job.
            logger.exception("the attempt at job %s failed in its worker", job_id)
            self._context.host_health.mark_faulty(
                f"it cannot look after jobs ({type(error).__name__}: {error})"
            )
            with contextlib.suppress(FencedError, *DATABASE_ERRORS):
                # Not with the error's text, which may differ each time.
                reason = f"its worker failed ({type(error).__name__})"
                await attempt.requeue(self._context.job_queue, reason, max_uncounted=MAX_FORGIVEN_FAILURES)

    async def _held_back(self, queue: str) -> str | None:
        """Return why an administrator lets this worker take no jobs of a queue; None if it may."""
        async with self._pool.connection() as connection:
            return (await read_holds(connection)).reason(queue, self._name)

    async def _wait_while_held_back(self, queue: str) -> None:
        """Wait until jobs of a queue may be taken again, or none are taken any more at all."""
        stops = (self._context.draining, self._context.host_health.changed)
        while not self._is_database_lost and not any(stop.is_set() for stop in stops):
            await asyncio.sleep(self._settings.poll_seconds)
            with contextlib.suppress(*DATABASE_ERRORS):
                if await self._held_back(queue) is None:
                    return

    async def _defer_if_incapable(self, job_id: uuid.UUID, entry_id: int) -> bool:
        """Return whether a job was left to workers of another version."""
        why = await reason_incapable(self._pool, job_id, self._settings.stale_seconds)
        if why is None:
            return False
        if not self._deferrals[job_id]:
            logger.warning("worker %s leaves job %s to others: %s", self._name, job_id, why)
        # Rarer each time, so that however many there are they do not keep it from those that it can do.
        wait_seconds = DEFERRAL_POLLS * self._settings.poll_seconds * 2 ** min(self._deferrals[job_id], 10)
        wait_seconds = min(wait_seconds, MAX_DEFERRAL_SECONDS)
        self._deferrals[job_id] += 1
        await defer_job(self._pool, self._context.job_queue, job_id, entry_id, wait_seconds, reason=f"{why}.")
        return True

    async def _return_to_queue(self, job_id: uuid.UUID, entry_id: int) -> None:
        """Leave a job to other workers whose entry arrived too late at this one."""
        await defer_job(self._pool, self._context.job_queue, job_id, entry_id)

    async def _send_heartbeat(self) -> None:
        facts = await asyncio.to_thread(self._machine_facts)
        async with self._pool.connection() as connection:
            await record_worker_heartbeat(
                connection,
                self._id,
                name=self._name,
                queues=list(self._queues),
                slots=sum(self._queues.values()),
                facts=facts,
            )

    def _machine_facts(self) -> dict[str, Any]:
        memory, room = psutil.virtual_memory(), self._context.disk_space
        try:
            disk = room.facts()
        except StorageError:
            disk = {}
        return {
            **disk,
            "host": socket.gethostname(),
            "pid": os.getpid(),
            "version": __version__,
            "python": platform.python_version(),
            "cores": os.cpu_count(),
            "threads": self._settings.threads or available_threads(),
            "formats": list(writable_formats()),
            "memory_bytes": memory.total,
            "memory_free_bytes": memory.available,
            "memory_limit_bytes": self._context.memory_limit_bytes,
            "ailing": self._context.host_health.fault or self._admission.shortage,
            "isolation": sandbox_capabilities(self._settings.job_uids),
            # Who only looks after lost jobs may have no compiler.
            "cold_start_seconds": round(cold_start_seconds(kernel_groups()), 1) if self._queues else 0.0,
            **version_facts(),
        }


def _on_unhandled_exception(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Ignore that an entry taken from this worker can no longer be acknowledged."""
    error = context.get("exception")
    if isinstance(error, ConnectorException):
        logger.info("a queue entry of another attempt was left alone: %s", error.__cause__ or error)
    else:
        loop.default_exception_handler(context)

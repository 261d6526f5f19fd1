"""The process of a worker: takes slips from its queues, supervises attempts, and looks after lost jobs."""

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
from collections.abc import Awaitable, Callable, Mapping
from typing import Any

import psutil
from procrastinate.exceptions import ConnectorException

import engine
from engine.files import writable_formats
from engine.threads import available_threads
from workers.parent import die_with_server
from workers.queue.attempts import claim
from workers.queue.jobs import get_job, queue_again
from workers.queue.limits import end_abandoned
from workers.queue.procrastinate_slips import ProcrastinateSlips
from workers.queue.rescue import rescue_lost_jobs
from workers.records.audit import forget_old_entries
from workers.records.database import Pool, open_pool
from workers.records.ids import new_id
from workers.records.migrate import wait_for_tables
from workers.records.sessions import forget_old_sessions
from workers.records.workers import forget_lost_workers, forget_worker, see_worker
from workers.settings import WorkerSettings
from workers.store.errors import StorageError
from workers.store.opening import open_storage
from workers.store.room import LEAST_BYTES, Room
from workers.upkeep.collecting import collect, collect_at_once
from workers.upkeep.retention import forget_expired, forget_old_keys, set_expiries
from workers.upkeep.webhooks.outbox import forget_old
from workers.upkeep.webhooks.sending import send_due
from workers.work.contact import DATABASE_ERRORS
from workers.work.memory import memory_limit_bytes
from workers.work.supervisor import LostDatabase, Supervisor, Surroundings
from workers.work.workspace import sweep_workspaces

logger = logging.getLogger(__name__)

SWEEP_SECONDS = 60.0
STORE_SWEEP_SECONDS = 3600.0
ABANDONED_SECONDS = 86_400.0
ROOM_SECONDS = 60.0
"""How long a worker without room keeps a job from others that may have some."""
ROOM_LOOK_SECONDS = 5.0
CRAMPED_SECONDS = 300.0
"""A job that met a full disk is tried again after this time, or as soon as there is more room."""
EXIT_LOST_DATABASE = 69


def make_slips(settings: WorkerSettings, pool: Pool | None = None) -> ProcrastinateSlips:
    """The queue, as the settings say."""
    return ProcrastinateSlips(
        pool,
        heartbeat_seconds=settings.heartbeat_seconds,
        stale_seconds=settings.stale_seconds,
        poll_seconds=settings.poll_seconds,
        listen=settings.listen,
    )


async def run_worker(settings: WorkerSettings, queues: Mapping[str, int], *, name: str | None = None) -> int:
    """Work until asked to stop.

    Lost jobs are looked after as well, whatever the jobs under way do. With no queues that is all.

    Args:
        settings: of this worker.
        queues: names of queues and how many of their jobs may run at once.
        name: of this worker; by default host and process id.

    Returns:
        Exit code: 0 after a wish to stop, 69 if the database was lost and the worker should be started again.

    Raises:
        DatabaseError: the database cannot be reached or is of another version.
        StorageError: the store cannot be used.
    """
    die_with_server()
    settings.checked()
    for module in settings.kind_modules:
        importlib.import_module(module)
    conninfo = settings.conninfo()
    await asyncio.to_thread(wait_for_tables, conninfo)
    floor_bytes = settings.floor_bytes // 4  # the rest of it is for what jobs under way have to store
    storage = await asyncio.to_thread(lambda: open_storage(settings.storage_address, floor_bytes=floor_bytes))
    room = Room(storage, settings.work_folder, settings.floor_bytes, settings.floor_bytes - floor_bytes)
    slots = sum(queues.values())
    async with open_pool(conninfo, max_size=6 + 4 * slots, wait_seconds=settings.stale_seconds) as pool:
        worker = _Worker(
            settings,
            pool,
            Surroundings(
                settings,
                make_slips(settings, pool),
                storage,
                room,
                asyncio.Event(),
                memory_limit_bytes(settings.memory_limit_bytes, slots),
            ),
            name or f"{socket.gethostname()}-{os.getpid()}",
            queues,
        )
        return await worker.run()


class _Worker:
    def __init__(
        self,
        settings: WorkerSettings,
        pool: Pool,
        around: Surroundings,
        name: str,
        queues: Mapping[str, int],
    ) -> None:
        self._settings = settings
        self._pool = pool
        self._around = around
        self._name = name
        self._queues = queues
        self._id = new_id()
        self._lost = False
        self._told_of_room = False
        self._cramped: dict[uuid.UUID, tuple[int, float]] = {}

    async def run(self) -> int:
        loop = asyncio.get_running_loop()
        loop.set_exception_handler(_on_stray_exception)
        for number in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(number, self._leave)
        settings = self._settings
        chores = [
            asyncio.create_task(self._regularly(settings.heartbeat_seconds, self._say_alive)),
            asyncio.create_task(self._regularly(settings.rescue_seconds, self._rescue)),
            asyncio.create_task(self._regularly(SWEEP_SECONDS, self._sweep)),
            asyncio.create_task(self._regularly(STORE_SWEEP_SECONDS, self._sweep_store)),
            asyncio.create_task(self._regularly(settings.poll_seconds, self._send_webhooks)),
            asyncio.create_task(self._regularly(SWEEP_SECONDS, self._forget)),
            asyncio.create_task(self._regularly(settings.collect_seconds, self._collect)),
            asyncio.create_task(self._regularly(ROOM_LOOK_SECONDS, self._keep_room)),
        ]
        takers = [
            asyncio.create_task(self._around.slips.work(queue, slots, self._deliver))
            for queue, slots in self._queues.items()
        ]
        logger.info("worker %s takes %s", self._name, dict(self._queues) or "no jobs, only care of lost ones")
        try:
            left = asyncio.create_task(self._around.leaving.wait())
            await asyncio.wait({left, *takers}, return_when=asyncio.FIRST_COMPLETED)
            # A queue that ends by itself has lost the database; running jobs go on as long as they may.
            self._lost = self._lost or not self._around.leaving.is_set()
            self._around.slips.stop()
            for outcome in await asyncio.gather(*takers, return_exceptions=True):
                if isinstance(outcome, Exception):
                    logger.warning("a queue ended: %s", outcome)
            left.cancel()
        finally:
            for chore in chores:
                chore.cancel()
            await asyncio.gather(*chores, return_exceptions=True)
        if self._lost:
            return EXIT_LOST_DATABASE
        with contextlib.suppress(*DATABASE_ERRORS):
            async with asyncio.timeout(5), self._pool.connection() as connection:
                await forget_worker(connection, self._id)
        return 0

    def _leave(self) -> None:
        logger.info("worker %s stops and hands back its jobs", self._name)
        self._around.leaving.set()
        self._around.slips.stop()

    async def _deliver(self, job_id: uuid.UUID, slip: int) -> None:
        if self._around.leaving.is_set():
            await self._refuse(job_id, slip)
            return
        if not await self._room_comes(job_id):
            await self._refuse(job_id, slip)
            return
        since = time.monotonic()
        attempt = await claim(self._pool, job_id, slip, self._name)
        if attempt is None:
            return
        supervisor = Supervisor(attempt, self._around, since)
        try:
            await supervisor.run()
        except LostDatabase as error:
            logger.warning("job %s was let go: %s", job_id, error)
            self._lost = True
            self._around.slips.stop()
        if supervisor.lacked_room:
            self._cramped[job_id] = await self._around.free_bytes(), time.monotonic()

    async def _room_comes(self, job_id: uuid.UUID) -> bool:
        """Wait a while for room where there is none; jobs stay queued meanwhile."""
        deadline = time.monotonic() + ROOM_SECONDS
        while (lacking := await self._lacking_room(job_id)) is not None:
            if not self._told_of_room:
                logger.warning("worker %s takes no jobs: %s", self._name, lacking)
            self._told_of_room = True
            await self._make_room()
            if time.monotonic() > deadline or self._around.leaving.is_set():
                return False
            await asyncio.sleep(self._settings.poll_seconds)
        if self._told_of_room:
            logger.info("worker %s has room again", self._name)
        self._told_of_room = False
        return True

    async def _lacking_room(self, job_id: uuid.UUID) -> str | None:
        """What lacks room for a job, in a sentence, or None."""
        if (lacking := await self._around.lacking_room()) is not None:
            return lacking
        if job_id in self._cramped:
            left_bytes, at = self._cramped[job_id]
            more = await self._around.free_bytes() > 1.05 * max(0, left_bytes) + LEAST_BYTES
            if not more and time.monotonic() - at < CRAMPED_SECONDS:
                return f"A disk was full when the job was tried, and {left_bytes} bytes were left after it."
            del self._cramped[job_id]
        return None

    async def _keep_room(self) -> None:
        if await self._around.lacking_room() is not None:
            await self._make_room()

    async def _make_room(self) -> None:
        """Remove what nobody names, and photographs that can be had from the store again."""
        try:
            await asyncio.to_thread(sweep_workspaces, self._settings.work_folder, 0.0)
            await collect_at_once(self._pool, self._around.storage)
        except (StorageError, *DATABASE_ERRORS) as error:
            logger.info("unused contents were not collected: %s", error)

    async def _refuse(self, job_id: uuid.UUID, slip: int) -> None:
        """Leave a job to other workers whose slip came too late to this one."""
        async with self._pool.connection() as connection, connection.transaction():
            job = await get_job(connection, job_id, lock=True)
            if job is not None and job.state == "queued" and job.slip == slip:
                await queue_again(connection, self._around.slips, job, keep_slip=True)

    async def _regularly(self, seconds: float, chore: Callable[[], Awaitable[None]]) -> None:
        while True:
            try:
                await chore()
            except DATABASE_ERRORS as error:
                logger.info("%s has to wait: %s", chore.__name__, error)
            await asyncio.sleep(seconds)

    async def _say_alive(self) -> None:
        async with self._pool.connection() as connection:
            await see_worker(
                connection,
                self._id,
                name=self._name,
                queues=list(self._queues),
                slots=sum(self._queues.values()),
                facts=self._facts(),
            )

    def _facts(self) -> dict[str, Any]:
        memory = psutil.virtual_memory()
        return {
            "host": socket.gethostname(),
            "pid": os.getpid(),
            "version": engine.__version__,
            "python": platform.python_version(),
            "cores": os.cpu_count(),
            "threads": self._settings.threads or available_threads(),
            "formats": list(writable_formats()),
            "memory_bytes": memory.total,
            "memory_free_bytes": memory.available,
            "memory_limit_bytes": self._around.memory_limit_bytes,
        }

    async def _rescue(self) -> None:
        await rescue_lost_jobs(self._pool, self._around.slips, self._settings.stale_seconds)
        async with self._pool.connection() as connection:
            await forget_lost_workers(connection, max(60.0, 3 * self._settings.stale_seconds))

    async def _send_webhooks(self) -> None:
        await send_due(self._pool, self._settings.webhook_hosts)

    async def _forget(self) -> None:
        """Let go of what is older than it is to be kept."""
        async with self._pool.connection() as connection:
            await set_expiries(connection, self._settings.retention)
            await forget_expired(connection)
            await forget_old(connection)
            await forget_old_keys(connection)
            await forget_old_sessions(connection)
            await forget_old_entries(connection, self._settings.keep_audit_hours)
        for job_id in await end_abandoned(
            self._pool,
            self._around.slips,
            stale_seconds=self._settings.stale_seconds,
            hours=self._settings.absent_queue_hours,
        ):
            logger.warning("job %s waited too long in a queue that no worker takes", job_id)

    async def _collect(self) -> None:
        try:
            await collect(
                self._pool,
                self._around.storage,
                unused_seconds=3600 * self._settings.keep_unused_hours,
                every_seconds=0.9 * self._settings.collect_seconds,
            )
        except StorageError as error:
            logger.info("unused contents were not collected: %s", error)

    async def _sweep(self) -> None:
        await asyncio.to_thread(sweep_workspaces, self._settings.work_folder)

    async def _sweep_store(self) -> None:
        """Remove what killed uploads left in the store; no upload takes a day."""
        try:
            await asyncio.to_thread(self._around.storage.sweep, ABANDONED_SECONDS)
        except StorageError as error:
            logger.info("the store was not swept: %s", error)


def _on_stray_exception(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """A delivery that was taken from this worker cannot be signed off any more, which is as it should be."""
    error = context.get("exception")
    if isinstance(error, ConnectorException):
        logger.info("a slip of another attempt was left alone: %s", error.__cause__ or error)
    else:
        loop.default_exception_handler(context)

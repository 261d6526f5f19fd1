"""The process of a worker: takes slips from its queues, supervises attempts, and looks after lost jobs."""

import asyncio
import contextlib
import importlib
import logging
import os
import platform
import signal
import socket
import tempfile
import time
import uuid
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import psutil
from procrastinate.exceptions import ConnectorException

from octasplat.engine import __version__
from octasplat.engine.files import writable_formats
from octasplat.engine.threads import available_threads
from octasplat.workers.ending import end
from octasplat.workers.isolation.abilities import abilities, tell_what_lacks
from octasplat.workers.isolation.hiding import hide_memory
from octasplat.workers.parent import die_with_server
from octasplat.workers.queue.attempts import Fenced, claim
from octasplat.workers.queue.fairness import choose
from octasplat.workers.queue.limits import end_abandoned
from octasplat.workers.queue.procrastinate_slips import ProcrastinateSlips
from octasplat.workers.queue.rescue import Suspects, rescue_lost_jobs
from octasplat.workers.records.database import Pool, open_pool
from octasplat.workers.records.ids import new_id
from octasplat.workers.records.migrate import wait_for_tables
from octasplat.workers.records.workers import forget_lost_workers, forget_worker, see_worker
from octasplat.workers.settings import WorkerSettings, worker_connections
from octasplat.workers.store.errors import StorageError
from octasplat.workers.store.local import LocalStorage
from octasplat.workers.store.opening import open_storage
from octasplat.workers.store.room import Room
from octasplat.workers.upkeep.collecting import collect
from octasplat.workers.upkeep.retention import forget_old_things, thin_progress
from octasplat.workers.upkeep.webhooks.sending import Sender
from octasplat.workers.work.chores import Chore, ChoreFailed, keep_doing
from octasplat.workers.work.contact import DATABASE_ERRORS
from octasplat.workers.work.fitness import announced, unfit
from octasplat.workers.work.host import Host
from octasplat.workers.work.memory import memory_limit_bytes
from octasplat.workers.work.openings import Openings, put_off
from octasplat.workers.work.supervisor import Supervisor
from octasplat.workers.work.surroundings import LostDatabase, Surroundings
from octasplat.workers.work.workspace import sweep_temporary, sweep_workspaces

logger = logging.getLogger(__name__)

RESCUE_LATE_SECONDS = 60.0
"""Looking for lost jobs is begun again after this time, so that nothing that hangs keeps them waiting."""
SWEEP_SECONDS = 60.0
STORE_SWEEP_SECONDS = 3600.0
THIN_SECONDS = 600.0
ABANDONED_SECONDS = 86_400.0
ROOM_LOOK_SECONDS = 5.0
WORKERS_BACK_SECONDS = 600.0
"""A queue is taken for abandoned when it has been seen without a worker for so long, however old its jobs."""
LEFT_POLLS = 3
"""A job that is left to workers of another version is kept from all for so many looks at the queue ..."""
LEFT_SECONDS = 15.0
"""... and for twice as many each further time, up to this time."""
EXIT_LOST_DATABASE = 69
FORGIVEN_FAILURES = 3
"""So many failures of workers over one job, one after another, are taken for their own fault."""


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
    hide_memory()
    if not die_with_server():
        tell_what_lacks()
    settings.checked()
    for module in settings.kind_modules:
        importlib.import_module(module)
    conninfo = settings.conninfo()
    await asyncio.to_thread(wait_for_tables, conninfo)
    floor_bytes = settings.floor_bytes // 4  # the rest of it is for what jobs under way have to store
    storage = await asyncio.to_thread(lambda: open_storage(settings.storage_address, floor_bytes=floor_bytes))
    name = name or f"{socket.gethostname()}-{os.getpid()}"
    room = Room(
        storage, settings.work_folder, settings.floor_bytes,
        above_bytes=settings.floor_bytes - floor_bytes, reserve_bytes=floor_bytes,
        store_folder=storage.root if isinstance(storage, LocalStorage) else None,
    )  # fmt: skip
    host = Host(
        name, settings.work_folder, storage,
        kind_modules=settings.kind_modules, rest_seconds=settings.recover_seconds,
    )  # fmt: skip
    slots = sum(queues.values())
    async with open_pool(
        conninfo, max_size=worker_connections(queues), wait_seconds=settings.stale_seconds
    ) as pool:
        worker = _Worker(
            settings,
            pool,
            Surroundings(
                settings,
                make_slips(settings, pool),
                storage,
                room,
                host,
                asyncio.Event(),
                memory_limit_bytes(settings.memory_limit_bytes, slots),
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
        self._openings = Openings(name, pool, around)
        self._left: Counter[uuid.UUID] = Counter()
        # A worker that lives is heard of in between, also where all of this machine stood still.
        self._suspects = Suspects(1.5 * settings.heartbeat_seconds + settings.poll_seconds)
        self._abandoned = Suspects(WORKERS_BACK_SECONDS)
        self._sender = Sender(pool, settings.webhook_hosts)

    async def run(self) -> int:
        loop = asyncio.get_running_loop()
        loop.set_exception_handler(_on_stray_exception)
        for number in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(number, self._leave)
        settings = self._settings
        chores = [
            asyncio.create_task(keep_doing(chore))
            for chore in (
                Chore(self._say_alive, settings.heartbeat_seconds, max(60.0, settings.stale_seconds)),
                Chore(self._rescue, settings.rescue_seconds, RESCUE_LATE_SECONDS),
                Chore(self._sweep, SWEEP_SECONDS),
                Chore(self._sweep_store, STORE_SWEEP_SECONDS),
                Chore(self._send_webhooks, settings.poll_seconds),
                Chore(self._forget, SWEEP_SECONDS),
                Chore(self._thin, THIN_SECONDS),
                Chore(self._collect, settings.collect_seconds),
                Chore(self._openings.keep, ROOM_LOOK_SECONDS),
            )
        ]
        logger.info("worker %s takes %s", self._name, dict(self._queues) or "no jobs, only care of lost ones")
        try:
            await self._take_jobs(chores)
        finally:
            for outcome in await end(chores):
                if isinstance(outcome, ChoreFailed):
                    logger.error("worker %s ends, as %s", self._name, outcome)
            await self._sender.close()
        if self._lost:
            return EXIT_LOST_DATABASE
        with contextlib.suppress(*DATABASE_ERRORS):
            async with asyncio.timeout(5), self._pool.connection() as connection:
                await forget_worker(connection, self._id)
        return 0

    async def _take_jobs(self, chores: Sequence["asyncio.Task[None]"]) -> None:
        """Take jobs until asked to stop, or all is lost; none while something ails the machine."""
        host, slips = self._around.host, self._around.slips
        left = asyncio.create_task(self._around.leaving.wait())
        while not self._around.leaving.is_set() and not self._lost:
            host.changed.clear()
            ails = asyncio.create_task(host.changed.wait())
            takers = [
                asyncio.create_task(slips.work(queue, slots, self._deliver))
                for queue, slots in self._queues.items()
            ]
            await asyncio.wait({left, ails, *chores, *takers}, return_when=asyncio.FIRST_COMPLETED)
            # A queue that ends by itself has lost the database; running jobs go on as long as they may. What
            # a chore did nobody does any more after its end, so that they are handed back.
            self._lost = self._lost or not (self._around.leaving.is_set() or host.ailing)
            if any(chore.done() for chore in chores):
                self._lost = True
                self._around.leaving.set()
            slips.pause()
            for outcome in await asyncio.gather(*takers, return_exceptions=True):
                if isinstance(outcome, Exception):
                    logger.warning("a queue ended: %s", outcome)
            ails.cancel()
            while host.ailing and not self._around.leaving.is_set() and not self._lost:
                seconds = self._settings.recover_seconds
                await asyncio.wait({left, *chores}, timeout=seconds, return_when=asyncio.FIRST_COMPLETED)
                if any(chore.done() for chore in chores) or await host.recover():
                    break
        left.cancel()

    def _leave(self) -> None:
        logger.info("worker %s stops and hands back its jobs", self._name)
        self._around.leaving.set()
        self._around.slips.stop()

    async def _deliver(self, job_id: uuid.UUID, slip: int) -> None:
        if self._around.leaving.is_set():
            await self._refuse(job_id, slip)
            return
        if (fault := await self._around.host.look()) is not None:
            self._around.host.fail(fault)
        if self._around.host.ailing is not None:
            await self._refuse(job_id, slip)
            return
        chosen = await choose(self._pool, self._around.slips, job_id, slip)
        if chosen is None or await self._leaves(*chosen) or not await self._openings.come(*chosen):
            return
        job_id, slip = chosen
        since = time.monotonic()
        attempt = await claim(self._pool, job_id, slip, self._name)
        if attempt is None:
            return
        try:
            await Supervisor(attempt, self._around, since).run()
        except LostDatabase as error:
            logger.warning("job %s was let go: %s", job_id, error)
            self._lost = True
            self._around.slips.stop()
        except Exception as error:
            # A fault of this program, or of what it runs on, and not of the job.
            logger.exception("the attempt at job %s failed in its worker", job_id)
            self._around.host.fail(f"it cannot look after jobs ({type(error).__name__}: {error})")
            with contextlib.suppress(Fenced, *DATABASE_ERRORS):
                # Not with the error's text, which may differ each time.
                reason = f"its worker failed ({type(error).__name__})"
                await attempt.hand_back(self._around.slips, reason, uncounted=FORGIVEN_FAILURES)

    async def _leaves(self, job_id: uuid.UUID, slip: int) -> bool:
        """Whether a job was left to workers of another version."""
        why = await unfit(self._pool, job_id, self._settings.stale_seconds)
        if why is None:
            return False
        if not self._left[job_id]:
            logger.warning("worker %s leaves job %s to others: %s", self._name, job_id, why)
        # Rarer each time, so that however many there are they do not keep it from those that it can do.
        wait_seconds = LEFT_POLLS * self._settings.poll_seconds * 2 ** min(self._left[job_id], 10)
        wait_seconds = min(wait_seconds, LEFT_SECONDS)
        self._left[job_id] += 1
        await put_off(self._pool, self._around.slips, job_id, slip, wait_seconds)
        return True

    async def _refuse(self, job_id: uuid.UUID, slip: int) -> None:
        """Leave a job to other workers whose slip came too late to this one."""
        await put_off(self._pool, self._around.slips, job_id, slip)

    async def _say_alive(self) -> None:
        facts = await asyncio.to_thread(self._facts)
        async with self._pool.connection() as connection:
            await see_worker(
                connection,
                self._id,
                name=self._name,
                queues=list(self._queues),
                slots=sum(self._queues.values()),
                facts=facts,
            )

    def _facts(self) -> dict[str, Any]:
        memory, room = psutil.virtual_memory(), self._around.room
        try:
            disk = {"disk_bytes": room.capacity_bytes(), "disk_free_bytes": room.free_bytes()}
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
            "memory_limit_bytes": self._around.memory_limit_bytes,
            "ailing": self._around.host.ailing,
            "isolation": abilities(),
            **announced(),
        }

    async def _rescue(self) -> None:
        await rescue_lost_jobs(self._pool, self._around.slips, self._settings.stale_seconds, self._suspects)
        async with self._pool.connection() as connection:
            await forget_lost_workers(connection, max(60.0, 3 * self._settings.stale_seconds))

    async def _send_webhooks(self) -> None:
        await self._sender.begin()

    async def _forget(self) -> None:
        """Let go of what is older than it is to be kept."""
        await forget_old_things(self._pool, self._settings.retention, self._settings.keep_audit_hours)
        for job_id in await end_abandoned(
            self._pool,
            self._around.slips,
            stale_seconds=self._settings.stale_seconds,
            hours=self._settings.absent_queue_hours,
            suspects=self._abandoned,
        ):
            logger.warning("job %s waited too long in a queue that no worker takes", job_id)

    async def _thin(self) -> None:
        async with self._pool.connection() as connection:
            await thin_progress(connection)

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
        await asyncio.to_thread(sweep_temporary, Path(tempfile.gettempdir()), ABANDONED_SECONDS)

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

"""Local service: the database, front end and workers of one machine."""

import asyncio
import contextlib
import fcntl
import logging
import os
import signal
from collections.abc import Awaitable, Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from octasplat.engine.core.errors import OctasplatError, OutputError
from octasplat.engine.core.isolated_python import python_command
from octasplat.engine.core.writing import write_json
from octasplat.engine.files.splat_transform import PROGRAM_VARIABLE as SPLAT_TRANSFORM
from octasplat.workers.cancellation import cancel_and_wait
from octasplat.workers.data_folder import ADDRESS_FILE, TOKEN_FILE
from octasplat.workers.db.migrate import migrate
from octasplat.workers.postgres.embedded import MIN_CONNECTIONS, EmbeddedPostgres
from octasplat.workers.sandbox.capabilities import log_missing_capabilities
from octasplat.workers.sandbox.hiding import forbid_memory_access
from octasplat.workers.serve.bootstrap_token import ensure_bootstrap_token
from octasplat.workers.serve.supervised_process import SupervisedProcess, kill_after_timeout
from octasplat.workers.settings import PREFIX, WorkerSettings, worker_connections

logger = logging.getLogger(__name__)

READY_SECONDS = 180.0
DATABASE_CHECK_SECONDS = 1.0
SPARE_CONNECTIONS = 40
EXTRA_GRACE_SECONDS = 60.0
"""Processes that were asked to stop have so much longer than their jobs have for checkpoints."""


@dataclass(frozen=True)
class ServeOptions:
    """Options of the local service.

    Attributes:
        settings: of everything.
        host: address to listen at; None takes that of the environment.
        port: port to listen at; None takes that of the environment.
        queues: queues of the worker of this machine and their jobs at once; empty runs none.
    """

    settings: WorkerSettings
    host: str | None
    port: int | None
    queues: Mapping[str, int]


async def serve(options: ServeOptions, on_ready: Callable[[str], Awaitable[None] | None]) -> int:
    """Run everything until asked to stop by a signal, or until ``on_ready`` says that it was all.

    Args:
        options: what to run.
        on_ready: told the address once requests are taken; if it returns an awaitable, its end ends all.

    Returns:
        Exit code.

    Raises:
        OctasplatError: something cannot be started.
    """
    forbid_memory_access()
    settings = options.settings
    log_missing_capabilities(settings.job_uids)
    with lock_data_folder(settings.data) as address_file:
        database = (
            EmbeddedPostgres(settings.data.absolute(), connections_needed(options))
            if settings.database_url is None
            else None
        )
        try:
            conninfo = (
                await asyncio.to_thread(database.start) if database is not None else settings.conninfo()
            )
            await asyncio.to_thread(migrate, conninfo)
            await ensure_bootstrap_token(conninfo, settings.data / TOKEN_FILE)
            return await _run(options, database, conninfo, address_file, on_ready)
        finally:
            # First, so that no client is sent to a service that ends.
            address_file.unlink(missing_ok=True)
            if database is not None:
                await asyncio.to_thread(database.stop)


def connections_needed(options: ServeOptions) -> int:
    """Return the database connections for the processes of this machine, and some for other commands."""
    front = options.settings.pool_size + 1
    workers = [worker_connections({}), *([worker_connections(options.queues)] if options.queues else [])]
    return max(MIN_CONNECTIONS, front + sum(workers) + SPARE_CONNECTIONS)


async def _run(
    options: ServeOptions,
    database: EmbeddedPostgres | None,
    conninfo: str,
    address_file: Path,
    on_ready: Callable[[str], Awaitable[None] | None],
) -> int:
    address: asyncio.Future[str] = asyncio.get_running_loop().create_future()

    def on_line(line: str) -> None:
        if line.startswith("http"):
            write_json(address_file, {"url": line})
            if not address.done():
                address.set_result(line)
                # Whoever talks to the front end finds it there again after a restart.
                api.set_variable(f"{PREFIX}PORT", line.rpartition(":")[2])

    environment = {"DATABASE_URL": conninfo, **_path_variables(options.settings)}
    listen = {"HOST": options.host, "PORT": None if options.port is None else str(options.port)}
    front = {f"{PREFIX}{name}": value for name, value in listen.items() if value is not None}
    api = SupervisedProcess(
        "front end", _python_command(options, "octasplat.service.serving"), {**environment, **front}, on_line
    )
    command = _python_command(options, "octasplat", "worker", "--queues")
    # A worker without queues takes no jobs: it recovers lost ones and does the periodic work.
    children = [api, SupervisedProcess("maintenance", (*command, "", "--name", "maintenance"), environment)]
    if options.queues:
        queues = ",".join(f"{name}={slots}" for name, slots in options.queues.items())
        children.append(SupervisedProcess("worker", (*command, queues), environment))
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()

    def leave() -> None:
        # A second signal kills them, see SupervisedProcess.stop.
        if stop.is_set():
            for child in children:
                child.stop()
        stop.set()

    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, leave)
    tasks = [asyncio.create_task(api.supervise())]
    guard = asyncio.create_task(_restart_database(database))
    stopped = asyncio.create_task(stop.wait())
    work: asyncio.Future[None] | None = None
    try:
        await _wait_until_ready(api, address, stopped)
        # After the front end, so that they do not take its processor time; nobody misses them yet.
        tasks += [asyncio.create_task(child.supervise()) for child in children[1:]]
        if not stop.is_set():
            ready = on_ready(address.result())
            work = asyncio.ensure_future(ready) if ready is not None else None
            await asyncio.wait({stopped, *([work] if work else [])}, return_when=asyncio.FIRST_COMPLETED)
            if work is not None and work.done():
                work.result()
        return 0
    finally:
        if work is not None:
            work.cancel()
        stop.set()
        # Workers first, so that they can hand back their jobs while everything else still runs.
        for child in reversed(children):
            child.stop()
        await kill_after_timeout(children, tasks, options.settings.grace_seconds + EXTRA_GRACE_SECONDS)
        await cancel_and_wait([guard, stopped])


def _python_command(options: ServeOptions, module: str, *arguments: str) -> tuple[str, ...]:
    return python_command(module, *arguments, further_modules=options.settings.kind_modules)


def _path_variables(settings: WorkerSettings) -> dict[str, str]:
    """Return environment variables with absolute paths, valid in any working folder."""
    places = {
        f"{PREFIX}DATA": str(settings.data.absolute()),
        f"{PREFIX}WORK": str(settings.work_folder),
    }
    if settings.storage is not None and "://" not in settings.storage:
        places[f"{PREFIX}STORAGE"] = str(Path(settings.storage).absolute())
    if named := os.environ.get(SPLAT_TRANSFORM):
        places[SPLAT_TRANSFORM] = str(Path(named).absolute())
    return places


async def _wait_until_ready(
    api: SupervisedProcess, address: "asyncio.Future[str]", stopped: "asyncio.Task[bool]"
) -> None:
    """Wait until the front end accepts requests.

    Raises:
        OutputError: it does not start.
    """
    try:
        async with asyncio.timeout(READY_SECONDS):
            while not address.done() and not stopped.done():
                await asyncio.sleep(0.02)
                if api.last_exit_code is not None and not address.done():
                    raise OutputError("The front end does not start; what it said stands above.")
    except TimeoutError:
        raise OutputError(
            f"The front end was not ready after {READY_SECONDS:g} s; this machine may be too busy."
        ) from None


async def _restart_database(database: EmbeddedPostgres | None) -> None:
    """Restart the private database whenever it ends."""
    while database is not None:
        await asyncio.sleep(DATABASE_CHECK_SECONDS)
        await asyncio.to_thread(database.rotate_log)
        if await asyncio.to_thread(database.is_alive):
            continue
        logger.warning("the database ended; starting it again")
        try:
            await asyncio.to_thread(database.start)
        except OctasplatError as error:
            logger.error("%s", error)
        except Exception:
            logger.exception("the database could not be started and is tried again")


@contextlib.contextmanager
def lock_data_folder(data: Path) -> Iterator[Path]:
    """Hold the data folder; yields the path of the file that says where the service is.

    Raises:
        OutputError: the folder cannot be used, or another ``octasplat serve`` does.
    """
    try:
        if not data.exists():
            data.mkdir(parents=True)
            data.chmod(0o711)  # below, everything is shut; the database's user has to pass through
        handle = (data / "serve.lock").open("w")
    except OSError as error:
        raise OutputError(
            f"{data} cannot be used ({error.strerror or error}); name another folder with --data."
        ) from None
    address_file = data / ADDRESS_FILE
    with handle:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise OutputError(
                f"Another octasplat serve uses {data}; use that one, or name another folder with --data."
            ) from None
        yield address_file

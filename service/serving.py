"""The front end alone, configured by the environment: the program behind ``octasplat api``.

On SIGTERM requests under way are finished and streams end.
"""

import asyncio
import contextlib
import gc
import logging
import socket
import sys
from collections.abc import Callable
from functools import partial

import uvicorn
from fastapi import FastAPI

from octasplat.engine.core.errors import OctasplatError
from octasplat.service.app import create_app
from octasplat.service.connection_limits import ACCEPT_BACKLOG, raise_file_limit
from octasplat.service.limited_protocol import (
    ConnectionTable,
    LimitedConfig,
    LimitedProtocol,
    log_loop_error,
)
from octasplat.service.request_id import RequestIdFilter
from octasplat.service.settings import ServiceSettings
from octasplat.workers.logs import RepeatedMessages, log_to_stderr
from octasplat.workers.parent_death_signal import die_with_local_service
from octasplat.workers.sandbox.capabilities import log_missing_capabilities
from octasplat.workers.sandbox.hiding import forbid_memory_access
from octasplat.workers.settings import load_settings

SHUTDOWN_SECONDS = 10
KEEP_ALIVE_SECONDS = 75
_LISTEN_BACKLOG = 2048
"""Connections that wait to be accepted."""
_TICKS_PER_SECOND = 10
"""Of uvicorn."""


class _FrontEndServer(uvicorn.Server):
    """Server that ends event streams first when asked to stop, as they never end by themselves."""

    def __init__(self, config: LimitedConfig) -> None:
        super().__init__(config)
        self._connections = config.connections
        self.address = ""
        self.on_start: Callable[[], None] = _do_nothing

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start the server, call ``on_start`` and print the address."""
        asyncio.get_running_loop().set_exception_handler(log_loop_error)
        await super().startup(sockets)
        # asyncio has one number for both backlogs; connections may wait in a longer queue than is accepted at
        # once.
        for listener in sockets or ():
            listener.listen(_LISTEN_BACKLOG)
        if self.started:
            self.on_start()
            # octasplat serve waits for this line.
            sys.stdout.write(f"{self.address}\n")
            sys.stdout.flush()

    async def on_tick(self, counter: int) -> bool:
        """Close overdue connections, once a second."""
        if counter % _TICKS_PER_SECOND == 0:
            self._connections.close_overdue()
        return await super().on_tick(counter)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Drain the service, close its event streams, and stop the server."""
        state = getattr(self.config.loaded_app, "state", None)
        service = getattr(state, "service", None)
        if service is not None:
            service.is_draining = True
            service.event_broker.close()
        await super().shutdown(sockets)


def main() -> int:
    """Serve until asked to stop; the address goes to stdout once requests are taken."""
    forbid_memory_access()
    log_to_stderr()
    for handler in logging.getLogger().handlers:
        handler.addFilter(RequestIdFilter())
    is_alone = not die_with_local_service()
    try:
        settings = load_settings(ServiceSettings)
        app = create_app(settings)
        family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
        # With the protocol named, asyncio turns Nagle's algorithm off; answers would take 40 ms more.
        listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
        # Else a restart would have to wait until the system forgets the connections of before.
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind((settings.host, settings.port))
        except OSError as error:
            where = f"{settings.host}:{settings.port}"
            sys.stderr.write(f"Error: {where} cannot be listened at ({error.strerror}).\n")
            return 1
        config = LimitedConfig(
            app,
            http=LimitedProtocol,
            ws="none",  # nothing here speaks it, and its connections would be counted for ever
            backlog=ACCEPT_BACKLOG,
            log_config=None,
            access_log=False,
            lifespan="on",
            timeout_graceful_shutdown=SHUTDOWN_SECONDS,
            timeout_keep_alive=KEEP_ALIVE_SECONDS,
            server_header=False,
            proxy_headers=False,
        )
        config.connections = ConnectionTable(settings.connection_limits(raise_file_limit()))
        server = _FrontEndServer(config)
        name = f"[{settings.host}]" if family == socket.AF_INET6 else settings.host
        server.address = f"http://{name}:{listener.getsockname()[1]}"
        log = logging.getLogger("uvicorn.error")
        log.setLevel(logging.WARNING)
        log.addFilter(RepeatedMessages())
        # Such an error is told below in one sentence, so that uvicorn's traceback is left out.
        log.addFilter(lambda _record: _startup_error(app) is None)
        # What is there for good is not looked through again by each full collection, with the loop held.
        gc.collect()
        gc.freeze()
        if is_alone:
            server.on_start = partial(log_missing_capabilities, settings.job_uids)
        # So uvicorn ends where the application does not start, of which is told below.
        with contextlib.suppress(SystemExit):
            asyncio.run(server.serve(sockets=[listener]))
        if (failure := _startup_error(app)) is not None:
            raise failure
    except OctasplatError as error:
        sys.stderr.write(f"Error: {error}\n")
        return 1
    return 0 if server.started else 1


def _do_nothing() -> None:
    pass


def _startup_error(app: FastAPI) -> OctasplatError | None:
    """Return the error that kept the application from starting, if it is one for users; else None."""
    failure: OctasplatError | None = getattr(app.state, "failure", None)
    return failure


if __name__ == "__main__":
    raise SystemExit(main())

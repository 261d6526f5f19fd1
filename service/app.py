"""The application: routes, guards, and what lives as long as it does."""

import asyncio
import importlib
import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from fastapi import FastAPI

from octasplat.engine import __version__
from octasplat.engine.errors import OctasplatError
from octasplat.service.auditing import AuditTrail
from octasplat.service.forwarding import ProxyHeaders
from octasplat.service.gate import Gate
from octasplat.service.guards import BodyGuard, HostGuard, OriginGuard, SafeHeaders
from octasplat.service.guesses import Guesses
from octasplat.service.hub import EventHub
from octasplat.service.making_room import RoomMaker
from octasplat.service.openapi import describe_fully
from octasplat.service.problems import add_problem_handlers
from octasplat.service.routes import (
    artifacts,
    audit,
    datasets,
    estimates,
    jobs,
    journal,
    metrics,
    system,
    webhooks,
)
from octasplat.service.settings import ServiceSettings
from octasplat.service.state import Service
from octasplat.service.web import mount_pages
from octasplat.workers.ending import end
from octasplat.workers.queue.procrastinate_slips import ProcrastinateSlips
from octasplat.workers.records.database import open_pool
from octasplat.workers.records.migrate import migrate
from octasplat.workers.records.tokens import add_environment_token, any_token
from octasplat.workers.store.opening import open_storage

logger = logging.getLogger(__name__)

DESCRIPTION = """Photographs in, scenes of flat Gaussians and their octagon meshes out.

1. `POST /v1/datasets`, then `PUT` each file to `/v1/datasets/{id}/files/images/...` (and the COLMAP model to
   `sparse/0/...`), or one ZIP file to `/archive`; `GET .../files` says what has arrived.
2. `POST /v1/datasets/{id}/commit` checks it.
3. `POST /v1/jobs`, then poll its `Location` or listen to `/events`.
4. `GET /v1/jobs/{id}/artifacts`.

Errors are problem documents (RFC 9457).
"""


def create_app(settings: ServiceSettings | None = None) -> FastAPI:
    """The application.

    Args:
        settings: by default those of the environment.

    Raises:
        ConfigError: the settings do not fit together.
    """
    settings = settings or ServiceSettings()
    settings.checked()
    for module in settings.kind_modules:
        importlib.import_module(module)

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        try:
            async with _running(settings) as service:
                app.state.service = service
                yield
                service.draining = True
        except OctasplatError as error:
            app.state.failure = error  # for whoever started it, as the server knows a traceback only
            raise

    app = FastAPI(
        title="octasplat",
        version=__version__,
        summary="A reconstruction service",
        description=DESCRIPTION,
        lifespan=lifespan,
        docs_url=None,  # the pages have their own, which needs nothing from elsewhere
        redoc_url=None,
        license_info={"name": "Apache-2.0", "identifier": "Apache-2.0"},
    )
    for module_router in (
        datasets.router, jobs.router, estimates.router,
        journal.router, artifacts.router, webhooks.router, system.router,
        system.health_router, metrics.router, audit.router,
    ):  # fmt: skip
        app.include_router(module_router)
    mount_pages(app)
    add_problem_handlers(app)
    describe_fully(app)
    app.add_middleware(AuditTrail)
    app.add_middleware(BodyGuard, max_body_bytes=settings.max_body_bytes)
    app.add_middleware(OriginGuard)
    if settings.is_private:
        app.add_middleware(HostGuard, names=settings.allowed_hosts)
    app.add_middleware(SafeHeaders)
    if settings.proxies:
        app.add_middleware(ProxyHeaders, proxies=settings.proxies, dialect=settings.proxy_headers)
    return app


@asynccontextmanager
async def _running(settings: ServiceSettings) -> AsyncIterator[Service]:
    """Database, store and listener for as long as the application lives."""
    conninfo = settings.conninfo()
    await asyncio.to_thread(migrate, conninfo)
    storage = await asyncio.to_thread(
        lambda: open_storage(settings.storage_address, floor_bytes=settings.floor_bytes)
    )
    async with open_pool(conninfo, max_size=settings.pool_size, wait_seconds=10) as pool:
        async with pool.connection() as connection:
            if settings.token is not None:
                token = await add_environment_token(connection, settings.token.get_secret_value())
                if token.revoked_at is not None:
                    logger.warning("the token of OCTASPLAT_TOKEN was revoked and stays so; set another one")
            settings.check_public(await any_token(connection))
        hub = EventHub(conninfo, listen=settings.listen)
        listening = asyncio.create_task(hub.run())
        room = RoomMaker(pool, storage)
        try:
            guesses = Guesses(settings.wrong_token_seconds)
            yield Service(
                settings,
                pool,
                ProcrastinateSlips(),
                storage,
                hub,
                room,
                guesses,
                settings.spool(),
                _checks(settings),
            )
        finally:
            await room.close()
            hub.close()
            await end([listening])


def _checks(settings: ServiceSettings) -> Gate:
    """Lets in those whose datasets are checked; half of the places are there for other owners."""
    at_once, waiting = settings.max_checks, settings.max_waiting_checks
    return Gate("datasets", at_once=at_once, waiting=waiting, of_one_owner=-(-(at_once + waiting) // 2))

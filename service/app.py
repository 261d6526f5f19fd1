"""The application: routes, middleware, and resources of its lifespan."""

import asyncio
import importlib
import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from fastapi import Depends, FastAPI

from octasplat.engine import __version__
from octasplat.engine.core.errors import ConfigError, OctasplatError
from octasplat.service.actions.task_runner import TaskRunner
from octasplat.service.audit_middleware import AuditMiddleware
from octasplat.service.event_broker import EventBroker
from octasplat.service.eviction import SpaceEvictor
from octasplat.service.json_bounds import JsonBoundsMiddleware
from octasplat.service.login_throttle import LoginThrottle
from octasplat.service.middleware import (
    AllowedHostsMiddleware,
    BodyLimitMiddleware,
    CompressionMiddleware,
    MessageFramingMiddleware,
    SameOriginMiddleware,
    SecurityHeadersMiddleware,
)
from octasplat.service.openapi import extend_openapi, operation_id
from octasplat.service.problems import add_problem_handlers
from octasplat.service.proxy_headers import ProxyHeadersMiddleware
from octasplat.service.query_parameters import refuse_unknown_parameters
from octasplat.service.request_id import RequestIdMiddleware
from octasplat.service.routes import (
    artifacts,
    audit,
    dataset_tasks,
    datasets,
    estimates,
    events_and_logs,
    jobs,
    metrics,
    resumable_uploads,
    scene_previews,
    system,
    tokens,
    webhook_messages,
    webhooks,
)
from octasplat.service.settings import ServiceSettings
from octasplat.service.state import Service
from octasplat.service.web import mount_pages
from octasplat.workers.cancellation import cancel_and_wait
from octasplat.workers.db.connections import open_pool
from octasplat.workers.db.migrate import migrate
from octasplat.workers.db.tokens import add_environment_token, has_any_token
from octasplat.workers.queue.procrastinate_queue import ProcrastinateQueue
from octasplat.workers.settings import PREFIX
from octasplat.workers.storage.factory import open_storage

logger = logging.getLogger(__name__)

DESCRIPTION = """Photographs in, scenes of flat Gaussians and their octagon meshes out.

1. `POST /v1/datasets`, then `PUT` each file to `/v1/datasets/{id}/files/images/...` (and the COLMAP model to
   `sparse/0/...`), or one ZIP file to `/archive`; `GET .../files` says what has arrived.
2. `POST /v1/datasets/{id}/commit` checks it; where that takes long, the answer is 202, and its `Location`
   says how it goes.
3. `POST /v1/jobs`, then poll its `Location` or listen to `/events`.
4. `GET /v1/jobs/{id}/artifacts`.

Errors are problem documents (RFC 9457).
"""


def create_app(settings: ServiceSettings | None = None) -> FastAPI:
    """Create the application.

    Args:
        settings: by default those of the environment.

    Raises:
        ConfigError: the settings do not fit together.
    """
    settings = settings or ServiceSettings()
    settings.checked()
    # Before the routes, whose document lists every kind of job.
    for module in settings.kind_modules:
        importlib.import_module(module)

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        try:
            async with _service_lifespan(settings) as service:
                app.state.service = service
                yield
                service.is_draining = True
        except OctasplatError as error:
            app.state.failure = error  # for whoever started it, as the server knows a traceback only
            raise

    app = FastAPI(
        title="octasplat",
        version=__version__,
        summary="A reconstruction service",
        description=DESCRIPTION,
        lifespan=lifespan,
        generate_unique_id_function=operation_id,
        openapi_url=None,  # made in a thread, see extend_openapi
        docs_url=None,  # the pages have their own, which needs nothing from elsewhere
        redoc_url=None,
        webhooks=webhook_messages.router,
        servers=[{"url": "/", "description": "The service that gave this document."}],
        license_info={"name": "Apache-2.0", "identifier": "Apache-2.0"},
    )
    for module_router in (
        datasets.router, dataset_tasks.router, resumable_uploads.router, scene_previews.router,
        jobs.router, estimates.router,
        events_and_logs.router, artifacts.router, webhooks.router, tokens.router, system.router,
        system.health_router, metrics.router, audit.router,
    ):  # fmt: skip
        app.include_router(module_router, dependencies=[Depends(refuse_unknown_parameters)])
    mount_pages(app)
    add_problem_handlers(app)
    extend_openapi(app)
    # From the inside out: what is added last sees a request first.
    app.add_middleware(AuditMiddleware)
    app.add_middleware(JsonBoundsMiddleware, more_values={scene_previews.PREFIX: scene_previews.MAX_VALUES})
    app.add_middleware(
        BodyLimitMiddleware,
        max_body_bytes=settings.max_body_bytes,
        longer={scene_previews.PREFIX: scene_previews.MAX_BODY_BYTES},
    )
    app.add_middleware(SameOriginMiddleware)
    # One that others can reach has names that nobody has listed.
    if settings.is_private:
        app.add_middleware(AllowedHostsMiddleware, names=settings.allowed_hosts)
    app.add_middleware(MessageFramingMiddleware)
    app.add_middleware(SecurityHeadersMiddleware)
    app.add_middleware(CompressionMiddleware)
    if settings.proxies:
        app.add_middleware(ProxyHeadersMiddleware, proxies=settings.proxies, style=settings.proxy_headers)
    app.add_middleware(RequestIdMiddleware)
    return app


@asynccontextmanager
async def _service_lifespan(settings: ServiceSettings) -> AsyncIterator[Service]:
    """Open the database, storage and event listener for the lifespan of the application."""
    conninfo = settings.conninfo()
    # The front end brings the tables up to date, for which workers wait.
    await asyncio.to_thread(migrate, conninfo)
    storage = await asyncio.to_thread(
        lambda: open_storage(settings.storage_address, floor_bytes=settings.floor_bytes)
    )
    free = await asyncio.to_thread(storage.free_bytes)
    if free is not None and free <= 0:
        logger.warning(
            "the store takes no uploads, as less room is left than OCTASPLAT_FLOOR_BYTES keeps free"
        )
    async with open_pool(conninfo, max_size=settings.pool_size, wait_seconds=10) as pool:
        async with pool.connection() as connection:
            if settings.token is not None:
                token = await add_environment_token(connection, settings.token.get_secret_value())
                if token.revoked_at is not None:
                    logger.warning("the token of OCTASPLAT_TOKEN was revoked and stays so; set another one")
            if not await has_any_token(connection):
                raise ConfigError(
                    f"The front end takes requests with a token only, and there is none: set {PREFIX}TOKEN, "
                    "or make one with octasplat token create."
                )
        event_broker = EventBroker(conninfo, listen=settings.listen)
        listening = asyncio.create_task(event_broker.run())
        evictor = SpaceEvictor(pool, storage)
        try:
            login_throttle = LoginThrottle(settings.wrong_token_seconds)
            service = Service(
                settings=settings,
                pool=pool,
                job_queue=ProcrastinateQueue(),
                storage=storage,
                event_broker=event_broker,
                evictor=evictor,
                login_throttle=login_throttle,
                spool_space=settings.spool(),
            )
            tasks = TaskRunner(service)
            running = asyncio.create_task(tasks.run())
            try:
                yield service
            finally:
                await cancel_and_wait([running])
                await tasks.close()
        finally:
            await evictor.close()
            event_broker.close()
            await cancel_and_wait([listening])

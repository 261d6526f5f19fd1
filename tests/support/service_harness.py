"""A service within the test's own process, and short ways to its tables."""

import asyncio
import os
import uuid
from collections.abc import AsyncIterator
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from pathlib import Path
from typing import Any, Protocol

import httpx
from fastapi import routing
from pydantic import SecretStr

from octasplat.service.app import create_app
from octasplat.service.settings import ServiceSettings
from octasplat.service.state import Service
from octasplat.workers.db.connections import open_pool
from octasplat.workers.db.tokens import LOCAL_OWNER, add_token, new_secret
from octasplat.workers.queue.attempts import Attempt
from octasplat.workers.queue.claims import claim
from octasplat.workers.storage.trees import Manifest

TOKEN = new_secret()
"""What the clients of these services send unless a test says otherwise."""
BEARER = {"Authorization": f"Bearer {TOKEN}"}


def share_routes() -> None:
    """Let FastAPI work through each route once, and not once for each application: 0.1 s of most tests.

    All of them include the same routers in the same way.
    """
    make = routing._EffectiveRouteContext.from_api_route
    made: dict[int, Any] = {}

    def make_once(*, original_route: routing.APIRoute, include_context: Any) -> Any:
        if id(original_route) not in made:
            made[id(original_route)] = make(original_route=original_route, include_context=include_context)
        return made[id(original_route)]

    routing._EffectiveRouteContext.from_api_route = make_once  # type: ignore[assignment, method-assign]


share_routes()


async def add_local_token(conninfo: str) -> None:
    """Add the token of the machine's own user, an administrator."""
    async with (
        open_pool(conninfo, max_size=1) as pool,
        pool.connection() as connection,
    ):
        await add_token(connection, TOKEN, owner=LOCAL_OWNER, name="tests", scopes=["admin"])


@asynccontextmanager
async def running_service(
    conninfo: str, folder: Path, *, signed_in: bool = True, has_token: bool = True, **settings: Any
) -> AsyncIterator[tuple[httpx.AsyncClient, Service]]:
    """A client of a service, and the service.

    The client sends the token of the machine's own user unless ``signed_in`` is False, and ``has_token`` is
    whether there is one.
    """
    if has_token:
        await add_local_token(conninfo)
    given = {
        "data": folder,
        "storage": str(folder / "store"),
        "floor_bytes": 0,
        "database_url": SecretStr(conninfo),
        "kind_modules": ("tests.support.toy_kind",),
        "wrong_token_seconds": 0.0,
        **settings,
    }
    app = create_app(ServiceSettings(**given))
    async with app.router.lifespan_context(app):
        transport = httpx.ASGITransport(app=app)
        async with httpx.AsyncClient(
            transport=transport,
            base_url="http://localhost:8642",
            headers=BEARER if signed_in else None,
        ) as http:
            yield http, app.state.service


class ConnectService(Protocol):
    """Starts a service on the database and folder of a test, with settings of its own."""

    def __call__(self, **settings: Any) -> AbstractAsyncContextManager[tuple[httpx.AsyncClient, Service]]: ...


async def committed_dataset(service: Service, owner: str = "local", *, has_poses: bool = True) -> str:
    """A dataset as if its files had come and been checked."""
    dataset_id = uuid.uuid4()
    async with service.pool.connection() as connection:
        await connection.execute(
            "INSERT INTO datasets (id, owner, name, state, has_poses, photographs) "
            "VALUES (%s, %s, 'made', 'committed', %s, 8)",
            [dataset_id, owner, has_poses],
        )
    return str(dataset_id)


async def new_job(http: httpx.AsyncClient, service: Service, **body: Any) -> dict[str, Any]:
    """A job of the toy kind, queued over HTTP."""
    given = {"kind": "toy", "dataset_id": await committed_dataset(service), **body}
    answer = await http.post("/v1/jobs", json=given)
    assert answer.status_code == 202, answer.text
    job: dict[str, Any] = answer.json()
    return job


def api_environment(conninfo: str, folder: Path) -> dict[str, str]:
    """The environment of a front end in a process of its own, on a free port."""
    return {
        **os.environ,
        "DATABASE_URL": conninfo,
        "OCTASPLAT_DATA": str(folder),
        "OCTASPLAT_FLOOR_BYTES": "0",
        "OCTASPLAT_PORT": "0",
        "OCTASPLAT_TOKEN": TOKEN,
    }


async def task_over(http: httpx.AsyncClient, answer: httpx.Response, seconds: float = 60.0) -> dict[str, Any]:
    """The task that an answer of 202 names, when it is over."""
    assert answer.status_code == 202, answer.text
    async with asyncio.timeout(seconds):
        while True:
            task: dict[str, Any] = (await http.get(answer.headers["Location"])).json()
            if task["state"] in ("succeeded", "failed"):
                return task
            await asyncio.sleep(0.02)


async def claim_job(service: Service, job: dict[str, Any]) -> Attempt:
    """The job as a worker has it."""
    async with service.pool.connection() as connection:
        cursor = await connection.execute("SELECT slip FROM jobs WHERE id = %s", [job["id"]])
        row = await cursor.fetchone()
    assert row is not None
    attempt = await claim(service.pool, uuid.UUID(job["id"]), row["slip"], "w")
    assert attempt is not None
    return attempt


async def client_with_token(service: Service, owner: str, *scopes: str) -> dict[str, str]:
    """Headers with a fresh token."""
    secret = new_secret()
    async with service.pool.connection() as connection:
        await add_token(connection, secret, owner=owner, name=owner, scopes=scopes)
    return {"Authorization": f"Bearer {secret}"}


def store_content(service: Service, content: bytes) -> str:
    """Put content into the store; returns its digest."""
    with service.storage.open_writer() as writer:
        writer.write(content)
        return writer.commit().sha256


__all__ = [
    "BEARER",
    "TOKEN",
    "ConnectService",
    "Manifest",
    "claim_job",
    "client_with_token",
    "committed_dataset",
    "running_service",
    "store_content",
    "task_over",
]

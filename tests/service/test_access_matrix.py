"""Every route x no token, a stranger's token, a read-only token. New routes are found by themselves."""

import io
import re
import uuid
from collections.abc import AsyncIterator
from typing import Any

import httpx
import pytest
from PIL import Image

from octasplat.service.app import create_app
from octasplat.service.settings import ServiceSettings
from octasplat.service.state import Service
from octasplat.workers.db.live_scenes import LiveScene, put_live_scene
from octasplat.workers.queue.job_results import ResultFile
from tests.support.api_inventory import Operation, operations, undescribed
from tests.support.service_harness import (
    ConnectService,
    claim_job,
    client_with_token,
    committed_dataset,
    store_content,
)

OPEN = {"/healthz", "/readyz"}
"""Whoever watches over the service needs no token for these."""
ADMIN = {
    "POST /v1/tokens",
    "GET /v1/audit",
    "GET /metrics",
    "PATCH /v1/queues/{queue}",
    "PATCH /v1/workers/{worker}",
}
"""These need an administrator's token; a route that belongs here and is missing fails the test."""
HARMLESS = {"POST /v1/estimates"}
"""These change nothing though they are no GET."""
OPEN_PAGES = {"/sign-in", "/sign-in/once", "/sign-out", "/openapi.json", "/docs", "/docs/oauth2-redirect"}
OPEN_PAGES.add("/{path}")  # what is shown at addresses that nothing else has

APP = create_app(ServiceSettings())


class Stage:
    """A service in which "me" has one of everything, and those who ask for it."""

    def __init__(self, http: httpx.AsyncClient, service: Service) -> None:
        self.http = http
        self.service = service
        self.headers: dict[str, dict[str, str]] = {}
        self.ids: dict[str, str] = {}
        self.job: dict[str, Any] = {}

    async def set(self) -> None:
        for who, owner, scope in (
            ("owner", "me", "write"),
            ("reader", "me", "read"),
            ("stranger", "stranger", "write"),
            ("admin", "boss", "admin"),
        ):
            self.headers[who] = await client_with_token(self.service, owner, scope)
        picture = io.BytesIO()
        Image.new("RGB", (8, 8), "red").save(picture, "PNG")
        open_dataset = await self._make("/v1/datasets", {"name": "of-me"})
        address = f"/v1/datasets/{open_dataset}/files/images/a.png"
        put = await self.http.put(address, content=picture.getvalue(), headers=self.headers["owner"])
        assert put.status_code == 201, put.text
        dataset = await committed_dataset(self.service, "me")
        job_id = await self._make("/v1/jobs", {"kind": "toy", "dataset_id": dataset})
        attempt = await claim_job(self.service, {"id": job_id})
        sha256 = store_content(self.service, picture.getvalue())
        await attempt.add_log_lines(["a line of-me"])
        await attempt.record_preview({"sha256": sha256, "step": 1, "view": "a.png"})
        size = len(picture.getvalue())
        state = LiveScene(uuid.UUID(job_id), sha256, sha256, 1, 1)
        await attempt.succeed([ResultFile("scene.ply", sha256, size, "application/octet-stream")])
        async with self.service.pool.connection() as connection:
            await put_live_scene(connection, state)
        self.ids = {
            "dataset_id": open_dataset, "job_id": job_id, "path": "images/a.png", "name": "scene.ply",
            "kind": "toy", "queue": "cpu", "worker": "box", "start_bytes": "0",
        }  # fmt: skip
        hook = await self._make("/v1/webhooks", {"url": "https://example.org/hook"})
        tried = await self.http.post(f"/v1/webhooks/{hook}/test", headers=self.headers["owner"])
        assert tried.is_success, tried.text
        listed = await self.http.get(f"/v1/webhooks/{hook}/deliveries", headers=self.headers["owner"])
        self.ids |= {"webhook_id": hook, "delivery_id": listed.json()["deliveries"][0]["id"]}
        await self.http.post(f"/v1/datasets/{open_dataset}/commit", headers=self.headers["owner"])  # refused
        tasks = await self.http.get(f"/v1/datasets/{open_dataset}/tasks", headers=self.headers["owner"])
        self.ids["task_id"] = tasks.json()["tasks"][0]["id"]
        upload = await self.http.post(
            f"/v1/datasets/{open_dataset}/uploads", headers={**self.headers["owner"], "Upload-Length": "5"}
        )
        self.ids["upload_id"] = upload.json()["id"]
        self.mine = {"of-me", upload.json()["id"], open_dataset, dataset, job_id, hook, self.ids["task_id"]}
        self.job = {"kind": "toy", "dataset_id": dataset}

    async def address(self, path: str) -> str:
        """The path with something of mine in it, which is made by POST to the list that it is in."""
        for found in re.finditer(r"\{(\w+)\}", path):
            name = found[1]
            if name not in self.ids:
                collection = path[: found.start()].rstrip("/")
                makers = [o for o in operations(APP) if (o.method, o.path) == ("POST", collection)]
                assert makers, f"Stage.set must make something for {{{name}}} of {path}"
                who = "admin" if f"POST {collection}" in ADMIN else "owner"
                body = {**makers[0].body()["json"], **self._fitting(collection)}
                self.ids[name] = await self._make(await self.address(collection), body, who)
        return re.sub(r"\{(\w+)\}", lambda found: self.ids[found[1]], path)

    def body(self, operation: Operation) -> dict[str, Any]:
        """A request that would work."""
        body = operation.body()
        if "json" in body:
            body["json"] = {**(body["json"] or {}), **self._fitting(operation.path)}
        return body

    async def everything(self) -> dict[str, Any]:
        """All that the owner can see, to be compared."""
        seen = {}
        for operation in operations(APP):
            if operation.method == "GET" and not _is_about_now(operation):
                address = await self.address(operation.path)
                who = "admin" if operation.name in ADMIN else "owner"
                answer = await self.http.get(address, headers=self.headers[who])
                assert answer.status_code < 300, f"{operation.name}: {answer.text}"
                seen[operation.name] = answer.text
        return seen

    async def _make(self, address: str, body: dict[str, Any], who: str = "owner") -> str:
        answer = await self.http.post(address, json=body, headers=self.headers[who])
        assert answer.is_success, f"{address}: {answer.text}"
        return str(answer.json()["id"])

    def _fitting(self, path: str) -> dict[str, Any]:
        return {"/v1/jobs": self.job, "/v1/tokens": {"owner": "me"}}.get(path, {})


def _without_id(answer: httpx.Response) -> dict[str, Any]:
    """The problem document without the id of its request."""
    return {name: value for name, value in answer.json().items() if name != "request_id"}


def _is_about_now(operation: Operation) -> bool:
    """Whether the answer changes by itself."""
    return operation.path in {*OPEN, "/metrics", "/v1/queues", "/v1/tokens", "/v1/audit"}


@pytest.fixture
async def stage(connect_service: ConnectService) -> AsyncIterator[Stage]:
    async with connect_service(signed_in=False) as (http, service):
        stage = Stage(http, service)
        await stage.set()
        yield stage


async def test_request_without_token_is_refused_on_every_route(stage: Stage) -> None:
    before = await stage.everything()
    for operation in operations(APP):
        address, body = await stage.address(operation.path), stage.body(operation)
        if operation.path in OPEN:
            assert (await stage.http.request(operation.method, address)).status_code == 200
            continue
        wrong: tuple[dict[str, str], ...] = (
            {},
            {"Authorization": "Bearer octa_x"},
            {"Authorization": "Bearer "},
            {"Authorization": "Basic eDp5"},
            {"Cookie": "octasplat_session=octa_x"},
        )
        for headers in wrong:
            answer = await stage.http.request(operation.method, address, headers=headers, **body)
            assert answer.status_code == 401, f"{operation.name} {headers}: {answer.text}"
            assert answer.headers["WWW-Authenticate"].startswith("Bearer"), operation.name
            assert answer.headers["content-type"] == "application/problem+json", operation.name
    assert await stage.everything() == before


async def test_other_owner_cannot_read_or_change(stage: Stage) -> None:
    before = await stage.everything()
    for operation in operations(APP):
        address, body = await stage.address(operation.path), stage.body(operation)
        headers = stage.headers["stranger"] | operation.needed_headers()
        answer = await stage.http.request(operation.method, address, headers=headers, **body)
        what = f"{operation.name}: {answer.status_code} {answer.text}"
        if operation.name in ADMIN:
            assert answer.status_code == 403, what
        elif re.search(r"\{\w+_id\}", operation.path):
            assert answer.status_code == 404, what
            unknown = re.sub(r"[0-9a-f]{8}-[0-9a-f-]{27}", str(uuid.uuid4()), address)
            other = await stage.http.request(operation.method, unknown, headers=headers, **body)
            assert _without_id(other) == _without_id(answer), f"{what} differs from {other.text}"
        elif not operation.changes:
            assert answer.status_code == 200, what
        assert not any(each in answer.text for each in stage.mine), what
    assert await stage.everything() == before


async def test_read_scope_cannot_change(stage: Stage) -> None:
    before = await stage.everything()
    for operation in operations(APP):
        address, body = await stage.address(operation.path), stage.body(operation)
        headers = stage.headers["reader"] | operation.needed_headers()
        answer = await stage.http.request(operation.method, address, headers=headers, **body)
        what = f"{operation.name}: {answer.status_code} {answer.text}"
        if (operation.changes and operation.name not in HARMLESS) or operation.name in ADMIN:
            assert answer.status_code == 403, what
            assert answer.json()["type"].endswith(":scope"), what
        else:
            assert answer.status_code == 200, what
    assert await stage.everything() == before


async def test_undocumented_routes_require_token(stage: Stage) -> None:
    routes = undescribed(APP)
    assert ("GET", "/jobs/{job_id}") in routes and ("HEAD", "/v1/jobs/{job_id}/artifacts/{name}") in routes

    before = await stage.everything()
    for method, path in routes:
        if path in OPEN_PAGES:
            continue
        address = await stage.address(path)
        nobody = await stage.http.request(method, address)
        what = f"{method} {path}"
        assert nobody.status_code in (303, 401), f"{what}: {nobody.status_code}"
        if nobody.status_code == 303:
            assert nobody.headers["Location"].startswith("/sign-in"), what
        headers = {**stage.headers["stranger"], "Origin": "http://localhost:8642"}
        other = await stage.http.request(method, address, headers=headers)
        if "_id}" in path:
            assert other.status_code == 404, f"{what}: {other.status_code} {other.text}"
        assert not any(each in other.text for each in stage.mine), what
        headers = {**stage.headers["reader"], "Origin": "http://localhost:8642"}
        reader = await stage.http.request(method, address, headers=headers)
        if method not in ("GET", "HEAD"):
            assert reader.status_code == 403, f"{what}: {reader.status_code} {reader.text}"
    assert await stage.everything() == before

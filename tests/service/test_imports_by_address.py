"""Scenes that the service fetches from an address, and addresses that it must not ask."""

import contextlib
import hashlib
import time
from collections.abc import Iterator
from typing import Any

import pytest

from tests.support.http_server import QuietHandler, serve_http
from tests.support.model_builder import ColmapModelBuilder, photographs
from tests.support.service_harness import ConnectService, client_with_token, task_over
from tests.support.zip_builder import ZipMember, build_zip

SCENE = {**photographs(), **ColmapModelBuilder().files()}
ARCHIVE = build_zip(*(ZipMember(name, content) for name, content in SCENE.items()))
HERE = ("127.0.0.1",)


class Elsewhere(QuietHandler):
    def respond(self) -> None:
        kind = self.path.strip("/")
        if kind.startswith("to="):
            self.answer(b"", 302, Location=kind.removeprefix("to="))
            return
        if kind == "trickle":
            with contextlib.suppress(OSError):
                self.wfile.write(b"HTTP/1.1 200 OK\r\nX-Slow: ")
                while True:
                    self.wfile.write(b"x")
                    time.sleep(0.1)
        self.send_response(200 if kind in ("scene.zip", "a.png", "cut.zip") else 404)
        content = next(iter(photographs().values())) if kind == "a.png" else ARCHIVE
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content[: len(content) // 2] if kind == "cut.zip" else content)


@pytest.fixture
def elsewhere() -> Iterator[str]:
    with serve_http(Elsewhere) as address:
        yield address


async def test_scene_is_fetched_from_an_address(connect_service: ConnectService, elsewhere: str) -> None:
    async with connect_service(import_hosts=HERE) as (http, _service):

        async def fetch(**body: Any):  # type: ignore[no-untyped-def]
            made = (await http.post("/v1/datasets", json={"name": "a"})).json()
            address = f"/v1/datasets/{made['id']}"
            return address, await task_over(http, await http.post(f"{address}/import", json=body))

        sha256 = hashlib.sha256(ARCHIVE).hexdigest()
        address, task = await fetch(url=f"{elsewhere}/to={elsewhere}/scene.zip", sha256=sha256)
        assert task["state"] == "succeeded", task
        assert task["result"] == {"files": len(SCENE), "left_out": [], "notes": []}
        listed = (await http.get(f"{address}/files")).json()["files"]
        assert {file["path"]: file["sha256"] for file in listed} == {
            name: hashlib.sha256(content).hexdigest() for name, content in SCENE.items()
        }
        address, task = await fetch(url=f"{elsewhere}/a.png", path="images/b.png")
        assert task["result"]["files"] == 1
        listed = (await http.get(f"{address}/files")).json()["files"]
        assert [file["path"] for file in listed] == ["images/b.png"]
        for url, kind, words in (
            (f"{elsewhere}/nothing.zip", "import", "answered 404"),
            (f"{elsewhere}/cut.zip", "import", "broke off"),
            (f"{elsewhere}/to=https://10.0.0.1/x.zip", "import-address", "reachable from everywhere"),
            (f"{elsewhere}/to=file:///etc/passwd", "import-address", "cannot be read"),
            (f"{elsewhere}/to=https://[/x.zip", "import", "cannot be reached"),
            ("http://127.0.0.1:1/x.zip", "import", "cannot be reached"),
        ):
            address, task = await fetch(url=url)
            problem = task["problem"]
            assert (task["state"], problem["status"]) == ("failed", 422), (url, task)
            assert problem["type"].endswith(f":{kind}") and words in problem["detail"], problem
            assert (await http.get(f"{address}/files")).json()["files"] == []
        _, task = await fetch(url=f"{elsewhere}/scene.zip", sha256="0" * 64)
        assert task["problem"]["type"].endswith(":digest-mismatch")
        stranger = await client_with_token(_service, "stranger", "write")
        body = {"url": f"{elsewhere}/scene.zip"}
        assert (await http.post(f"{address}/import", json=body, headers=stranger)).status_code == 404


@pytest.mark.parametrize(
    "url",
    [
        "http://127.0.0.1/x.zip", "https://127.0.0.1/x.zip", "https://169.254.169.254/latest", "https://[::1]/",
        "https://[64:ff9b::7f00:1]/", "https://2130706433/", "https://localhost/x", "https://example.org:22/",
        "https://user:word@example.org/x.zip", "ftp://example.org/x.zip",
    ],
)  # fmt: skip
async def test_inner_addresses_are_not_asked(connect_service: ConnectService, url: str) -> None:
    async with connect_service() as (http, _service):
        made = (await http.post("/v1/datasets", json={"name": "a"})).json()
        answer = await http.post(f"/v1/datasets/{made['id']}/import", json={"url": url})
        assert (answer.status_code, answer.json()["type"]) == (422, "urn:octasplat:problem:import-address")


async def test_headers_that_trickle_are_not_waited_for(
    connect_service: ConnectService, elsewhere: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("octasplat.service.actions.imports.HEADER_SECONDS", 0.5)
    async with connect_service(import_hosts=HERE) as (http, _service):
        made = (await http.post("/v1/datasets", json={"name": "a"})).json()
        body = {"url": f"{elsewhere}/trickle"}
        task = await task_over(http, await http.post(f"/v1/datasets/{made['id']}/import", json=body), 20)
        assert task["problem"]["type"] == "urn:octasplat:problem:import"


async def test_hosts_of_webhooks_are_no_hosts_of_imports(
    connect_service: ConnectService, elsewhere: str
) -> None:
    """A message goes to them, and nothing of theirs comes back."""
    async with connect_service(webhook_hosts=HERE) as (http, _service):
        made = (await http.post("/v1/datasets", json={"name": "a"})).json()
        body = {"url": f"{elsewhere}/scene.zip"}
        answer = await http.post(f"/v1/datasets/{made['id']}/import", json=body)
        assert (answer.status_code, answer.json()["type"]) == (422, "urn:octasplat:problem:import-address")


async def test_a_few_owners_with_slow_addresses_do_not_hold_all_imports(
    connect_service: ConnectService, elsewhere: str
) -> None:
    async with connect_service(import_hosts=HERE) as (http, service):
        for number in range(5):
            slow = await client_with_token(service, f"slow{number}", "write")
            for _ in range(6):
                made = (await http.post("/v1/datasets", json={"name": "a"}, headers=slow)).json()
                body = {"url": f"{elsewhere}/trickle"}
                await http.post(f"/v1/datasets/{made['id']}/import", json=body, headers=slow)
        made = (await http.post("/v1/datasets", json={"name": "a"})).json()
        answer = await http.post(f"/v1/datasets/{made['id']}/import", json={"url": f"{elsewhere}/scene.zip"})
        task = await task_over(http, answer, 20)
        assert task["state"] == "succeeded", task

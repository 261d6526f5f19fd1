"""Webhooks are never sent into inner networks, whatever their names are looked up to."""

import asyncio
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import httpx
import pytest
from standardwebhooks.webhooks import Webhook

from octasplat.workers.maintenance.webhooks import addresses
from octasplat.workers.maintenance.webhooks.addresses import AddressRefusedError, check_url
from octasplat.workers.maintenance.webhooks.guarded_transport import OWNER_EXTENSION, GuardedTransport
from octasplat.workers.maintenance.webhooks.sender import guarded_client
from tests.support.service_harness import (
    ConnectService,
    running_service,
)
from tests.support.webhook_calls import HERE, deliveries, make_webhook, send_due
from tests.support.webhook_receiver import receive_webhooks


@pytest.fixture
def connect_service(conninfo: str, tmp_path: Path) -> ConnectService:
    """A service that may send to this machine."""
    return partial(running_service, conninfo, tmp_path, webhook_hosts=HERE)


REFUSED_URLS = [
    "http://example.org/", "ftp://example.org/", "https://example.org:22/", "https://u:p@example.org/",
    "https://example.org/#x", "https://", "https://[::1", "https://exa mple.org/", "javascript:alert(1)",
    "https://localhost/", "https://printer.local/", "https://intranet/", "https://127.0.0.1/",
    "https://10.1.2.3/", "https://169.254.169.254/latest", "https://[::ffff:10.0.0.1]/",
    "https://[fd00::1]/", "https://100.64.0.1/", "https://example.org:99999/", "https://127.0.0.1./",
    "https://127.1:8443/", "https://0x7f.1/", "https://0x7f.1./", "https://2130706433/", "https://0177.0.0.1/",
    "https://127.0.0.0x1/", "https://127.0.0.1.../", "https://10.1/", "https://[::127.0.0.1]/",
    "https://[64:ff9b::10.0.0.1]/", "https://[2002:7f00:1::]/", "https://１２７.0.0.1/", "https://127。0。0。1/",
    "https://example.1/", "https://example.0x/", "https://[64:ff9b:1::7f00:1]/", "https://[::ffff:0:127.0.0.1]/",
    "https://[64:ff9b:1:2::8.8.8.8]/", "https://[2001:0:4136:e378:8000:63bf:80ff:fffe]/",
]  # fmt: skip


@pytest.mark.parametrize("url", REFUSED_URLS)
def test_webhook_internal_addresses_are_refused(url: str) -> None:
    with pytest.raises(AddressRefusedError):
        check_url(url)


def test_webhook_valid_addresses_are_accepted() -> None:
    for url in (
        "https://example.org/hook?x=1",
        "https://example.org:8443/",
        "https://93.184.216.34/",
        "https://[64:ff9b::8.8.8.8]/",
        "https://[::ffff:0:8.8.8.8]/",
    ):
        assert check_url(url) == url
    assert check_url("http://hooks.internal:9000/x", ("hooks.internal",))
    with pytest.raises(AddressRefusedError):
        check_url("http://other.internal:9000/x", ("hooks.internal",))


@pytest.mark.parametrize("allowed", [(), ("elsewhere.internal",)])
@pytest.mark.parametrize(
    "host",
    ["127.0.0.1", "[::1]", "[::ffff:127.0.0.1]", "2130706433", "0x7f000001", "localhost", "[64:ff9b::7f00:1]",
     "100.64.0.1", "169.254.169.254", "[fd00::1]", "224.0.0.1", "0.0.0.0", "127.1", "0x7f.1",
     "[::127.0.0.1]", "127。0。0。1", "[::ffff:0:127.0.0.1]", "[64:ff9b:1::7f00:1]"],
)  # fmt: skip
async def test_connections_into_inner_networks_are_not_made(host: str, allowed: tuple[str, ...]) -> None:
    """Not even to see whether there is somebody: what is asked is the same for a port that is open."""
    with listening() as (port, accepted):
        async with guarded_client(allowed) as client:
            with pytest.raises(AddressRefusedError):
                await client.post(f"http://{host}:{port}/hook", content=b"x")
        assert accepted() == 0


@contextmanager
def listening() -> Iterator[tuple[int, Callable[[], int]]]:
    """A port that is open, and how many connections it was asked for."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.setblocking(False)

        def accepted() -> int:
            count = 0
            with suppress(BlockingIOError):
                while True:
                    server.accept()[0].close()
                    count += 1
            return count

        yield server.getsockname()[1], accepted


class Names:
    """What names are looked up to, one answer after the other and then the last for good."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, **answers: list[str]) -> None:
        self.asked: list[str] = []
        self._answers = answers
        self._ask = socket.getaddrinfo
        monkeypatch.setattr(socket, "getaddrinfo", self._look_up)

    def _look_up(self, host: Any, *arguments: Any, **more: Any) -> Any:
        answers = self._answers.get(str(host).partition(".")[0])
        if answers is None:
            return self._ask(host, *arguments, **more)
        self.asked.append(host)
        found = answers.pop(0) if len(answers) > 1 else answers[0]
        return [entry for each in found.split() for entry in self._ask(each, *arguments, **more)]


@pytest.mark.parametrize("found", ["127.0.0.1", "93.184.216.34 127.0.0.1", "::ffff:127.0.0.1"])
async def test_webhook_name_resolving_to_internal_address_is_refused(
    connect_service: ConnectService, monkeypatch: pytest.MonkeyPatch, found: str
) -> None:
    async with connect_service() as (http, service):
        with listening() as (port, accepted):
            monkeypatch.setattr(addresses, "PORTS", (port,))
            names = Names(monkeypatch, hooks=[found])
            answer = await http.post("/v1/webhooks", json={"url": f"https://hooks.example.org:{port}/"})
            assert answer.status_code == 201 and names.asked == []
            await http.post(f"/v1/webhooks/{answer.json()['id']}/test")
            assert await send_due(service.pool, HERE) == 1
            (told,) = await deliveries(http, answer.json())
            assert told["state"] == "pending" and "network" in told["error"]
            assert names.asked == ["hooks.example.org"] and accepted() == 0


async def test_webhook_connects_to_checked_address(
    connect_service: ConnectService, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with connect_service(webhook_hosts=(*HERE, "hooks.inner.example")) as (http, service):
        with receive_webhooks() as receiver:
            # The second answer comes too late for anybody to use it; 127.0.0.2 does not answer at all.
            names = Names(monkeypatch, hooks=["127.0.0.2 127.0.0.1", "127.0.0.3"])
            hook = await make_webhook(http, receiver, url=f"http://hooks.inner.example:{receiver.port}/hook")
            await http.post(f"/v1/webhooks/{hook['id']}/test")
            await send_due(service.pool, (*HERE, "hooks.inner.example"))
            ((_, headers, body),) = receiver.received
            assert headers["host"] == f"hooks.inner.example:{receiver.port}"
            assert names.asked == ["hooks.inner.example"]
            assert Webhook(hook["secret"]).verify(body, headers)["type"] == "webhook.test"


async def test_webhook_name_is_judged_again_at_each_connection(monkeypatch: pytest.MonkeyPatch) -> None:
    """A name that was public when it was judged first and is an inner one afterwards (DNS rebinding)."""
    connected: list[str] = []

    def answer(request: httpx.Request) -> httpx.Response:
        connected.append(request.url.host)
        return httpx.Response(204)

    Names(monkeypatch, hooks=["93.184.216.34", "127.0.0.1"])
    transport = GuardedTransport((), httpx.MockTransport(answer))
    async with httpx.AsyncClient(transport=transport) as client:
        assert (await client.post("https://hooks.example.org/")).status_code == 204
        with pytest.raises(AddressRefusedError):
            await client.post("https://hooks.example.org/")
    assert connected == ["93.184.216.34"]


async def test_webhook_to_internal_name_is_refused_when_sending(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        with receive_webhooks() as receiver:
            hook = await make_webhook(http, receiver)
            await http.post(f"/v1/webhooks/{hook['id']}/test")
            await send_due(service.pool, ())  # this worker's settings allow no inner hosts
            assert receiver.received == []
            (told,) = await deliveries(http, hook)
            assert told["state"] == "pending" and "network" in told["error"] and told["status"] is None


async def test_webhook_slow_name_server_delays_owner_only(monkeypatch: pytest.MonkeyPatch) -> None:
    go_on = threading.Event()
    ask = socket.getaddrinfo

    def look_up(host: Any, *arguments: Any, **more: Any) -> Any:
        if str(host).startswith("slow"):
            go_on.wait(60)
        return ask("127.0.0.1", *arguments, **more)

    monkeypatch.setattr(socket, "getaddrinfo", look_up)

    async def ask_for(client: httpx.AsyncClient, owner: str, host: str) -> type[BaseException]:
        try:
            await client.post(f"https://{host}/", content=b"x", extensions={OWNER_EXTENSION: owner})
        except (httpx.ConnectError, AddressRefusedError) as error:
            return type(error)
        raise AssertionError

    async with guarded_client() as client:
        slow = [asyncio.create_task(ask_for(client, "me", f"slow{n}.example.org")) for n in range(5)]
        await asyncio.sleep(0.2)
        async with asyncio.timeout(20):
            assert await ask_for(client, "me", "slow9.example.org") is httpx.ConnectError
            assert await ask_for(client, "you", "fast.example.org") is AddressRefusedError
        go_on.set()
        assert set(await asyncio.gather(*slow)) == {AddressRefusedError}

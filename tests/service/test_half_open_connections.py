"""Connections that send nothing, or too slowly, keep nobody else out and fill no log."""

import asyncio
import contextlib
import http.client
import io
import resource
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import httpx
import numpy as np
import psutil
import pytest
from PIL import Image
from starlette.types import Receive, Scope, Send
from uvicorn.server import ServerState

from octasplat.service.connection_limits import ConnectionLimits
from octasplat.service.limited_protocol import ConnectionTable, LimitedConfig, LimitedProtocol
from octasplat.service.settings import ServiceSettings
from octasplat.workers.postgres.embedded import EmbeddedPostgres
from tests.support.postgres_fixtures import copied_database
from tests.support.service_harness import BEARER, api_environment

ROOT = Path(__file__).parents[2]
HEADER_SECONDS = ServiceSettings.model_fields["header_seconds"].default
OPEN_FILES = 256
"""Of the front end; a connection takes one."""


@dataclass(frozen=True)
class FrontEnd:
    """A front end in a process of its own."""

    address: tuple[str, int]
    log: Path
    pid: int

    def wait_until_dropped(self, connection: socket.socket) -> None:
        """Wait until it has closed its end of a connection of which nothing is read."""
        own, deadline = connection.getsockname(), time.monotonic() + 120
        for is_kept in (False, True):  # it has to be taken before
            while is_kept == any(
                other.raddr == own for other in psutil.Process(self.pid).net_connections("tcp")
            ):
                assert time.monotonic() < deadline, "the connection is not taken, or it is kept"
                time.sleep(0.2)

    def connect(self) -> socket.socket:
        return socket.create_connection(self.address, timeout=30)

    def healthz_seconds(self) -> float:
        began = time.monotonic()
        answer = httpx.get(f"http://{self.address[0]}:{self.address[1]}/healthz", timeout=30)
        assert answer.status_code == 200
        return time.monotonic() - began


StartFrontEnd = Callable[..., contextlib.AbstractContextManager[FrontEnd]]


@pytest.fixture(scope="module")
def start_front_end(
    postgres: EmbeddedPostgres, template: str, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[StartFrontEnd]:
    """A front end with few open files, and settings of the environment."""

    def limit_files() -> None:
        resource.setrlimit(resource.RLIMIT_NOFILE, (OPEN_FILES // 4, OPEN_FILES))

    @contextlib.contextmanager
    def start(**settings: str) -> Iterator[FrontEnd]:
        changes = {f"OCTASPLAT_{name}": value for name, value in settings.items()}
        folder = tmp_path_factory.mktemp("front_end")
        environment = {**api_environment(conninfo, folder), **changes}
        command = [sys.executable, "-m", "octasplat", "api"]
        log = folder / "api.log"
        with log.open("wb") as errors:
            process = subprocess.Popen(
                command,
                env=environment,
                cwd=ROOT,
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
                preexec_fn=limit_files,
            )
        try:
            assert process.stdout is not None
            with process.stdout as said:
                host, _, port = said.readline().strip().removeprefix("http://").rpartition(":")
            yield FrontEnd((host, int(port)), log, process.pid)
        finally:
            process.kill()
            process.wait(10)

    with copied_database(postgres, template) as conninfo:
        yield start


@pytest.fixture(scope="module")
def plain(start_front_end: StartFrontEnd) -> Iterator[FrontEnd]:
    with start_front_end() as front_end:
        yield front_end


@pytest.fixture(scope="module")
def impatient(start_front_end: StartFrontEnd) -> Iterator[FrontEnd]:
    """One that soon ends who sends no headers or reads no answers."""
    with start_front_end(HEADER_SECONDS="2", READER_SECONDS="2") as front_end:
        yield front_end


@pytest.fixture(scope="module")
def narrow(start_front_end: StartFrontEnd) -> Iterator[FrontEnd]:
    """One that takes three connections of an address."""
    with start_front_end(MAX_CONNECTIONS_PER_ADDRESS="3") as front_end:
        yield front_end


@pytest.mark.exhaustive
def test_half_open_connections_keep_nobody_out(plain: FrontEnd) -> None:
    with contextlib.ExitStack() as opened:
        for number in range(2 * OPEN_FILES):
            connection = opened.enter_context(plain.connect())
            if number % 2:
                connection.sendall(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n")
            if number % 100 == 0:
                assert plain.healthz_seconds() < HEADER_SECONDS / 2
        # Before the first of them are ended for having sent nothing.
        assert max(plain.healthz_seconds() for _ in range(5)) < HEADER_SECONDS / 2
        assert plain.log.stat().st_size < 20_000


def test_slow_headers_are_ended(impatient: FrontEnd) -> None:
    with impatient.connect() as connection:
        connection.sendall(b"GET /healthz HTTP/1.1\r\n")
        connection.settimeout(0.2)
        received, began = None, time.monotonic()
        while received is None and time.monotonic() < began + 30:
            connection.sendall(b"X")  # a header that never ends
            with contextlib.suppress(TimeoutError):
                received = connection.recv(1000)
        assert received is not None and received.startswith(b"HTTP/1.1 408 ")
        assert 1 < time.monotonic() - began < 15


LARGE = b"GET /openapi.json HTTP/1.1\r\nHost: localhost\r\nConnection: keep-alive\r\n\r\n"


def read_all(connection: socket.socket, count: int, pause_seconds: float) -> int:
    """The bytes of so many equal answers, of which 128 KiB are read at a time; fewer where it is closed."""
    received, expected = b"", 0
    with contextlib.suppress(ConnectionResetError):
        while not expected or len(received) < expected:
            piece = connection.recv(128 << 10)
            if not piece:
                break
            received += piece
            if not expected and b"\r\n\r\n" in received:
                head = received.partition(b"\r\n\r\n")[0]
                expected = count * (
                    len(head) + 4 + int(head.lower().split(b"content-length: ")[1].split()[0])
                )
            time.sleep(pause_seconds)
    return len(received) - expected


def test_clients_that_do_not_read_are_not_waited_for(impatient: FrontEnd) -> None:
    with impatient.connect() as connection:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 14)
        connection.sendall(LARGE * 60)
        impatient.wait_until_dropped(connection)
        assert read_all(connection, 60, 0.0) < 0
        assert impatient.healthz_seconds() < 20


def test_clients_that_do_not_read_are_not_waited_for_while_they_owe_a_body(impatient: FrontEnd) -> None:
    with contextlib.ExitStack() as opened:
        address = f"http://{impatient.address[0]}:{impatient.address[1]}"
        with httpx.Client(base_url=address, headers=BEARER, timeout=60) as http:
            dataset = http.post("/v1/datasets", json={"name": "d"}).headers["Location"]
            picture = io.BytesIO()
            noise = np.random.default_rng(0).integers(0, 256, (2400, 2400, 3), dtype=np.uint8)
            Image.fromarray(noise).save(picture, "PNG", compress_level=0)
            assert http.put(f"{dataset}/files/images/a.png", content=picture.getvalue()).status_code == 201
        connection = opened.enter_context(impatient.connect())
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 14)
        asked = LARGE.replace(b"/openapi.json", f"{dataset}/files/images/a.png".encode())
        asked = asked.replace(b"\r\n\r\n", f"\r\nAuthorization: {BEARER['Authorization']}\r\n".encode())
        connection.sendall(asked + b"Content-Length: 1\r\n\r\n")
        impatient.wait_until_dropped(connection)
        assert read_all(connection, 1, 0.0) < 0


async def test_closed_connection_goes_also_where_the_end_of_an_answer_is_not_read() -> None:
    made: list[LimitedProtocol] = []

    async def answer(_scope: Scope, _receive: Receive, send: Send) -> None:
        headers = [(b"connection", b"close"), (b"transfer-encoding", b"chunked")]
        await send({"type": "http.response.start", "status": 200, "headers": headers})
        while made[0].transport.get_write_buffer_size() == 0:  # what the system takes
            await send({"type": "http.response.body", "body": bytes(4096), "more_body": True})
        await send({"type": "http.response.body", "body": bytes(20_000)})

    limits = ConnectionLimits(10, 10, header_seconds=60.0, body_seconds=60.0, reader_seconds=0.3)
    config = LimitedConfig(answer, lifespan="off", log_config=None)
    config.load()
    config.connections = ConnectionTable(limits)

    def make() -> LimitedProtocol:
        made.append(LimitedProtocol(config, ServerState(), {}))
        return made[0]

    server = await asyncio.get_running_loop().create_server(make, "127.0.0.1", 0)
    with socket.create_connection(server.sockets[0].getsockname()) as connection:
        connection.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
        async with asyncio.timeout(30):
            while not (made and made[0].transport.is_closing()):
                await asyncio.sleep(0.02)
            assert made[0].transport.get_write_buffer_size() > 0 and not made[0].flow.write_paused
            while made[0].transport.get_write_buffer_size() > 0:
                config.connections.close_overdue()
                await asyncio.sleep(0.1)
    server.close()


def test_clients_that_read_slowly_get_everything(impatient: FrontEnd) -> None:
    with impatient.connect() as connection:
        connection.sendall(LARGE * 15)
        assert read_all(connection, 15, 0.25) == 0


def test_kept_connection_takes_further_requests(impatient: FrontEnd) -> None:
    connection = http.client.HTTPConnection(*impatient.address, timeout=30)
    connection.connect()
    kept = connection.sock
    for _ in range(2):
        connection.request("GET", "/healthz")
        answer = connection.getresponse()
        assert (answer.status, bool(answer.read())) == (200, True)
        assert connection.sock is kept
        time.sleep(4)
    connection.close()


def begin_body(connection: socket.socket) -> None:
    """Send the first byte of a body of ten, once the front end waits for it."""
    connection.sendall(
        b"POST /v1/estimates HTTP/1.1\r\nHost: localhost\r\nContent-Length: 10\r\n"
        b"Expect: 100-continue\r\n\r\n"
    )
    assert connection.recv(1000) == b"HTTP/1.1 100 Continue\r\n\r\n"
    connection.sendall(b"{")


def test_connections_in_use_are_not_ended_for_new_ones(narrow: FrontEnd) -> None:
    with contextlib.ExitStack() as opened:
        busy = [opened.enter_context(narrow.connect()) for _ in range(3)]
        for connection in busy:
            begin_body(connection)
        with narrow.connect() as refused:
            assert refused.recv(1000).startswith(b"HTTP/1.1 503 ")
        busy[0].sendall(b'"kind":1}')
        assert busy[0].recv(1000).startswith(b"HTTP/1.1 4")
        assert narrow.healthz_seconds() < 20


def test_invalid_requests_are_logged_once(plain: FrontEnd) -> None:
    for _ in range(50):
        with plain.connect() as connection:
            connection.sendall(b"no request\r\n\r\n")
            assert connection.recv(1000).startswith(b"HTTP/1.1 400 ")
    assert plain.log.read_text().count("Invalid HTTP request") == 1


def test_upgraded_connections_are_counted_no_longer_than_they_last(narrow: FrontEnd) -> None:
    upgrade = b"GET /healthz HTTP/1.1\r\nHost: localhost\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
    upgrade += b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: MDEyMzQ1Njc4OWFiY2RlZg==\r\n\r\n"
    for _ in range(5):
        with narrow.connect() as connection:
            connection.sendall(upgrade)
            assert connection.recv(1000).startswith(b"HTTP/1.1 200 ")
    assert narrow.healthz_seconds() < 20


def test_proxy_at_socket_of_both_protocols_may_have_all(start_front_end: StartFrontEnd) -> None:
    limits = {"HOST": "::", "PROXIES": "127.0.0.1", "MAX_CONNECTIONS_PER_ADDRESS": "3"}
    with start_front_end(**limits) as there, contextlib.ExitStack() as opened:
        proxied = FrontEnd(("127.0.0.1", there.address[1]), there.log, there.pid)
        for _ in range(3):
            begin_body(opened.enter_context(proxied.connect()))
        assert proxied.healthz_seconds() < 20

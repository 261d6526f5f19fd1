"""Connections that send nothing, or too slowly, keep nobody else out and fill no log."""

import contextlib
import http.client
import resource
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import httpx
import pytest

from tests.support.service_harness import api_environment

ROOT = Path(__file__).parents[2]
OPEN_FILES = 256
"""Of the front end; a connection takes one."""


@dataclass(frozen=True)
class FrontEnd:
    """A front end in a process of its own."""

    address: tuple[str, int]
    log: Path

    def connect(self) -> socket.socket:
        return socket.create_connection(self.address, timeout=30)

    def healthz_seconds(self) -> float:
        began = time.monotonic()
        answer = httpx.get(f"http://{self.address[0]}:{self.address[1]}/healthz", timeout=30)
        assert answer.status_code == 200
        return time.monotonic() - began


StartFrontEnd = Callable[..., contextlib.AbstractContextManager[FrontEnd]]


@pytest.fixture
def start_front_end(conninfo: str, tmp_path: Path) -> StartFrontEnd:
    """A front end with few open files, and settings of the environment."""

    def limit_files() -> None:
        resource.setrlimit(resource.RLIMIT_NOFILE, (OPEN_FILES // 4, OPEN_FILES))

    @contextlib.contextmanager
    def start(**settings: str) -> Iterator[FrontEnd]:
        changes = {f"OCTASPLAT_{name}": value for name, value in settings.items()}
        environment = {**api_environment(conninfo, tmp_path), **changes}
        command = [sys.executable, "-m", "octasplat", "api"]
        log = tmp_path / "api.log"
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
            yield FrontEnd((host, int(port)), log)
        finally:
            process.kill()
            process.wait(10)

    return start


def test_half_open_connections_keep_nobody_out(start_front_end: StartFrontEnd) -> None:
    with start_front_end() as front_end, contextlib.ExitStack() as opened:
        for number in range(2 * OPEN_FILES):
            connection = opened.enter_context(front_end.connect())
            if number % 2:
                connection.sendall(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n")
            if number % 100 == 0:
                assert front_end.healthz_seconds() < 1
        assert max(front_end.healthz_seconds() for _ in range(5)) < 1
        assert front_end.log.stat().st_size < 20_000


def test_slow_headers_are_ended(start_front_end: StartFrontEnd) -> None:
    with start_front_end(HEADER_SECONDS="2") as front_end, front_end.connect() as connection:
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


def test_clients_that_do_not_read_are_not_waited_for(start_front_end: StartFrontEnd) -> None:
    with start_front_end(READER_SECONDS="2") as front_end, front_end.connect() as connection:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 14)
        connection.sendall(LARGE * 60)
        time.sleep(12)
        assert read_all(connection, 60, 0.0) < 0
        assert front_end.healthz_seconds() < 5


def test_clients_that_read_slowly_get_everything(start_front_end: StartFrontEnd) -> None:
    with start_front_end(READER_SECONDS="2") as front_end, front_end.connect() as connection:
        connection.sendall(LARGE * 15)
        assert read_all(connection, 15, 0.25) == 0


def test_kept_connection_takes_further_requests(start_front_end: StartFrontEnd) -> None:
    with start_front_end(HEADER_SECONDS="1") as front_end:
        connection = http.client.HTTPConnection(*front_end.address, timeout=30)
        connection.connect()
        kept = connection.sock
        for _ in range(2):
            connection.request("GET", "/healthz")
            answer = connection.getresponse()
            assert (answer.status, bool(answer.read())) == (200, True)
            assert connection.sock is kept
            time.sleep(3)
        connection.close()


def test_connections_in_use_are_not_ended_for_new_ones(start_front_end: StartFrontEnd) -> None:
    limits = {"MAX_CONNECTIONS_PER_ADDRESS": "3"}
    with start_front_end(**limits) as front_end, contextlib.ExitStack() as opened:
        busy = [opened.enter_context(front_end.connect()) for _ in range(3)]
        for connection in busy:
            connection.sendall(
                b"POST /v1/estimates HTTP/1.1\r\nHost: localhost\r\nContent-Length: 10\r\n\r\n{"
            )
        time.sleep(1)
        with front_end.connect() as refused:
            assert refused.recv(1000).startswith(b"HTTP/1.1 503 ")
        busy[0].sendall(b'"kind":1}')
        assert busy[0].recv(1000).startswith(b"HTTP/1.1 4")
        assert front_end.healthz_seconds() < 1


def test_invalid_requests_are_logged_once(start_front_end: StartFrontEnd) -> None:
    with start_front_end() as front_end:
        for _ in range(50):
            with front_end.connect() as connection:
                connection.sendall(b"no request\r\n\r\n")
                assert connection.recv(1000).startswith(b"HTTP/1.1 400 ")
        assert front_end.log.read_text().count("Invalid HTTP request") == 1


def test_upgraded_connections_are_counted_no_longer_than_they_last(start_front_end: StartFrontEnd) -> None:
    upgrade = b"GET /healthz HTTP/1.1\r\nHost: localhost\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
    upgrade += b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: MDEyMzQ1Njc4OWFiY2RlZg==\r\n\r\n"
    with start_front_end(MAX_CONNECTIONS_PER_ADDRESS="3") as front_end:
        for _ in range(5):
            with front_end.connect() as connection:
                connection.sendall(upgrade)
                assert connection.recv(1000).startswith(b"HTTP/1.1 200 ")
        assert front_end.healthz_seconds() < 5


def test_proxy_at_socket_of_both_protocols_may_have_all(start_front_end: StartFrontEnd) -> None:
    limits = {"HOST": "::", "PROXIES": "127.0.0.1", "MAX_CONNECTIONS_PER_ADDRESS": "3"}
    with start_front_end(**limits) as there, contextlib.ExitStack() as opened:
        proxied = FrontEnd(("127.0.0.1", there.address[1]), there.log)
        for _ in range(3):
            opened.enter_context(proxied.connect()).sendall(
                b"POST /v1/estimates HTTP/1.1\r\nHost: localhost\r\nContent-Length: 10\r\n\r\n{"
            )
        time.sleep(1)
        assert proxied.healthz_seconds() < 5

"""Requests whose length is given in two ways are refused, and nothing behind them is read."""

import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from tests.support.daily import some_daily
from tests.support.service_harness import api_environment

HIDDEN = b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n"
BOTH = (
    b"POST /v1/datasets HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
    b"%b\r\nContent-Length: 6\r\n\r\n0\r\n\r\n"
)


@contextmanager
def front_end(conninfo: str, folder: Path) -> Iterator[tuple[str, int]]:
    """A front end in a process of its own, with the server that the service has."""
    command = [sys.executable, "-m", "octasplat", "api"]
    with subprocess.Popen(
        command, env=api_environment(conninfo, folder), stdout=subprocess.PIPE, text=True
    ) as process:
        try:
            assert process.stdout is not None
            address = urlsplit(process.stdout.readline().strip())
            assert address.hostname is not None and address.port is not None
            yield address.hostname, address.port
        finally:
            process.terminate()
            process.wait(60)


CODINGS = [b"Transfer-Encoding: chunked", b"transfer-encoding: Chunked"]


def answers(address: tuple[str, int], sent: bytes) -> bytes:
    """Everything that comes back until the service closes the connection."""
    with socket.create_connection(address, timeout=30) as connection:
        connection.sendall(sent)
        got = b""
        while part := connection.recv(65536):
            got += part
        return got


@pytest.mark.parametrize("coding", some_daily(CODINGS, CODINGS[1:]))
def test_request_with_two_lengths_is_refused_and_connection_closed(
    conninfo: str, tmp_path: Path, coding: bytes
) -> None:
    with front_end(conninfo, tmp_path) as address:
        got = answers(address, BOTH % coding + HIDDEN)
        assert got.count(b"HTTP/1.1 ") == 1 and got.startswith(b"HTTP/1.1 400 ")
        assert b"connection: close" in got.lower() and b"urn:octasplat:problem:framing" in got
        kept = answers(address, HIDDEN + HIDDEN.replace(b"Host", b"Connection: close\r\nHost"))
        assert kept.count(b"HTTP/1.1 200 ") == 2  # what is sound still shares a connection

"""A front end that freezes while somebody sends it a file keeps nobody else waiting."""

import asyncio
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from octasplat.workers.maintenance import garbage_collection
from octasplat.workers.queue import storage_leases
from tests.support.service_harness import BEARER, api_environment, running_service

ROOT = Path(__file__).parents[2]
PATIENCE_SECONDS = 60.0


@pytest.mark.exhaustive
async def test_vanished_front_end_lease_expires(
    conninfo: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What it stored counts as about to be named for a while only; at most a minute as set."""
    assert storage_leases.LEASE_SECONDS <= 60
    monkeypatch.setattr(storage_leases, "LEASE_SECONDS", 1.0)
    for name in ("_MIN_AGE_SECONDS", "MAX_CLOCK_SKEW_SECONDS"):
        monkeypatch.setattr(garbage_collection, name, 0.0)
    environment = api_environment(conninfo, tmp_path)
    command = [sys.executable, "-m", "octasplat", "api"]
    process = subprocess.Popen(command, env=environment, cwd=ROOT, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        with process.stdout as said:
            host, _, port = said.readline().strip().removeprefix("http://").rpartition(":")

        async with running_service(conninfo, tmp_path) as (http, service):
            dataset = (await http.post("/v1/datasets", json={"name": "d"})).headers["Location"]
            with socket.create_connection((host, int(port))) as connection:
                connection.sendall(
                    f"PUT {dataset}/files/images/a.png HTTP/1.1\r\nHost: localhost\r\n"
                    f"Authorization: {BEARER['Authorization']}\r\nContent-Length: 1000\r\n\r\nhalf".encode()
                )
                deadline = time.monotonic() + PATIENCE_SECONDS
                while await _note(service) is None:
                    assert time.monotonic() < deadline
                    await asyncio.sleep(0.02)
                process.send_signal(signal.SIGSTOP)
                with service.storage.open_writer() as writer:
                    writer.write(b"named by nobody")
                    writer.commit()
                assert (await http.delete(dataset)).status_code == 204
                while list(service.storage.list_blobs()) or await _note(service) is not None:
                    await garbage_collection.collect_garbage_now(
                        service.pool, service.storage, every_seconds=0.0
                    )
                    assert time.monotonic() < deadline
                    await asyncio.sleep(0.1)
                assert await _note(service) is None
    finally:
        process.kill()
        process.wait(10)


async def _note(service: object) -> object:
    async with service.pool.connection() as connection:  # type: ignore[attr-defined]
        return await storage_leases.oldest_lease(connection)

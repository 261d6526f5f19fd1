"""A service on a database and a store of its own, and headless Chromium to use it with."""

import os
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from octasplat.workers.postgres.embedded import EmbeddedPostgres
from tests.support.browser import chromium, run_in_browser
from tests.support.postgres_fixtures import copied_database, postgres, short_root, template
from tests.support.run_replay import RunReplay
from tests.support.service_harness import TOKEN, ConnectService, running_service
from tests.support.web_harness import ROOT, Browse, RunningService, StartService

__all__ = ["postgres", "short_root", "template"]

STEPS = Path(__file__).with_name("steps.mjs")


@pytest.fixture(scope="module")
def database(postgres: EmbeddedPostgres, template: str) -> Iterator[str]:
    """A database for the tests of one module."""
    with copied_database(postgres, template) as copied:
        yield copied


@pytest.fixture
def connect_service(database: str, tmp_path: Path) -> ConnectService:
    """A service in this process for as long as ``async with`` lasts, with a client of it."""
    return partial(running_service, database, tmp_path)


@pytest.fixture(scope="module")
def start_service(database: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[StartService]:
    """Starts a front end; settings as in its environment, without their prefix."""
    root = tmp_path_factory.mktemp("service")
    processes: list[subprocess.Popen[bytes]] = []

    def start(**settings: str) -> RunningService:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        given = {"DATA": str(root), "PORT": str(port), "FLOOR_BYTES": "0", "TOKEN": TOKEN, **settings}
        environment = {
            **os.environ,
            "DATABASE_URL": database,
            **{f"OCTASPLAT_{key}": value for key, value in given.items()},
        }
        process = subprocess.Popen([sys.executable, "-m", "octasplat", "api"], env=environment, cwd=ROOT)
        processes.append(process)
        url = f"http://127.0.0.1:{port}"
        deadline = time.monotonic() + 240
        while True:
            assert process.poll() is None and time.monotonic() < deadline
            try:
                urllib.request.urlopen(f"{url}/healthz", timeout=5).close()
                break
            except (urllib.error.URLError, OSError):
                time.sleep(0.1)
        store = root / "store"
        return RunningService(url, store, RunReplay(database, store))

    yield start
    for process in processes:
        process.terminate()
        process.wait(120)


@pytest.fixture(scope="module")
def service(start_service: StartService) -> RunningService:
    """A front end."""
    return start_service()


@pytest.fixture(scope="module")
def browse() -> Browse:
    """Runs the steps of a script in ``steps.mjs`` against a service; skips without Chromium or node.

    ``OCTASPLAT_SCREENSHOTS`` names a folder for pictures of the pages; without it none are taken.
    """
    chromium()  # skips

    def run(name: str, url: str, *, seconds: float = 400, **job: Any) -> dict[str, Any]:
        shots = os.environ.get("OCTASPLAT_SCREENSHOTS", "")
        if shots:
            Path(shots).mkdir(parents=True, exist_ok=True)
        given = {
            "steps": str(STEPS), "name": name, "url": url, "shots": shots, "seconds": seconds, "token": TOKEN,
            **job,
        }  # fmt: skip
        found = run_in_browser(given, seconds + 60)
        assert "error" not in found, found["error"]
        return found

    return run

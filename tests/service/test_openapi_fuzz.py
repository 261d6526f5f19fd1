"""Schemathesis asks at every address of the OpenAPI document, in ways that fit it and in ways that do not.

    OCTASPLAT_TEST_EXAMPLES=100 python -m pytest tests/service/test_openapi_fuzz.py -rP

asks 100 times of each kind for each operation, and goes on from what comes back (a dataset that was made is
filled, committed, and used for jobs).
"""

import json
import os
import subprocess
import sys
import uuid
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import psycopg
import pytest

from octasplat.workers.db.locks import OWNER
from octasplat.workers.storage.local import LocalStorage
from tests.support.service_harness import api_environment

pytestmark = pytest.mark.heavy

ROOT = Path(__file__).parents[2]
TOKEN = "octa_for-the-fuzzing-of-Every-route"
EXAMPLES = int(os.environ.get("OCTASPLAT_TEST_EXAMPLES", "6"))
"""Requests of each kind for each operation."""
MANY = 50
"""From here on links are followed, and none of many like requests is left out (``schemathesis_hooks``)."""
PHASES = "examples,coverage,fuzzing" + (",stateful" if EXAMPLES >= MANY else "")
COPIES = 50 * EXAMPLES
CHECKS = (
    "not_a_server_error", "status_code_conformance", "content_type_conformance",
    "response_headers_conformance", "response_schema_conformance", "unsupported_method", "ignored_auth",
)  # fmt: skip


@dataclass
class FrontEnd:
    """A front end in a process of its own."""

    process: "subprocess.Popen[str]"
    address: str
    log: Path


@pytest.fixture
def front_end(conninfo: str, tmp_path: Path) -> Iterator[FrontEnd]:
    environment = {
        **api_environment(conninfo, tmp_path),
        "OCTASPLAT_TOKEN": TOKEN,
        "OCTASPLAT_WRONG_TOKEN_SECONDS": "0",
        "OCTASPLAT_KIND_MODULES": '["tests.support.toy_kind"]',
        "PYTHONPATH": str(ROOT),
    }
    log = tmp_path / "service.log"
    with log.open("wb") as errors:
        process = subprocess.Popen(
            [sys.executable, "-m", "octasplat", "api"],
            env=environment, cwd=ROOT, stdout=subprocess.PIPE, stderr=errors, text=True,
        )  # fmt: skip
    assert process.stdout is not None
    address = process.stdout.readline().strip()
    assert address.startswith("http"), log.read_text()
    yield FrontEnd(process, address, log)
    process.terminate()
    process.wait(120)
    process.stdout.close()


def furnish(conninfo: str, tmp_path: Path) -> Path:
    """Datasets and finished jobs with results to ask for; returns the file for the hooks."""
    storage = LocalStorage(tmp_path / "store", floor_bytes=0)
    with storage.open_writer() as writer:
        writer.write(b"ply\n")
        sha256 = writer.commit().sha256
    storage.close()
    ids: dict[str, list[str]] = {"dataset_id": [], "job_id": []}
    with psycopg.connect(conninfo) as connection:
        connection.execute("SELECT pg_advisory_xact_lock(%s, hashtext('me'))", [OWNER])
        for number in range(COPIES):
            dataset, job = uuid.uuid4(), uuid.uuid4()
            connection.execute(
                "INSERT INTO datasets (id, owner, name, state) VALUES (%s, 'me', 'made', %s)",
                [dataset, "committed" if number % 3 == 0 else "open"],
            )
            connection.execute(
                "INSERT INTO dataset_files (dataset_id, path, sha256, size_bytes) VALUES (%s, %s, %s, 4)",
                [dataset, "images/a.png", sha256],
            )
            connection.execute(
                """
                INSERT INTO jobs (id, owner, kind, options, queue, state, dataset_id, finished_at)
                VALUES (%s, 'me', 'toy', '{}', 'cpu', %s, %s, now())
                """,
                [job, ("succeeded", "failed", "canceled")[number % 3], dataset],
            )
            connection.execute(
                "INSERT INTO artifacts (job_id, name, sha256, size_bytes, media_type) "
                "VALUES (%s, 'scene.ply', %s, 4, 'application/octet-stream')",
                [job, sha256],
            )
            ids["dataset_id"].append(str(dataset))
            ids["job_id"].append(str(job))
    kept = {name: some[:20] for name, some in ids.items()}
    used = {name: some[20:] for name, some in ids.items()}
    kept |= {"path": ["images/a.png"], "name": ["scene.ply"]}
    used |= {"path": ["images/a.png", "images/b.png", "sparse/0/images.bin"]}
    place = tmp_path / "ids.json"
    place.write_text(json.dumps({"kept": kept, "used": used}))
    return place


AST_IN_THREADS = "AST constructor recursion depth mismatch"
"""CPython 3.11 now and then says so where two threads parse; schemathesis does, and must begin again."""


@pytest.mark.exhaustive
def test_fuzzed_requests_cause_no_server_error(front_end: FrontEnd, conninfo: str, tmp_path: Path) -> None:
    environment = {
        **os.environ,
        "OCTASPLAT_TEST_IDS": str(furnish(conninfo, tmp_path)),
        "SCHEMATHESIS_HOOKS": "schemathesis_hooks",
        **({} if EXAMPLES >= MANY else {"OCTASPLAT_TEST_THINNED": "1"}),
        "PYTHONPATH": os.pathsep.join((str(Path(__file__).parent), str(ROOT))),
    }
    command = [
        sys.executable, "-m", "schemathesis.cli", "run", f"{front_end.address}/openapi.json",
        "--header", f"Authorization: Bearer {TOKEN}", "--phases", PHASES,
        "--max-examples", str(EXAMPLES), "--seed", "20261121", "--no-shrink", "--checks", ",".join(CHECKS),
        "--request-timeout", "60", "--wait-for-schema", "60",
        "--suppress-health-check", "all", "--warnings", "off",
        "--continue-on-failure", "--no-color",
    ]  # fmt: skip
    for threads in ("2", "1", "1"):
        done = subprocess.run(
            [*command, "--workers", threads],
            env=environment, cwd=tmp_path, capture_output=True, text=True, check=False,
            timeout=300 * EXAMPLES,
        )  # fmt: skip
        if AST_IN_THREADS not in done.stdout:
            break
    assert done.returncode == 0, done.stdout[-20_000:] + done.stderr[-2000:]
    log = front_end.log.read_text()
    assert "Traceback" not in log, log[-5000:]
    assert front_end.process.poll() is None
    print(done.stdout[-2500:])  # noqa: T201 - shown when the test fails or on request

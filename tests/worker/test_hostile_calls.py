"""What the program of a job may not do beyond its folder: calls that Landlock does not know, and writing."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from octasplat.workers.sandbox.capabilities import sandbox_capabilities
from tests.support.worker_harness import ROOT, WorkerHarness

pytestmark = pytest.mark.skipif(
    None in sandbox_capabilities().values(), reason="the kernel takes no part in isolating processes here"
)
REFUSED = ("PermissionError", "OSError")
READER = """
import json, sys
from pathlib import Path
from types import SimpleNamespace
from octasplat.workers.sandbox.confinement import confine
from tests.support import hostile_kind
found = {}
hostile_kind.write_outcomes = lambda _task, tries: found.update(tries)
options = hostile_kind.HostileOptions(attack="", target=sys.argv[2], pids=(int(sys.argv[1]),))
task = SimpleNamespace(folder=Path(sys.argv[3]))
confine(hidden=[], readable=[], may_start_processes=False)
hostile_kind.Path.write_text = lambda *_: None
hostile_kind.os.open = lambda *_: 0
hostile_kind._change_what_landlock_does_not_know(task, options)
said = {}
for name, attempt in found.items():
    try:
        said[name] = str(attempt())
    except OSError as error:
        said[name] = type(error).__name__
print(json.dumps(said))
"""


@pytest.fixture
def bench(bench: WorkerHarness) -> WorkerHarness:
    bench.worker(KIND_MODULES='["tests.support.hostile_kind"]')
    return bench


@pytest.fixture
def secret(tmp_path: Path) -> Path:
    path = tmp_path / "data" / "token"
    path.parent.mkdir(mode=0o700)
    path.write_text("a secret")
    path.chmod(0o600)
    os.utime(path, (1000.0, 1000.0))
    return path


@pytest.fixture
def bystander() -> Iterator["subprocess.Popen[bytes]"]:
    """A process of the same user that is none of the job's."""
    process = subprocess.Popen(["sleep", "600"])
    yield process
    process.kill()
    process.wait()


def attack(bench: WorkerHarness, name: str, **options: Any) -> dict[str, object]:
    job_id = bench.submit("hostile", options={"attack": name, **options})
    job = bench.wait_until_finished(job_id)
    assert job.state == "succeeded", (job.error, bench.log(job_id))
    found: dict[str, object] = json.loads(bench.results(job_id)["found.json"])
    return found


def test_job_cannot_change_what_landlock_does_not_know(
    bench: WorkerHarness, secret: Path, bystander: "subprocess.Popen[bytes]"
) -> None:
    worker = bench.processes[0].pid
    found = attack(bench, "calls", target=str(secret), pids=[worker, bystander.pid])
    assert {name: got for name, got in found.items() if got not in REFUSED} == {}
    facts = secret.stat()
    assert (facts.st_mode & 0o777, facts.st_mtime, os.listxattr(secret)) == (0o600, 1000.0, [])
    assert bystander.poll() is None and os.getpriority(os.PRIO_PROCESS, bystander.pid) == os.getpriority(
        os.PRIO_PROCESS, 0
    )


def test_reader_of_models_cannot_change_what_landlock_does_not_know(
    secret: Path, tmp_path: Path, bystander: "subprocess.Popen[bytes]"
) -> None:
    command = [sys.executable, "-c", READER, str(bystander.pid), str(secret), str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert len(found) > 25 and {name: got for name, got in found.items() if got not in REFUSED} == {}
    assert secret.stat().st_mode & 0o777 == 0o600 and bystander.poll() is None


def test_job_writes_in_its_own_folder_only(bench: WorkerHarness, secret: Path) -> None:
    found = attack(bench, "write elsewhere", target=str(secret.parent))
    assert (found.pop("own folder"), found.pop("own temporary")) == ("written", "written")
    assert len(found) >= 8 and {name: got for name, got in found.items() if got != "PermissionError"} == {}

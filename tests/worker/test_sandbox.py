"""What the program of a job cannot do, whatever somebody has made it run, and how that is told."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from octasplat.workers.client.api import Api
from octasplat.workers.sandbox.capabilities import sandbox_capabilities
from octasplat.workers.worker.child_main import NICENESS
from tests.support.worker_harness import ROOT, WorkerHarness, wait_for_end

pytestmark = pytest.mark.skipif(
    None in sandbox_capabilities().values(), reason="the kernel takes no part in isolating processes here"
)
READER = """
import json, os, socket, subprocess, sys
from pathlib import Path
from octasplat.workers.sandbox.confinement import confine
confine(hidden=[Path(sys.argv[1])], readable=[Path(sys.argv[1]) / "open"], may_start_processes=False)
import numpy
tries = dict(
    shut=lambda: Path(sys.argv[1], "shut").read_text(),
    open=lambda: Path(sys.argv[1], "open", "x").read_text(),
    write=lambda: Path(sys.argv[1]).parent.joinpath("planted").write_text("x"), fork=os.fork,
    start=lambda: subprocess.run(["true"]).returncode, network=lambda: socket.socket().close(),
)
found = {}
for name, attempt in tries.items():
    try:
        found[name] = attempt()
    except OSError as error:
        found[name] = type(error).__name__
print(json.dumps(found))
"""
WITHOUT_LANDLOCK = """
from octasplat.workers.sandbox import seccomp
unknown = (9999, 9999)
seccomp.MMAP = seccomp.IOCTL = seccomp.SET_LIMITS = seccomp.SET_CORES = seccomp.SET_PRIORITY = unknown
seccomp.ALLOWED = {str(number): (number, number) for number in range(500) if number != 444}
seccomp.REFUSED = {"landlock_create_ruleset": (444, 444)}
seccomp.install_seccomp_filter(may_start_processes=True)
from octasplat.workers.cli.main import main
main()
"""


def test_sandboxed_job_sees_no_secrets_and_yields_the_cpu(bench: WorkerHarness) -> None:
    secrets = [bench.folder / "store" / "blob", bench.folder / "data" / "token"]
    for path in secrets:
        path.parent.mkdir()
        path.write_text("a secret")
    bench.worker(KIND_MODULES='["tests.support.spy_kind"]', DATA=str(bench.folder / "data"))
    job_id = bench.submit("spy", options={"secrets": [str(path) for path in secrets]})
    assert bench.wait_until_finished(job_id).state == "succeeded", bench.log(job_id)
    found = json.loads(bench.results(job_id)["found.json"])
    assert found.pop("own environment") == []
    niceness = min(19, os.nice(0) + NICENESS)
    assert found.pop("niceness") == niceness
    assert found.pop("niceness among sessions") == (
        str(niceness) if Path("/proc/self/autogroup").is_file() else "FileNotFoundError"
    )
    assert {name: got for name, got in found.items() if got != "PermissionError"} == {}
    assert not list(bench.folder.rglob("planted"))


def test_job_exceeding_process_limit_fails(shared_bench: WorkerHarness) -> None:
    job_id = shared_bench.submit(
        "spy", options={"secrets": [str(shared_bench.folder / "x")], "children": 300}
    )
    job = shared_bench.wait_until_finished(job_id)
    assert job.state == "failed" and job.error is not None and job.error["type"] == "process_limit"


def test_sandboxed_model_reader_cannot_write_or_connect(tmp_path: Path) -> None:
    folder = tmp_path / "service"
    (folder / "open").mkdir(parents=True)
    (folder / "open" / "x").write_text("a model")
    (folder / "shut").write_text("a secret")
    command = [sys.executable, "-c", READER, str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    found = json.loads(done.stdout)
    assert found.pop("open") == "a model"
    assert set(found.values()) == {"PermissionError"} and not list(tmp_path.rglob("planted"))


@pytest.mark.exhaustive
def test_missing_sandbox_capabilities_are_logged_once(short_root: Path, tmp_path: Path) -> None:
    data, log = short_root / "unshielded", tmp_path / "log"
    command = [sys.executable, "-c", WITHOUT_LANDLOCK, "serve", "--port", "0", "--data", str(data)]
    environment = {**os.environ, "OCTASPLAT_FLOOR_BYTES": "0", "PYTHONPATH": str(ROOT)}
    with log.open("wb") as said:
        process = subprocess.Popen(command, env=environment, stdout=said, stderr=said)
    try:
        deadline = time.monotonic() + 120
        while not (data / "serve.json").exists():
            assert process.poll() is None and time.monotonic() < deadline, log.read_text()
            time.sleep(0.05)
        with Api.local(data) as api:
            isolation = api.get("/v1/info")["isolation"]
            assert isolation["folders"] is None and isolation["network"] == "seccomp"
            while len(workers := api.get("/v1/queues")["workers"]) < 2:
                assert time.monotonic() < deadline, log.read_text()
                time.sleep(0.1)
            assert {row["facts"]["isolation"]["folders"] for row in workers} == {None}
    finally:
        process.terminate()
        process.wait(120)
    wait_for_end(process.pid)
    lines = [line for line in log.read_text().splitlines() if "nothing keeps the programs" in line]
    assert len(lines) == 1 and "folders" in lines[0] and "network" not in lines[0]


def start_numba_threads(_task: object) -> None:
    import numba

    numba.set_num_threads(1)


@pytest.mark.exhaustive
def test_log_of_a_job_does_not_tell_of_locks_that_it_needs_not(tmp_path: Path) -> None:
    task = {
        "kind_modules": [],
        "program": "tests.worker.test_sandbox:start_numba_threads",
        "folder": str(tmp_path),
        "options": {},
        "scene": None,
        "title": "",
        "threads": 1,
    }
    with subprocess.Popen(
        [sys.executable, "-c", "from octasplat.workers.worker.job_process import run_job; run_job()"],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    ) as process:  # fmt: skip
        assert process.stdin is not None and process.stdout is not None and process.stderr is not None
        process.stdin.write(json.dumps(task) + "\n")
        process.stdin.flush()
        said, log = process.stdout.read(), process.stderr.read()
    assert json.loads(said.splitlines()[-1]) == {"kind": "done"}
    assert log == ""

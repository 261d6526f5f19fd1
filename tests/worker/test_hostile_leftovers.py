"""Nothing that a job has started or holds outlives it, whatever it has done to be forgotten."""

import inspect
import json
import subprocess
import sys
import time
import uuid
from collections.abc import Callable

import psutil
import pytest

from octasplat.workers.sandbox.capabilities import sandbox_capabilities
from octasplat.workers.sandbox.linux import IS_LINUX
from octasplat.workers.sandbox.process_tree import kill_descendants, tree_memory_bytes
from tests.support.worker_harness import WorkerHarness

pytestmark = pytest.mark.skipif(not IS_LINUX, reason="processes without parents are found on Linux only")
SHARED = """
import mmap, sys
shared = mmap.mmap(-1, 64 << 20)
for start in range(0, len(shared), 4096):
    shared[start] = 1
print(flush=True)
sys.stdin.read()
"""


def start_worker(bench: WorkerHarness, **settings: str) -> "subprocess.Popen[bytes]":
    return bench.worker(KIND_MODULES='["tests.support.hostile_kind"]', **settings)


def daemons(job_id: uuid.UUID) -> list[int]:
    found = []
    for process in psutil.process_iter(("cmdline", "status")):
        words = process.info["cmdline"] or ()
        if any(f"daemon of {job_id}" in word for word in words) and process.info["status"] != "zombie":
            found.append(process.pid)
    return found


def wait_for(condition: Callable[[], object], seconds: float = 60.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.mark.parametrize("how", ["quiet", "loud", "fleeing"])
def test_daemons_of_a_job_end_with_it(shared_bench: WorkerHarness, how: str) -> None:
    job_id = shared_bench.submit("hostile", options={"attack": "daemon", "target": how})
    job = shared_bench.wait_until_finished(job_id)
    assert job.state == "succeeded" and daemons(job_id) == []


def test_canceled_job_with_a_held_pipe_frees_its_slot(shared_bench: WorkerHarness) -> None:
    job_id = shared_bench.submit("hostile", options={"attack": "daemon", "target": "loud", "lasts": True})
    wait_for(lambda: daemons(job_id))
    shared_bench.cancel(job_id)
    job = shared_bench.wait_until_finished(job_id)
    assert job.state in ("canceled", "succeeded") and daemons(job_id) == []
    later = shared_bench.submit("hostile", options={"attack": "daemon"})
    assert shared_bench.wait_until_finished(later).state == "succeeded"


@pytest.mark.exhaustive
def test_daemons_end_when_their_worker_is_killed(bench: WorkerHarness) -> None:
    worker = start_worker(bench)
    job_id = bench.submit("hostile", options={"attack": "daemon", "lasts": True})
    wait_for(lambda: daemons(job_id))
    worker.kill()
    wait_for(lambda: not daemons(job_id), 30)


@pytest.mark.exhaustive
def test_shared_memory_does_not_pass_the_memory_limit(bench: WorkerHarness) -> None:
    start_worker(bench, MEMORY_LIMIT_BYTES=str(400 << 20))
    job_id = bench.submit("hostile", options={"attack": "shared memory", "size_bytes": 1 << 30})
    job = bench.wait_until_finished(job_id)
    if sandbox_capabilities()["calls"] is not None:
        assert json.loads(bench.results(job_id)["found.json"]) == {"hog": "PermissionError"}
    else:
        assert job.error is not None and job.error["type"] == "memory_limit"


def test_shared_memory_counts() -> None:
    with subprocess.Popen(
        [sys.executable, "-c", SHARED], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        assert process.stdout is not None
        process.stdout.readline()
        assert tree_memory_bytes(process.pid) >= 64 << 20
        process.communicate(b"")


@pytest.mark.parametrize("lasts", [False, True])
def test_folders_too_deep_end_the_job_and_not_its_worker(shared_bench: WorkerHarness, lasts: bool) -> None:
    job_id = shared_bench.submit("hostile", options={"attack": "dig", "lasts": lasts})
    job = shared_bench.wait_until_finished(job_id)
    if lasts:
        assert job.state == "failed" and job.error is not None and job.error["type"] == "not_a_file"
    later = shared_bench.submit("hostile", options={"attack": "daemon"})
    assert shared_bench.wait_until_finished(later).state == "succeeded"
    wait_for(lambda: not list(shared_bench.folder.glob("work-*/attempts/*")))


CHAIN = """
import os, sys, time
if os.fork() == 0:
    # Each is the only child of the one before it.
    for _ in range(int(sys.argv[1])):
        if os.fork():
            time.sleep(120)
            os._exit(0)
    os.write(1, b"x")
    time.sleep(120)
    os._exit(0)
os.read(0, 1)
"""


@pytest.mark.exhaustive
def test_chains_of_processes_longer_than_the_stack_are_killed() -> None:
    with subprocess.Popen(
        [sys.executable, "-I", "-S", "-c", CHAIN, "60"], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as first:
        assert first.stdout is not None and first.stdout.read(1) == b"x"
        limit = sys.getrecursionlimit()
        frames = len(inspect.stack())
        try:
            sys.setrecursionlimit(frames + 50)
            seen = kill_descendants(first.pid)
        finally:
            sys.setrecursionlimit(limit)
        assert seen == 61 and first.poll() is None

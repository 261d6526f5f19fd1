"""Two workers that share a database and an S3 store only: the second goes on where the first one died."""

import os
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Iterator
from pathlib import Path

import boto3
import psycopg
import pytest
from moto.server import ThreadedMotoServer
from psycopg.conninfo import conninfo_to_dict, make_conninfo

from benchmarks.chaos import journal_faults
from benchmarks.chaos_kind import ChainOptions, undisturbed
from octasplat.workers.db.locks import OWNER
from octasplat.workers.settings import WorkerSettings
from octasplat.workers.storage.factory import open_storage
from tests.support.namespaces import GATEWAY, NamespaceHost, forward_socket, hosts, missing_requirement
from tests.support.worker_harness import ROOT, WorkerHarness, child_pids, is_alive

pytestmark = pytest.mark.heavy

OF_THE_DEFAULTS = 0.4
"""Share of the times that users get, all of them alike."""
TIMES = {
    f"{name}_seconds": OF_THE_DEFAULTS * WorkerSettings.model_fields[f"{name}_seconds"].default
    for name in ("heartbeat", "stale", "rescue", "poll")
}
TAKEN_OVER_SECONDS = TIMES["stale_seconds"] + 20.0  # much on a busy machine
STEPS = 40
PHOTOGRAPHS = {"images/a.png": b"not looked at by this kind", "images/b.png": b"x" * 100_000}


class Hosts:
    """Two hosts, at :data:`TIMES`."""

    def __init__(self, bench: WorkerHarness, found: list[NamespaceHost], database: str, store: str) -> None:
        self.bench = bench
        self.found = found
        self._database = database
        self.store = store

    def worker(self, number: int) -> "subprocess.Popen[bytes]":
        """Start the worker of a host."""
        folder = self.bench.folder / f"host{number}"
        environment = {
            **os.environ,
            "DATABASE_URL": self._database,
            "OCTASPLAT_DATA": str(folder),
            "OCTASPLAT_STORAGE": self.store,
            "OCTASPLAT_FLOOR_BYTES": "0",
            **{f"OCTASPLAT_{name.upper()}": str(seconds) for name, seconds in TIMES.items()},
            "OCTASPLAT_KIND_MODULES": '["benchmarks.chaos_kind"]',
            "PYTHONPATH": str(ROOT),
        }
        command = [sys.executable, "-m", "octasplat", "worker", "--name", f"host{number}"]
        with (self.bench.folder / f"host{number}.log").open("ab") as log:
            process = subprocess.Popen(
                self.found[number].command(*command), env=environment, cwd=ROOT, stderr=log
            )
        self.bench.processes.append(process)
        return process


@pytest.fixture
def two(conninfo: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Hosts]:
    reason = missing_requirement()
    if reason is not None:
        pytest.skip(reason)
    for name in ("ACCESS_KEY_ID", "SECRET_ACCESS_KEY"):
        monkeypatch.setenv(f"AWS_{name}", "test")
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")
    facts = conninfo_to_dict(conninfo)
    bench = WorkerHarness(conninfo, tmp_path)
    with hosts(2) as found, forward_socket(f"{facts['host']}/.s.PGSQL.{facts['port']}") as port:
        server = ThreadedMotoServer(ip_address=GATEWAY, port=0, verbose=False)
        server.start()
        endpoint = f"http://{GATEWAY}:{server.get_host_and_port()[1]}"
        client = boto3.client("s3", endpoint_url=endpoint)
        client.create_bucket(Bucket="octasplat")
        client.close()
        database = make_conninfo(conninfo, host=GATEWAY, port=port)
        try:
            yield Hosts(bench, found, database, f"s3://octasplat/prefix?endpoint_url={endpoint}")
        finally:
            bench.close()
            server.stop()


def dataset(two: Hosts, store: str) -> uuid.UUID:
    """Photographs in the store and the tables."""
    storage = open_storage(store)
    made = uuid.uuid4()
    with psycopg.connect(two.bench.conninfo) as connection:
        connection.execute("SELECT pg_advisory_xact_lock(%s, hashtext('me'))", [OWNER])
        connection.execute(
            "INSERT INTO datasets (id, owner, name, state) VALUES (%s, 'me', 'd', 'committed')", [made]
        )
        for path, content in PHOTOGRAPHS.items():
            with storage.open_writer() as writer:
                writer.write(content)
                blob = writer.commit()
            connection.execute(
                "INSERT INTO dataset_files (dataset_id, path, sha256, size_bytes) VALUES (%s, %s, %s, %s)",
                [made, path, blob.sha256, blob.size_bytes],
            )
    return made


@pytest.mark.parametrize("how", ["dead", "cut off"])
def test_job_of_disconnected_host_is_recovered_by_second_host(two: Hosts, how: str) -> None:
    bench, store = two.bench, two.store
    first = two.worker(0)
    options = ChainOptions(seed=1, steps=STEPS, seconds=0.05, gate=str(bench.gate))
    job_id = bench.submit("chain", dataset_id=dataset(two, store), options=options.model_dump())
    kept = bench.wait(job_id, lambda job: (job.checkpoint or {}).get("step", 0) >= STEPS // 2, 90).checkpoint
    assert kept is not None
    (child,) = child_pids(first)
    second = two.worker(1)
    while "takes" not in (bench.folder / "host1.log").read_text():
        assert second.poll() is None
        time.sleep(0.1)
    two.found[0].disconnect()
    if how == "dead":
        first.send_signal(signal.SIGKILL)
    died = time.monotonic()
    bench.wait(job_id, lambda job: job.worker == "host1", 40)
    seconds = time.monotonic() - died
    assert seconds <= TAKEN_OVER_SECONDS, bench.worker_logs()
    # The first has let go by itself, or there would be two at work by now.
    assert not is_alive(child)
    bench.wait(job_id, lambda _: any(e.kind == "resumed" for e in bench.events(job_id)), 20)
    if how == "cut off":
        two.found[0].reconnect()
    bench.open_gate()
    job = bench.wait_until_finished(job_id, 120)
    assert (job.state, job.attempt, job.rescues, job.worker) == ("succeeded", 2, 0, "host1")
    events = [
        {"id": e.number, "kind": e.kind, "attempt": e.attempt, "data": e.data} for e in bench.events(job_id)
    ]
    assert journal_faults(events) == []
    resumed = next(event for event in events if event["kind"] == "resumed")
    assert resumed["data"]["step"] >= kept["step"] and resumed["data"]["attempt"] == 1
    storage = open_storage(store)
    with psycopg.connect(bench.conninfo) as connection:
        ((name, sha256),) = connection.execute(
            "SELECT name, sha256 FROM artifacts WHERE job_id = %s", [job_id]
        ).fetchall()
    assert (name, b"".join(storage.read(sha256))) == ("chain.bin", undisturbed(PHOTOGRAPHS, options))
    print(f"taken over {seconds:.1f} s after the first was {how}")  # noqa: T201 - shown on request

"""Two hosts, each a network namespace, that share a database and an S3 store only."""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import boto3
import pytest
from moto.server import ThreadedMotoServer
from psycopg.conninfo import conninfo_to_dict, make_conninfo

from octasplat.workers.settings import WorkerSettings
from tests.support.namespaces import GATEWAY, NamespaceHost, forward_socket, hosts, missing_requirement
from tests.support.worker_harness import ROOT, WorkerHarness

OF_THE_DEFAULTS = 0.4
"""Share of the times that users get, all of them alike."""
TIMES = {
    f"{name}_seconds": OF_THE_DEFAULTS * WorkerSettings.model_fields[f"{name}_seconds"].default
    for name in ("heartbeat", "stale", "rescue", "poll")
}
TAKEN_OVER_SECONDS = TIMES["stale_seconds"] + 20.0  # much on a busy machine


class Hosts:
    """Two hosts, at :data:`TIMES`."""

    def __init__(self, bench: WorkerHarness, found: list[NamespaceHost], database: str) -> None:
        self.bench = bench
        self.found = found
        self._database = database

    def data(self, number: int) -> Path:
        """The data folder of a host."""
        return self.bench.folder / f"host{number}"

    def worker(self, number: int, kind_module: str = "") -> "subprocess.Popen[bytes]":
        """Start the worker of a host, which knows the kinds of a module besides those built in."""
        environment = {
            **os.environ,
            "DATABASE_URL": self._database,
            "OCTASPLAT_DATA": str(self.data(number)),
            "OCTASPLAT_STORAGE": self.bench.store,
            "OCTASPLAT_FLOOR_BYTES": "0",
            **{f"OCTASPLAT_{name.upper()}": str(seconds) for name, seconds in TIMES.items()},
            "OCTASPLAT_THREADS": "1",
            "OCTASPLAT_KIND_MODULES": f'["{kind_module}"]' if kind_module else "[]",
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
    with hosts(2) as found, forward_socket(f"{facts['host']}/.s.PGSQL.{facts['port']}") as port:
        server = ThreadedMotoServer(ip_address=GATEWAY, port=0, verbose=False)
        server.start()
        endpoint = f"http://{GATEWAY}:{server.get_host_and_port()[1]}"
        client = boto3.client("s3", endpoint_url=endpoint)
        client.create_bucket(Bucket="octasplat")
        client.close()
        store = f"s3://octasplat/prefix?endpoint_url={endpoint}"
        bench = WorkerHarness(conninfo, tmp_path, store=store)
        try:
            yield Hosts(bench, found, make_conninfo(conninfo, host=GATEWAY, port=port))
        finally:
            bench.close()
            server.stop()

"""How long the service takes to be ready, and what its front end needs of memory.

    python -m benchmarks.service_start --runs 5

Starts ``octasplat serve`` on a new data folder, stops it and starts it again, and then the front end alone on
that database; each until ``/readyz`` says yes. Prints JSON: seconds of each run, the front end's resident and
private memory in MB, and the load of the machine at the start.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import httpx
import psutil

from benchmarks.chaos_machine import ROOT, free_port
from octasplat.workers.postgres.embedded import EmbeddedPostgres


def ready_after(began: float, port: int, process: "subprocess.Popen[bytes]", seconds: float = 120) -> float:
    """Seconds from ``began`` until the service at that port is ready."""
    while True:
        try:
            if httpx.get(f"http://127.0.0.1:{port}/readyz", timeout=5).status_code == 200:
                return round(time.monotonic() - began, 2)
        except httpx.HTTPError:
            pass
        if process.poll() is not None or time.monotonic() - began > seconds:
            raise RuntimeError("The service does not start.")
        time.sleep(0.01)


def start(*command: str, **settings: str) -> "subprocess.Popen[bytes]":
    """Start a program of the service."""
    environment = {**os.environ, "OCTASPLAT_FLOOR_BYTES": "0", **settings}
    environment.pop("OCTASPLAT_HOST", None)
    quiet = subprocess.DEVNULL
    return subprocess.Popen(
        [sys.executable, "-m", *command], env=environment, cwd=ROOT, stdout=quiet, stderr=quiet
    )


def one_run(root: Path) -> dict[str, Any]:
    """From nothing, again, and the front end alone."""
    found: dict[str, Any] = {}
    data, port = root / "data", str(free_port())
    for name in ("serve_from_nothing_s", "serve_again_s"):
        began = time.monotonic()
        process = start("octasplat", "serve", "--data", str(data), "--port", port)
        found[name] = ready_after(began, int(port), process)
        process.terminate()
        process.wait(60)
    database = EmbeddedPostgres(data)
    database.start()
    try:
        began = time.monotonic()
        given = {"DATABASE_URL": database.conninfo(), "OCTASPLAT_DATA": str(data), "OCTASPLAT_PORT": port}
        process = start("octasplat", "api", **given)
        found["front_end_s"] = ready_after(began, int(port), process)
        memory = psutil.Process(process.pid).memory_full_info()
        found["front_end_rss_mb"] = round(memory.rss / 1e6, 1)
        found["front_end_private_mb"] = round(memory.uss / 1e6, 1)
        process.terminate()
        process.wait(60)
    finally:
        database.stop()
    return found


def main() -> int:
    """Run as often as asked."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--runs", type=int, default=5)
    options = parser.parse_args()
    load = os.getloadavg()[0]
    runs = []
    for _ in range(options.runs):
        with tempfile.TemporaryDirectory(prefix="octasplat-start-") as name:
            Path(name).chmod(0o711)
            runs.append(one_run(Path(name)))
    figures = {name: [run[name] for run in runs] for name in runs[0]}
    print(json.dumps({"load": round(load, 1), **figures}, indent=1))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

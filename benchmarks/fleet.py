"""A database, a front end and several workers in processes of their own, each of a version to be chosen."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import psutil

from benchmarks.chaos_machine import FAST, ROOT
from octasplat.workers.db.tokens import new_secret
from octasplat.workers.postgres.embedded import EmbeddedPostgres

STOP_SECONDS = 60.0
KINDS = '["benchmarks.chaos_kind"]'
"""Known to the release before as well."""


def release(commit: str, folder: Path) -> Path:
    """The programs of a commit, in a folder of their own."""
    command = ["git", "archive", "--format=tar", commit]
    archive = subprocess.run(command, cwd=ROOT, capture_output=True, check=True).stdout
    folder.mkdir(parents=True)
    subprocess.run(["tar", "-x"], cwd=folder, input=archive, check=True)
    return folder


def program(root: Path, *arguments: str) -> tuple[str, ...]:
    """Return what ``python -m`` runs of the version in ``root``; until 0.1 the packages stood alone."""
    if (root / "src").exists():
        return ("octasplat", *arguments)
    return ("service",) if arguments == ("api",) else ("workers", *arguments)


@dataclass
class Fleet:
    """What runs.

    Args:
        data: folder of the database, the store, the work and the logs.
        roots: folder of the programs of each worker by its name, and of the front end by "front".
    """

    data: Path
    roots: dict[str, Path]
    address: str = ""
    worker_prefix: tuple[str, ...] = ()
    """Command that begins each worker, such as ``nice``."""
    settings: Mapping[str, str] = field(default_factory=dict)
    """Of front end and workers, by names without prefix, where they differ from those of the chaos test."""
    _database: EmbeddedPostgres = field(init=False)
    _conninfo: str = ""
    _token: str = field(default_factory=new_secret)
    _processes: dict[str, "subprocess.Popen[bytes]"] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._database = EmbeddedPostgres(self.data, connections=200)

    def begin(self) -> None:
        """Start everything."""
        self._conninfo = self._database.start()
        self.start_front()
        for name in self.workers:
            self.start_worker(name)

    def end(self) -> None:
        """Stop everything."""
        for name in [*self.workers, "front"]:
            self._stop(name)
        self._database.stop()

    @property
    def workers(self) -> list[str]:
        """Names of the workers."""
        return [name for name in self.roots if name != "front"]

    def command(self, *arguments: str) -> str:
        """What a command of the front end's version says."""
        root = self.roots["front"]
        done = subprocess.run(
            [sys.executable, "-m", *program(root), *arguments],
            cwd=root, env=self._environment(root, {}), capture_output=True, text=True, check=True,
        )  # fmt: skip
        return done.stdout.strip()

    def start_front(self) -> None:
        """Start a front end, and talk to it from then on; the one before ends afterwards."""
        before, root = self._processes.pop("front", None), self.roots["front"]
        with self._log("front") as log:
            process = subprocess.Popen(
                [sys.executable, "-m", *program(root, "api")],
                cwd=root, env=self._environment(root, {"PORT": "0"}), stdout=subprocess.PIPE, stderr=log,
                start_new_session=True,
            )  # fmt: skip
        assert process.stdout is not None
        address = process.stdout.readline().decode().strip()
        if not address.startswith("http"):
            raise RuntimeError((self.data / "front.log").read_text()[-4000:])
        self.address, self._processes["front"] = address, process
        if before is not None:
            before.terminate()
            before.wait(STOP_SECONDS)

    def kill_front(self) -> None:
        """kill -9 of the front end, and another start."""
        self._processes["front"].kill()
        self._processes["front"].wait()
        self.start_front()

    def start_worker(self, name: str) -> None:
        """Start a worker."""
        root = self.roots[name]
        words = ("worker", "--queues", "cpu", "--name", name)
        command = [*self.worker_prefix, sys.executable, "-m", *program(root), *words]
        environment = self._environment(root, {"WORK": str(self.data / f"work-{name}")})
        with self._log(name) as log:
            self._processes[name] = subprocess.Popen(
                command, cwd=root, env=environment, stderr=log, start_new_session=True
            )

    def drain_worker(self, name: str) -> int:
        """SIGTERM, upon which it hands back its job, and another start; returns the exit code."""
        code = self._stop(name)
        self.start_worker(name)
        return code

    def kill_worker(self, name: str) -> None:
        """kill -9, and another start."""
        self._processes[name].kill()
        self._processes[name].wait()
        self.start_worker(name)

    def kill_job(self, name: str) -> None:
        """kill -9 of the program of a worker's job."""
        with contextlib.suppress(psutil.Error):
            for child in psutil.Process(self._processes[name].pid).children():
                child.send_signal(signal.SIGKILL)

    def revive(self) -> list[str]:
        """Start workers again that have ended by themselves, as they do without the database; their names."""
        ended = [name for name in self.workers if self._processes[name].poll() is not None]
        for name in ended:
            self.start_worker(name)
        return ended

    def _stop(self, name: str) -> int:
        process = self._processes[name]
        deadline = time.monotonic() + STOP_SECONDS
        process.terminate()
        while process.poll() is None:
            if time.monotonic() > deadline:
                process.kill()
            time.sleep(0.05)
        return process.returncode

    def _log(self, name: str) -> BinaryIO:
        return (self.data / f"{name}.log").open("ab")

    def _environment(self, root: Path, further: Mapping[str, str]) -> dict[str, str]:
        settings = {
            **FAST, "HEARTBEAT_SECONDS": "1", "STALE_SECONDS": "12", "KIND_MODULES": KINDS,
            "DATA": str(self.data), "STORAGE": str(self.data / "store"),
            "FLOOR_BYTES": "0", "TOKEN": self._token, **self.settings, **further,
        }  # fmt: skip
        return {
            **os.environ,
            **{f"OCTASPLAT_{name}": value for name, value in settings.items()},
            "DATABASE_URL": self._conninfo,
            "PYTHONPATH": os.pathsep.join((str(root / "src"), str(root))),
            "OMP_NUM_THREADS": "1",
        }

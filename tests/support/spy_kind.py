"""A kind of job that tries what no job has any business with, and tells what it got."""

import os
import socket
from collections.abc import Callable
from pathlib import Path

from pydantic import BaseModel, ConfigDict

from octasplat.workers.worker.job_kinds import JobKind, register
from octasplat.workers.worker.task import Task
from tests.support.attempt_outcomes import write_outcomes


class SpyOptions(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    secrets: tuple[str, ...]
    """Files."""
    children: int = 0


def _connect(address: tuple[str, int]) -> str:
    with socket.create_connection(address, timeout=5):
        return "connected"


def run(task: Task) -> None:
    options = SpyOptions.model_validate(task.options)
    parent = os.getppid()
    store = Path(options.secrets[0]).parent
    tries: dict[str, Callable[[], object]] = {
        "own environment": lambda: sorted(name for name in os.environ if "SECRET" in name or "URL" in name),
        "environment of the worker": lambda: Path(f"/proc/{parent}/environ").read_bytes().count(b"SECRET"),
        "memory of the worker": lambda: Path(f"/proc/{parent}/mem").open("rb").close(),
        "signal to the worker": lambda: os.kill(parent, 0),
        "network": lambda: _connect(("127.0.0.1", 9)),
        "socket": lambda: socket.socket(socket.AF_UNIX).close(),
        "store": lambda: (store / "planted").write_text("x"),
        "niceness": lambda: os.getpriority(os.PRIO_PROCESS, 0),
        "niceness among sessions": lambda: Path("/proc/self/autogroup").read_text().split()[-1],
        "work of others": lambda: (task.folder.parent / "planted").write_text("x"),
        **{f"file {path}": lambda path=path: Path(path).read_text() for path in options.secrets},
    }
    write_outcomes(task, tries)
    for _ in range(options.children):
        if os.fork() == 0:
            os.execvp("sleep", ["sleep", "600"])
    if options.children:
        while True:
            task.progress(_AliveEvent())


class _AliveEvent:
    kind = "alive"

    def as_dict(self) -> dict[str, object]:
        import time

        time.sleep(0.1)
        return {"kind": "alive"}


register(
    JobKind(
        name="spy",
        title="Spies",
        needs="dataset",
        options=SpyOptions,
        program="tests.support.spy_kind:run",
        stages=("train",),
    )
)

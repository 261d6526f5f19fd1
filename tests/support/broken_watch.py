"""The toy kind, on a worker that cannot tell the memory of jobs."""

from typing import NoReturn

from octasplat.workers.worker import child_process
from tests.support import toy_kind


def _fail(_: object) -> NoReturn:
    raise RuntimeError("no such file in /proc")


child_process.ChildProcess.memory_bytes = _fail  # type: ignore[method-assign]

__all__ = ["toy_kind"]

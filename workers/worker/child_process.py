"""The child process as seen by its worker: started, asked to stop, killed, read."""

import asyncio
import contextlib
import json
import logging
import os
import re
import signal
import time
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import psutil

from octasplat.engine.core.isolated_python import python_command
from octasplat.engine.files.splat_transform import PROGRAM_VARIABLE as SPLAT_TRANSFORM

logger = logging.getLogger(__name__)

MAX_LINE_BYTES = 1 << 20
MAX_LAST_LINES = 20
_READ_BYTES = 1 << 16
_PASSED_VARIABLES = re.compile(
    r"PATH|HOME|USER|LOGNAME|SHELL|LANG|LC_\w+|TZ|TMPDIR|TEMP|TMP|VIRTUAL_ENV|LD_LIBRARY_PATH|"
    r"DYLD_LIBRARY_PATH|XDG_CACHE_HOME|CUDA_\w+|NVIDIA_\w+|NUMBA_\w+|OMP_\w+|MKL_\w+|OPENBLAS_\w+|"
    r"OCTASPLAT_DEBUG|OCTASPLAT_SPLAT_TRANSFORM"
)


def child_environment(environment: Mapping[str, str]) -> dict[str, str]:
    """Return the environment for a job's process, without passwords, keys and tokens."""
    passed = {name: value for name, value in environment.items() if _PASSED_VARIABLES.fullmatch(name)}
    # Threads that wait for each other sleep instead of spinning, as in the command line.
    passed.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    return passed


def _with_absolute_paths(environment: dict[str, str]) -> dict[str, str]:
    """Return the environment with absolute paths, for a process in another folder."""
    named = environment.get(SPLAT_TRANSFORM)
    return environment if not named else {**environment, SPLAT_TRANSFORM: str(Path(named).absolute())}


class ChildProcess:
    """A running child.

    Args:
        process: with pipes for stdin, stdout and stderr, in a session of its own.
        on_event: told every JSON line of stdout.
        on_log: told every line of stderr.
    """

    def __init__(
        self,
        process: asyncio.subprocess.Process,
        on_event: Callable[[dict[str, Any]], None],
        on_log: Callable[[str], None],
    ) -> None:
        self._process = process
        self._on_event = on_event
        self._on_log = on_log
        self.last_output_at = time.monotonic()
        self.last_log_lines: deque[str] = deque(maxlen=MAX_LAST_LINES)
        self.error: dict[str, Any] | None = None
        self.is_ready = False
        assert process.stdout is not None and process.stderr is not None
        self._readers = (
            asyncio.create_task(self._read_lines(process.stdout, self._on_stdout_line)),
            asyncio.create_task(self._read_lines(process.stderr, self._on_stderr_line)),
        )

    @classmethod
    async def start(
        cls,
        task: Mapping[str, Any],
        on_event: Callable[[dict[str, Any]], None],
        on_log: Callable[[str], None],
    ) -> "ChildProcess":
        """Start a child with its task, see :mod:`octasplat.workers.worker.child_main`."""
        process = await asyncio.create_subprocess_exec(
            *python_command("octasplat.workers.worker.child_main", further_modules=task["kind_modules"]),
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
            start_new_session=True,
            env=_with_absolute_paths(child_environment(os.environ)),
            cwd=task["folder"],
            limit=MAX_LINE_BYTES,
        )
        child = cls(process, on_event, on_log)
        child._send(json.dumps({**task, "parent_pid": os.getpid()}))
        return child

    @property
    def pid(self) -> int:
        """Return the process id."""
        return self._process.pid

    async def wait(self) -> int:
        """Wait for the end and all output; returns the exit code, negative for a signal."""
        code = await self._process.wait()
        # A grandchild may hold the pipes open.
        _, late = await asyncio.wait(self._readers, timeout=5)
        for reader in late:
            reader.cancel()
        if self._process.stdin is not None:
            self._process.stdin.close()
        return code

    def request_stop(self) -> None:
        """Ask for a checkpoint and the end."""
        self._send("stop")

    def kill(self) -> None:
        """Kill the process and whatever it started, at once."""
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self._process.pid, signal.SIGKILL)

    def memory_bytes(self) -> int:
        """Return the private memory of the child and its descendants.

        Pages of files that are mapped, as those of photographs, belong to the system, which takes them back
        when it needs them.
        """
        total = 0
        with contextlib.suppress(psutil.Error):
            child = psutil.Process(self._process.pid)
            for process in (child, *child.children(recursive=True)):
                with contextlib.suppress(psutil.Error):
                    memory = process.memory_info()
                    total += memory.rss - getattr(memory, "shared", 0)
        return total

    def process_count(self) -> int:
        """Return the number of live descendants of the child."""
        with contextlib.suppress(psutil.Error):
            return len(psutil.Process(self._process.pid).children(recursive=True))
        return 0

    def _send(self, line: str) -> None:
        assert self._process.stdin is not None
        with contextlib.suppress(OSError, RuntimeError):
            self._process.stdin.write(f"{line}\n".encode())

    async def _read_lines(self, stream: asyncio.StreamReader, on_line: Callable[[str], None]) -> None:
        """Yield complete lines; a line without an end is cut, so that memory stays bounded."""
        rest = b""
        while piece := await stream.read(_READ_BYTES):
            self.last_output_at = time.monotonic()
            *lines, rest = (rest + piece).split(b"\n")
            if len(rest) > MAX_LINE_BYTES:
                lines, rest = [*lines, rest], b""
            for line in lines:
                on_line(line.decode("utf-8", errors="replace"))
        if rest:
            on_line(rest.decode("utf-8", errors="replace"))

    def _on_stdout_line(self, line: str) -> None:
        try:
            event = json.loads(line)
        except ValueError:
            return
        if not isinstance(event, dict) or not isinstance(event.get("kind"), str):
            return
        if event["kind"] == "ready":
            self.is_ready = True
        if event["kind"] == "error":
            self.error = {"type": str(event.get("type")), "message": str(event.get("message"))}
        try:
            self._on_event(event)
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            # Of a program that writes what it likes; what follows is still read.
            logger.info("an event of process %d was left out: %r", self.pid, error)

    def _on_stderr_line(self, line: str) -> None:
        text = line[-4000:].split("\r")[-1].rstrip()
        if text:
            self.last_log_lines.append(text)
            self._on_log(text)

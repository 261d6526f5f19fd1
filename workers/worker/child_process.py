"""The child process as seen by its worker: started, asked to stop, killed, read."""

import asyncio
import contextlib
import json
import logging
import math
import os
import re
import signal
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from octasplat.engine.core.isolated_python import python_command
from octasplat.engine.files.splat_transform import PROGRAM_VARIABLE as SPLAT_TRANSFORM
from octasplat.workers.sandbox.process_tree import descendant_count, kill_descendants, tree_memory_bytes
from octasplat.workers.worker.child_main import END_SIGNAL

logger = logging.getLogger(__name__)

MAX_LINE_BYTES = 1 << 20
MAX_LAST_LINES = 20
_READ_BYTES = 1 << 16
_POLL_SECONDS = 0.02
_FORCE_SECONDS = 5.0
"""A guard that takes longer to end its processes is ended itself."""
_PASSED_VARIABLES = re.compile(
    r"PATH|HOME|USER|LOGNAME|SHELL|LANG|LC_\w+|TZ|TMPDIR|TEMP|TMP|VIRTUAL_ENV|LD_LIBRARY_PATH|"
    r"DYLD_LIBRARY_PATH|XDG_CACHE_HOME|CUDA_\w+|NVIDIA_\w+|NUMBA_\w+|OMP_\w+|MKL_\w+|OPENBLAS_\w+|"
    r"OCTASPLAT_DEBUG|OCTASPLAT_SPLAT_TRANSFORM"
)


def child_command(kind_modules: Sequence[str]) -> tuple[str, ...]:
    """Return the command that starts a job's process below a guard, which ends with this process."""
    module = "octasplat.workers.worker.child_main"
    return python_command(module, str(os.getpid()), further_modules=kind_modules)


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
        self._force_at = math.inf
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
        """Start a child with its task, see :mod:`octasplat.workers.worker.job_process`."""
        process = await asyncio.create_subprocess_exec(
            *child_command(task["kind_modules"]),
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
            # Not in the group of the worker's terminal, whose Ctrl+C is for the worker alone.
            start_new_session=True,
            env=_with_absolute_paths(child_environment(os.environ)),
            cwd=task["folder"],
            limit=MAX_LINE_BYTES,
        )
        child = cls(process, on_event, on_log)
        child._send(json.dumps(dict(task)))
        return child

    @property
    def pid(self) -> int:
        """Return the process id."""
        return self._process.pid

    async def wait(self) -> int:
        """Wait for the end and all output; returns the exit code, negative for a signal."""
        # Not by the process's own wait, which lasts until nobody holds the pipes.
        while self._process.returncode is None:
            if time.monotonic() > self._force_at:
                self._force_end()
            await asyncio.sleep(_POLL_SECONDS)
        code = self._process.returncode
        # A process that escaped the guard may hold the pipes; its output is not waited for.
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
        """Have the process and whatever it started killed, at once."""
        if self._process.returncode is None:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.kill(self._process.pid, END_SIGNAL)
            self._force_at = min(self._force_at, time.monotonic() + _FORCE_SECONDS)

    def _force_end(self) -> None:
        """Kill all of them from here, as their guard does not."""
        kill_descendants(self._process.pid)
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.kill(self._process.pid, signal.SIGKILL)

    def memory_bytes(self) -> int:
        """Return the memory of the child and its descendants, shared memory included."""
        return tree_memory_bytes(self._process.pid)

    def process_count(self) -> int:
        """Return the number of live processes that the job's own has started, directly or not."""
        return descendant_count(self._process.pid) - 1  # without the program itself, a child of the guard

    def _send(self, line: str) -> None:
        assert self._process.stdin is not None
        # The child may be gone already, which its exit code tells.
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
        except (ValueError, RecursionError):
            return
        if not isinstance(event, dict) or not isinstance(event.get("kind"), str):
            return
        if event["kind"] == "ready":
            self.is_ready = True
        if event["kind"] == "error":
            self.error = {"type": str(event.get("type")), "message": str(event.get("message"))}
        try:
            self._on_event(event)
        except (KeyError, TypeError, ValueError, AttributeError, RecursionError) as error:
            # Of a program that writes what it likes; what follows is still read.
            logger.info("an event of process %d was left out: %r", self.pid, error)

    def _on_stderr_line(self, line: str) -> None:
        # Progress bars overwrite their line by carriage returns; only the last state is kept.
        text = line[-4000:].split("\r")[-1].rstrip()
        if text:
            self.last_log_lines.append(text)
            self._on_log(text)

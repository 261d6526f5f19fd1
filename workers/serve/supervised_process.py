"""Supervised processes: restarted when they end, with growing pauses if they keep ending."""

import asyncio
import contextlib
import logging
import os
import signal
import time
from collections.abc import Callable, Mapping, Sequence

from octasplat.engine.core.isolated_python import drop_python_variables
from octasplat.workers.parent_death_signal import PARENT_PID_VARIABLE

logger = logging.getLogger(__name__)

FIRST_RESTART_SECONDS = 0.5
MAX_RESTART_SECONDS = 30.0
STEADY_SECONDS = 60.0
"""A process that lived so long before it ended is started again at once."""
EXIT_NOT_STARTED = 127
"""Exit code of what could not even be started, as shells have it."""


class SupervisedProcess:
    """A process that is restarted whenever it ends.

    Args:
        name: for the log.
        command: the program with its arguments.
        environment: added to this process's own.
        on_line: told each line of its stdout; None leaves stdout as it is.
    """

    def __init__(
        self,
        name: str,
        command: tuple[str, ...],
        environment: Mapping[str, str],
        on_line: Callable[[str], None] | None = None,
    ) -> None:
        self.name = name
        self._command = command
        inherited = drop_python_variables(os.environ)
        self._environment = {**inherited, **environment, PARENT_PID_VARIABLE: str(os.getpid())}
        self._on_line = on_line
        self._process: asyncio.subprocess.Process | None = None
        self._stopping = asyncio.Event()
        self.start_count = 0
        self.last_exit_code: int | None = None

    @property
    def pid(self) -> int | None:
        """Return the process id while it runs, else None."""
        return self._process.pid if self._process is not None else None

    def set_variable(self, name: str, value: str) -> None:
        """Set an environment variable for the next starts."""
        self._environment[name] = value

    async def supervise(self) -> None:
        """Start the process, and restart it, until :meth:`stop`."""
        wait = FIRST_RESTART_SECONDS
        while not self._stopping.is_set():
            began = time.monotonic()
            self.last_exit_code = await self._run_once()
            if self._stopping.is_set():
                return
            wait = FIRST_RESTART_SECONDS if time.monotonic() - began > STEADY_SECONDS else wait
            logger.warning("%s ended (%s); starting it again in %.1f s", self.name, self.last_exit_code, wait)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(wait):
                    await self._stopping.wait()
            wait = min(MAX_RESTART_SECONDS, 2 * wait)

    def stop(self) -> None:
        """Ask the process to end and restart it no more; a second call kills it."""
        again = self._stopping.is_set()
        self._stopping.set()
        if self._process is not None and self._process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                self._process.send_signal(signal.SIGKILL if again else signal.SIGTERM)

    async def _run_once(self) -> int:
        self.start_count += 1
        try:
            self._process = await asyncio.create_subprocess_exec(
                *self._command,
                env=self._environment,
                cwd="/",  # nothing that lies where the user stands is to be found by chance
                stdin=asyncio.subprocess.DEVNULL,
                stdout=asyncio.subprocess.PIPE if self._on_line is not None else None,
                # A Ctrl+C in the terminal reaches this process alone, which stops the others in their order.
                start_new_session=True,
            )
        except OSError as error:
            logger.error("%s cannot be started: %s", self.name, error)
            return EXIT_NOT_STARTED
        if self._stopping.is_set():  # stop() was called while it started
            self._process.terminate()
        if self._on_line is not None and self._process.stdout is not None:
            async for line in self._process.stdout:
                self._on_line(line.decode(errors="replace").strip())
        code = await self._process.wait()
        self._process = None
        return code


async def kill_after_timeout(
    children: Sequence[SupervisedProcess], tasks: Sequence["asyncio.Task[None]"], seconds: float
) -> None:
    """Wait for the end of processes that were asked to stop, and kill those that still run after ``seconds``.

    Args:
        children: the processes; :meth:`SupervisedProcess.stop` was called.
        tasks: what runs :meth:`SupervisedProcess.supervise`.
        seconds: how long they may take.
    """
    _, late = await asyncio.wait(tasks, timeout=seconds)
    if late:
        for child in children:
            if child.pid is not None:
                logger.warning("%s does not end and is killed", child.name)
                child.stop()
        await asyncio.wait(late)

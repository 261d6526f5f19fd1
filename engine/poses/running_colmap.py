"""The process in which COLMAP works, as seen by the one that waits for it: what it says, and how it ends."""

import contextlib
import json
import os
import select
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from octasplat.engine.core.errors import CancelledError, ColmapCrashError, DatasetError, DiskFullError
from octasplat.engine.core.events import (
    Event,
    EventListener,
    PhaseFinished,
    PhaseProgress,
    PhaseStarted,
    parse_event,
)
from octasplat.engine.core.isolated_python import python_command
from octasplat.engine.core.writing import full_disk_error
from octasplat.engine.poses.config import LENSES_STAGE, MAPPING_STAGE, PLACING_STAGE, PoseSearchRequest

_POLL_SECONDS = 0.5
_HEARTBEAT_SECONDS = 30.0
"""How often a step that takes long tells that it is alive."""
_LAST_STAGES = (MAPPING_STAGE, PLACING_STAGE, LENSES_STAGE)
"""Stages whose end says that the result is there: told once it is, as others store or show it then."""
_SINGLE_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class ColmapProcess:
    """One process of COLMAP's, and what it says.

    Attributes:
        stage: that it is in.
        step: of the stage.
    """

    def __init__(
        self, request: PoseSearchRequest, progress: EventListener, should_stop: Callable[[], bool]
    ) -> None:
        self._request = request
        self._progress = progress
        self._should_stop = should_stop
        self.stage, self.step = "", 0
        self._last_progress: Event | None = None
        self._end: Event | None = None
        self._last_event_time = time.monotonic()
        self._error: DatasetError | DiskFullError | None = None
        self._is_done = False

    def wait(self) -> None:
        """Wait for the result, with progress and a check for requests to stop.

        Raises:
            CancelledError: stopped as asked.
            DatasetError: as the process says.
            ColmapCrashError: it said nothing and died.
        """
        log = self._request.work / "log.txt"
        with log.open("wb") as noise, start_process(self._request, noise) as process:
            assert process.stdout is not None
            rest = b""
            while piece := self._read_chunk(process.stdout.fileno()):
                *lines, rest = (rest + piece).split(b"\n")
                for line in lines:
                    self._handle_line(line)
            code = process.wait()
        if self._error is not None:
            raise self._error
        if not self._is_done:
            crash = ColmapCrashError(crash_message(code, self.stage, log))
            raise full_disk_error(self._request.work) or crash

    def tell_end(self) -> None:
        """Tell of the end of the last stage, once its result is where it belongs."""
        end, self._end = self._end, None
        if end is not None:
            self._forward_event(end)

    def _read_chunk(self, pipe: int) -> bytes:
        """Return the next bytes from the process; empty at its end."""
        while True:
            if self._should_stop():
                is_search = self._request.given is None and self._request.lenses_of is None
                how = "goes on where it was" if is_search else "begins them again"
                raise CancelledError(f"Stopped while finding poses; the same command with --resume {how}.")
            if select.select([pipe], [], [], _POLL_SECONDS)[0]:
                return os.read(pipe, 1 << 16)
            if (
                self._last_progress is not None
                and time.monotonic() - self._last_event_time > _HEARTBEAT_SECONDS
            ):
                self._forward_event(self._last_progress)

    def _handle_line(self, line: bytes) -> None:
        content = json.loads(line)
        kind = content.pop("kind")
        if kind == "done":
            self._is_done = True
        elif kind == "error":
            error = DiskFullError if content.get("is_disk_full") else DatasetError
            self._error = error(content["message"])
        elif (event := parse_event(kind, content)) is not None:
            if isinstance(event, PhaseStarted):
                self.tell_end()
            if isinstance(event, PhaseFinished) and event.stage in _LAST_STAGES:
                self._end = event  # what was found is still to be written
            else:
                self._forward_event(event)

    def _forward_event(self, event: Event) -> None:
        if isinstance(event, PhaseStarted):
            self.stage, self.step = event.stage, 0
            self._last_progress = PhaseProgress(event.stage, 0, event.total_steps)
        elif isinstance(event, PhaseProgress):
            self.step, self._last_progress = event.step, event
        elif isinstance(event, PhaseFinished):
            self._last_progress = None
        self._last_event_time = time.monotonic()
        self._progress(event)


@contextmanager
def start_process(request: PoseSearchRequest, stderr_log: IO[bytes]) -> Iterator["subprocess.Popen[bytes]"]:
    """Start the process in the caller's process group; it is killed when the block ends."""
    # COLMAP has threads of its own.
    environment = {**os.environ, **dict.fromkeys(_SINGLE_THREAD_VARIABLES, "1")}
    process = subprocess.Popen(  # noqa: S603 - a program of ours
        python_command("octasplat.engine.poses.colmap_process"),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=stderr_log,
        env=environment,
    )
    assert process.stdin is not None and process.stdout is not None
    try:
        with contextlib.suppress(BrokenPipeError):  # it is dead, which is told soon
            process.stdin.write(request.model_dump_json().encode() + b"\n")
            process.stdin.flush()
        yield process
    finally:
        process.kill()
        process.wait()
        for pipe in (process.stdin, process.stdout):
            with contextlib.suppress(OSError):
                pipe.close()


def crash_message(code: int, stage: str, log: Path) -> str:
    """Return what a user is told of a process that died in a stage, with the last line of its log."""
    placing = "placing photographs" if stage else "starting"
    known = {"read": "reading photographs", "features": "looking for features", "matches": "matching"}
    doing = (known | {"lenses": "adjusting lenses"}).get(stage, placing)
    how = f"was ended by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
    text = log.read_text(encoding="utf-8", errors="replace") if log.exists() else ""
    said = next((line.strip()[:300] for line in reversed(text.splitlines()) if line.strip()), "")
    advice = (
        "the machine may have run out of memory: use fewer threads"
        if code == -signal.SIGKILL
        else "run the same command again"
    )
    return (
        f"COLMAP {how} while {doing}{f' (it said: {said})' if said else ''}; "
        f"{advice}, or send a COLMAP model."
    )

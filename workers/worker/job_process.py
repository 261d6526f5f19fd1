"""Process of one job: runs its program, reports in JSON lines, stops when asked or orphaned.

Started by its guard, :mod:`octasplat.workers.worker.child_main`. The first line of stdin is the task
(JSON); a later line ``stop`` requests a checkpoint and a stop. If stdin ends, the worker has died. Events go
to stdout, one JSON object a line; output of libraries goes to stderr, which is the job's log.
"""

import contextlib
import importlib
import io
import json
import os
import signal
import sys
import threading
import traceback
import warnings
from pathlib import Path
from typing import Any, NoReturn

from octasplat.engine.core.errors import CancelledError, OctasplatError
from octasplat.engine.core.events import Event
from octasplat.engine.core.kernel_folder import shared_cache_folder
from octasplat.workers.parent_death_signal import set_parent_death_signal
from octasplat.workers.sandbox.confinement import confine, set_resource_limits
from octasplat.workers.sandbox.job_users import become_user
from octasplat.workers.storage.os_errors import is_disk_full
from octasplat.workers.worker.task import EXIT_REFUSED, EXIT_STOPPED, EXIT_UNEXPECTED, NO_SPACE_ERROR, Task

OOM_SCORE_ADJUSTMENT = 800
MAX_CAUSE_LINES = 60


class _EventStream:
    """The original stdout, reserved for JSON lines."""

    def __init__(self) -> None:
        self._file = os.fdopen(os.dup(1), "w", encoding="utf-8")
        # print() and C libraries write to descriptor 1, which leads to the log from here on.
        os.dup2(2, 1)
        if isinstance(sys.stdout, io.TextIOWrapper):
            sys.stdout.reconfigure(line_buffering=True)  # what is printed belongs between the stages
        # Events come from several threads, whose lines must not mix.
        self._lock = threading.Lock()

    def write(self, line: dict[str, object]) -> None:
        with self._lock:
            self._file.write(json.dumps(line) + "\n")
            self._file.flush()


def run_job() -> NoReturn:
    """Run the task from stdin and exit."""
    lines = _EventStream()
    given: dict[str, Any] = json.loads(sys.stdin.readline())
    _raise_oom_score()
    _enter_sandbox(given)
    stop = threading.Event()
    threading.Thread(target=_watch_stdin, args=(stop,), daemon=True).start()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    code = _run_task(given, lines, stop)
    sys.stderr.flush()
    # Not by way of the interpreter's clean-up, in which a library may hang or crash after all is done.
    os._exit(code)


def _run_task(task: dict[str, Any], events: _EventStream, stop: threading.Event) -> int:
    def report(event: Event) -> None:
        events.write(event.as_dict())

    try:
        for module in task["kind_modules"]:
            importlib.import_module(module)
        module_name, _, function = task["program"].partition(":")
        program = getattr(importlib.import_module(module_name), function)
        if task.get("probe"):
            return 0
        # After all imports, as pycolmap takes SIGTERM for itself.
        signal.signal(signal.SIGTERM, lambda _number, _frame: stop.set())
        events.write({"kind": "ready"})
        program(
            Task(
                folder=Path(task["folder"]),
                options=task["options"],
                scene=Path(task["scene"]) if task["scene"] else None,
                title=task["title"],
                threads=task["threads"],
                progress=report,
                should_stop=stop.is_set,
                kind=task.get("kind", ""),
                begins_with=Path(task["begins_with"]) if task.get("begins_with") else None,
                requested=task.get("requested"),
            )
        )
    except CancelledError as error:
        events.write({"kind": "stopped", "message": str(error)})
        return EXIT_STOPPED
    except OctasplatError as error:
        kind = NO_SPACE_ERROR if is_disk_full(error) else error.error_type
        events.write({"kind": "error", "type": kind, "message": str(error), "cause": _cause_lines(error)})
        return EXIT_REFUSED
    except MemoryError:
        events.write({"kind": "error", "type": "out_of_memory", "message": "The job ran out of memory."})
        return EXIT_REFUSED
    except Exception as error:  # noqa: BLE001 - told to the worker, which tells the user
        if task.get("probe"):
            sys.stderr.write(f"{type(error).__name__}: {error}\n")
        kind = NO_SPACE_ERROR if is_disk_full(error) else "unexpected"
        message = f"{type(error).__name__}: {error}"
        cause = "".join(traceback.format_exception(error)).splitlines()[-MAX_CAUSE_LINES:]
        events.write({"kind": "error", "type": kind, "message": message, "cause": cause})
        return EXIT_UNEXPECTED
    events.write({"kind": "done"})
    return 0


def _cause_lines(error: BaseException) -> list[str]:
    """Return the causes of an error, one line each."""
    found: list[str] = []
    while len(found) < MAX_CAUSE_LINES:
        inner = error.__cause__ or (None if error.__suppress_context__ else error.__context__)
        if inner is None:
            break
        found.append(f"Caused by {type(inner).__name__}: {' '.join(str(inner).split())[:2000]}")
        error = inner
    return found


def _watch_stdin(stop: threading.Event) -> None:
    for line in sys.stdin:
        if line.strip() == "stop":
            stop.set()
    os.kill(os.getpid(), signal.SIGKILL)  # the end of stdin: the worker is gone


def _raise_oom_score() -> None:
    """Raise the OOM score, so that the system kills this process before the database."""
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(str(OOM_SCORE_ADJUSTMENT), encoding="ascii")


def _enter_sandbox(task: dict[str, Any]) -> None:
    """Give up rights that the work does not need, while there is one thread; later ones inherit this."""
    if task.get("uid") is not None:
        guard = os.getppid()
        become_user(task["uid"], Path(task["folder"]))
        set_parent_death_signal(guard, signal.SIGKILL)  # which another user is not sent unless it asks anew
    set_resource_limits(task.get("memory_limit_bytes"))
    written: tuple[Path, ...] = ()
    if "folder" in task:
        written = (Path(task["folder"]),)
        temporary = written[0] / "tmp"
        temporary.mkdir(exist_ok=True)
        os.environ["TMPDIR"] = str(temporary)
    # numba tells whoever reads the log that /dev/shm is shut, though no other process shares its threads.
    warnings.filterwarnings("ignore", r"(?s).*multiprocessing lock")
    # Machine code that other processes run is theirs to make; a job reads it.
    kernels = shared_cache_folder()
    confine(
        hidden=[Path(path) for path in task.get("hidden", ())],
        writable=written,
        readable=[kernels, *([Path(task["scene"])] if task.get("scene") else ())],
        may_start_processes=True,
    )

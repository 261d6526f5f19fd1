"""The child process of a worker: does one job, tells of it in JSON lines, stops when asked or orphaned.

Run by :func:`octasplat.engine.isolated_python.python_command`. The first line of stdin is the task as JSON; a
later line ``stop`` asks to stop with a checkpoint, and its end means that the worker is gone. Events go to
stdout, one JSON object a line; whatever libraries print goes to stderr, which is the job's log.
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
from pathlib import Path
from typing import Any, NoReturn

from octasplat.engine.errors import Cancelled, OctasplatError
from octasplat.engine.events import Event
from octasplat.workers.isolation.confining import confine, limit_growth
from octasplat.workers.parent import die_with
from octasplat.workers.store.os_errors import lacks_room
from octasplat.workers.work.task import EXIT_REFUSED, EXIT_STOPPED, EXIT_UNEXPECTED, NO_SPACE, Task

_OOM_SCORE = 800
MAX_CAUSE_LINES = 60


class _Lines:
    """The original stdout, for JSON lines only."""

    def __init__(self) -> None:
        self._file = os.fdopen(os.dup(1), "w", encoding="utf-8")
        os.dup2(2, 1)
        if isinstance(sys.stdout, io.TextIOWrapper):
            sys.stdout.reconfigure(line_buffering=True)  # what is printed belongs between the stages
        self._lock = threading.Lock()

    def write(self, line: dict[str, object]) -> None:
        with self._lock:
            self._file.write(json.dumps(line) + "\n")
            self._file.flush()


def main() -> NoReturn:
    """Do the task that stdin brings and exit."""
    lines = _Lines()
    given: dict[str, Any] = json.loads(sys.stdin.readline())
    die_with(given["parent_pid"], signal.SIGKILL)  # elsewhere than on Linux the end of stdin does
    _be_first_to_go()
    _confine(given)
    stop = threading.Event()
    threading.Thread(target=_watch_stdin, args=(stop,), daemon=True).start()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    code = _work(given, lines, stop)
    sys.stderr.flush()
    # Not by way of the interpreter's clean-up, in which a library may hang or crash after all is done.
    os._exit(code)


def _work(given: dict[str, Any], lines: _Lines, stop: threading.Event) -> int:
    def tell(event: Event) -> None:
        lines.write(event.as_dict())

    try:
        for module in given["kind_modules"]:
            importlib.import_module(module)
        module_name, _, function = given["program"].partition(":")
        program = getattr(importlib.import_module(module_name), function)
        if given.get("probe"):
            return 0
        # After all imports, as pycolmap takes SIGTERM for itself.
        signal.signal(signal.SIGTERM, lambda _number, _frame: stop.set())
        lines.write({"kind": "ready"})
        program(
            Task(
                folder=Path(given["folder"]),
                options=given["options"],
                scene=Path(given["scene"]) if given["scene"] else None,
                title=given["title"],
                threads=given["threads"],
                listener=tell,
                should_stop=stop.is_set,
                kind=given.get("kind", ""),
            )
        )
    except Cancelled as error:
        lines.write({"kind": "stopped", "message": str(error)})
        return EXIT_STOPPED
    except OctasplatError as error:
        kind = NO_SPACE if lacks_room(error) else _snake(type(error).__name__)
        lines.write({"kind": "error", "type": kind, "message": str(error), "cause": _cause(error)})
        return EXIT_REFUSED
    except MemoryError:
        lines.write({"kind": "error", "type": "out_of_memory", "message": "The job ran out of memory."})
        return EXIT_REFUSED
    except Exception as error:  # noqa: BLE001 - told to the worker, which tells the user
        if given.get("probe"):
            sys.stderr.write(f"{type(error).__name__}: {error}\n")
        kind = NO_SPACE if lacks_room(error) else "unexpected"
        message = f"{type(error).__name__}: {error}"
        cause = "".join(traceback.format_exception(error)).splitlines()[-MAX_CAUSE_LINES:]
        lines.write({"kind": "error", "type": kind, "message": message, "cause": cause})
        return EXIT_UNEXPECTED
    lines.write({"kind": "done"})
    return 0


def _cause(error: BaseException) -> list[str]:
    """What an error came from, a line each."""
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
    os.kill(os.getpid(), signal.SIGKILL)


def _be_first_to_go() -> None:
    """Where memory runs out, the system shall end this process rather than the database."""
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(str(_OOM_SCORE), encoding="ascii")


def _confine(given: dict[str, Any]) -> None:
    """Give up what the work does not need, while there is one thread; those that come later have no more."""
    limit_growth(given.get("memory_limit_bytes"))
    written: tuple[Path, ...] = ()
    if "folder" in given:
        written = (Path(given["folder"]),)
        temporary = written[0] / "tmp"
        temporary.mkdir(exist_ok=True)
        os.environ["TMPDIR"] = str(temporary)
    confine(
        hidden=[Path(path) for path in given.get("hidden", ())],
        written=written,
        read=[Path(given["scene"])] if given.get("scene") else (),
        may_start_processes=True,
        elsewhere_reads_only=False,
    )


def _snake(name: str) -> str:
    return "".join(f"_{c.lower()}" if c.isupper() else c for c in name).lstrip("_")


if __name__ == "__main__":
    main()

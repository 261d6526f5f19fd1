"""The process in which COLMAP works; see :mod:`octasplat.engine.poses.running_colmap`, which starts it.

Run as ``python -m octasplat.engine.poses.colmap_process``. The first line of stdin is the request as JSON,
its end means that nobody waits any more. Events go to stdout, one JSON object a line, and then ``done`` or
``error``.
"""

import fcntl
import json
import os
import signal
import sys
import threading
from typing import NoReturn

from octasplat.engine.core.errors import DatasetError, DiskFullError
from octasplat.engine.core.events import Event
from octasplat.engine.core.writing import full_disk_error, report_disk_full
from octasplat.engine.poses.config import FOUND_FOLDER, PoseSearchRequest

_CRASH_SIGNALS = (signal.SIGSEGV, signal.SIGABRT, signal.SIGBUS, signal.SIGFPE, signal.SIGILL)
"""COLMAP would print where it was first, which can wait for ever for a lock that the crash left closed."""


def main() -> NoReturn:
    """Run the requested search and exit."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the one who waits
    out = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # whatever libraries print goes to stderr
    request = PoseSearchRequest.model_validate_json(sys.stdin.readline())
    _end_on_stdin_close()
    threading.Thread(target=_exit_on_stdin_close, daemon=True).start()

    def write(line: dict[str, object]) -> None:
        out.write(json.dumps(line) + "\n")
        out.flush()

    def tell(event: Event) -> None:
        write(event.as_dict())

    try:
        from octasplat.engine.poses.pose_repair import repair_misplaced
        from octasplat.engine.poses.principal_points import write_per_view_principal_points
        from octasplat.engine.poses.search import PoseSearch

        for number in _CRASH_SIGNALS:
            signal.signal(number, signal.SIG_DFL)
        with report_disk_full(request.work):
            if request.lenses_of is not None:
                write_per_view_principal_points(request, request.lenses_of, tell)
            elif request.given is not None:
                repair_misplaced(request, request.given, tell)
            else:
                search = PoseSearch(
                    request.images, request.names, request.work, request.config, request.threads, tell
                )
                search.run(request.work / FOUND_FOLDER)
        write({"kind": "done"})
    except (DatasetError, DiskFullError) as error:
        write({"kind": "error", "message": str(error), "is_disk_full": isinstance(error, DiskFullError)})
    except (RuntimeError, ValueError, OSError, MemoryError) as error:  # COLMAP's, by way of its binding
        text = " ".join(str(error).split())[:300].rstrip(".") or type(error).__name__
        message = f"COLMAP cannot find poses for {request.images} ({text}); look at the photographs."
        if request.lenses_of is not None:
            message = f"COLMAP cannot adjust the model in {request.lenses_of} ({text}); run COLMAP again."
        full = full_disk_error(request.work)
        write({"kind": "error", "message": str(full or message), "is_disk_full": full is not None})
    # Not by way of the interpreter's clean-up, in which a library may hang or crash after all is done.
    os._exit(0)


def _end_on_stdin_close() -> None:
    """Let the system end this process when nobody waits any more, while COLMAP holds the GIL, too."""
    signal.signal(signal.SIGIO, signal.SIG_DFL)
    fcntl.fcntl(0, fcntl.F_SETOWN, os.getpid())
    fcntl.fcntl(0, fcntl.F_SETFL, fcntl.fcntl(0, fcntl.F_GETFL) | os.O_ASYNC)


def _exit_on_stdin_close() -> None:
    """End this process when its stdin is closed; it may have been before the system was asked to do so."""
    for _line in sys.stdin:
        pass
    os._exit(70)


if __name__ == "__main__":
    main()

"""The process in which COLMAP works; see :mod:`octasplat.engine.poses.find`, which starts it.

Run as ``python -m octasplat.engine.poses.child``. The first line of stdin is the request as JSON, its end
means that nobody waits any more. Events go to stdout, one JSON object a line, and then ``done`` or ``error``.
"""

import json
import os
import signal
import sys
import threading
from typing import NoReturn

from octasplat.engine.errors import DatasetError
from octasplat.engine.events import Event
from octasplat.engine.poses.config import FOUND, Request

_CRASHES = (signal.SIGSEGV, signal.SIGABRT, signal.SIGBUS, signal.SIGFPE, signal.SIGILL)
"""COLMAP would print where it was first, which can wait for ever for a lock that the crash left closed."""


def main() -> NoReturn:
    """Search as asked and exit."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the one who waits
    out = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # whatever libraries print goes to stderr
    request = Request.model_validate_json(sys.stdin.readline())
    threading.Thread(target=_end_with_stdin, daemon=True).start()

    def write(line: dict[str, object]) -> None:
        out.write(json.dumps(line) + "\n")
        out.flush()

    def tell(event: Event) -> None:
        write(event.as_dict())

    try:
        from octasplat.engine.poses.lenses import write_with_lenses
        from octasplat.engine.poses.misplaced import place_misplaced
        from octasplat.engine.poses.search import Search

        for number in _CRASHES:
            signal.signal(number, signal.SIG_DFL)
        if request.lenses_of is not None:
            write_with_lenses(request, request.lenses_of, tell)
        elif request.given is not None:
            place_misplaced(request, request.given, tell)
        else:
            search = Search(
                request.images, request.names, request.work, request.config, request.threads, tell
            )
            search.run(request.work / FOUND)
        write({"kind": "done"})
    except DatasetError as error:
        write({"kind": "error", "message": str(error)})
    except (RuntimeError, ValueError, OSError, MemoryError) as error:  # COLMAP's, by way of its binding
        text = " ".join(str(error).split())[:300].rstrip(".") or type(error).__name__
        message = f"COLMAP cannot find poses for {request.images} ({text}); look at the photographs."
        if request.lenses_of is not None:
            message = f"COLMAP cannot adjust the model in {request.lenses_of} ({text}); run COLMAP again."
        write({"kind": "error", "message": message})
    # Not by way of the interpreter's clean-up, in which a library may hang or crash after all is done.
    os._exit(0)


def _end_with_stdin() -> None:
    for _line in sys.stdin:
        pass
    os._exit(70)


if __name__ == "__main__":
    main()

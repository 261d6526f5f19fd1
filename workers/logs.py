"""Log lines of long-running processes on stderr."""

import logging
import os
import sys

_NOISY = ("procrastinate", "psycopg", "httpx", "httpcore")


def log_to_stderr() -> None:
    """Write warnings of libraries and all log lines of octasplat to stderr."""
    debug = os.environ.get("OCTASPLAT_DEBUG") == "1"
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname).1s %(name)s: %(message)s", "%H:%M:%S"))
    logging.basicConfig(level=logging.DEBUG if debug else logging.INFO, handlers=[handler], force=True)
    for name in _NOISY:
        # What becomes of jobs is said by ourselves.
        logging.getLogger(name).setLevel(logging.DEBUG if debug else logging.CRITICAL)
    logging.getLogger("psycopg.pool").setLevel(logging.ERROR)

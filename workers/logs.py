"""Log lines of long-running processes on stderr."""

import logging
import os
import sys
import time

REPEAT_SECONDS = 60.0
"""A message that everybody can cause is logged so often."""
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


class RepeatedMessages(logging.Filter):
    """Lets each message pass once a minute, and says then how often it came since."""

    def __init__(self) -> None:
        super().__init__()
        self._seen: dict[str, tuple[float, int]] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Return whether a record is logged."""
        message = str(record.msg)
        logged_at, count = self._seen.get(message, (-REPEAT_SECONDS, 0))
        if time.monotonic() - logged_at < REPEAT_SECONDS:
            self._seen[message] = logged_at, count + 1
            return False
        self._seen[message] = time.monotonic(), 0
        if count:
            record.msg, record.args = f"{record.getMessage()} ({count} more since the last time)", None
        return True

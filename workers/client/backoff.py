"""Back-off of a client while the service is unreachable: its waiting times and their limit."""

import random
import time

MAX_OUTAGE_SECONDS = 120.0
"""For so long a service may be away that has answered before, as while it is started again."""
MAX_FIRST_OUTAGE_SECONDS = 20.0
"""The same of one that has not: perhaps there is none. A restart takes less."""
FIRST_PAUSE_SECONDS = 0.3
MAX_PAUSE_SECONDS = 10.0


class Backoff:
    """Waits with growing pauses while the service is unreachable, up to a total time.

    Args:
        seconds: how long it may be away.
    """

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds
        self._since: float | None = None
        self._pause = FIRST_PAUSE_SECONDS

    def reset(self) -> None:
        """Forget earlier failures, as the service has answered."""
        self._since, self._pause = None, FIRST_PAUSE_SECONDS

    def wait(self, min_seconds: float = 0.0) -> bool:
        """Pause because the service is unreachable; returns False once the total time is used up.

        Args:
            min_seconds: how long it asks to be left alone, s.
        """
        now = time.monotonic()
        self._since = now if self._since is None else self._since
        left = self._since + self.seconds - now
        if left <= 0:
            return False
        # Not all who wait come back in the same moment.
        pause = min(self._pause * random.uniform(0.75, 1.25), MAX_PAUSE_SECONDS)  # noqa: S311
        time.sleep(min(max(pause, min_seconds), left))
        self._pause = min(2 * self._pause, MAX_PAUSE_SECONDS)
        return True

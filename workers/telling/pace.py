"""How long a stage that counts its steps will still take."""

import time


class Pace:
    """The time left of a stage, from how fast it has gone since it was first heard of."""

    def __init__(self) -> None:
        self._first: tuple[float, float] | None = None

    def left(self, done: float, total: float) -> float | None:
        """Seconds; None while nothing can be said.

        Args:
            done: steps, with the share of the one under way.
            total: steps in all.
        """
        now = time.monotonic()
        if self._first is None or done < self._first[0]:
            self._first = done, now
        begun, at = self._first
        return (now - at) / (done - begun) * (total - done) if done > begun else None

"""Estimate of the remaining time of a stage that counts its steps."""

import time


def work_of_stage(step: int, total_steps: int, part: float, work_done: float | None) -> tuple[float, float]:
    """Return the work of a stage that is done, and all of it.

    >>> work_of_stage(1, 4, 0.5, None)
    (1.5, 4.0)
    >>> work_of_stage(1, 4, 0.0, 0.9)
    (0.9, 1.0)

    Args:
        step: steps done.
        total_steps: steps in all.
        part: share of the step under way.
        work_done: share of the work that is done, where steps take very different times.
    """
    return (step + part, float(total_steps)) if work_done is None else (work_done, 1.0)


class TimeLeftEstimator:
    """Estimates the remaining time of a stage from its speed since its first report."""

    def __init__(self) -> None:
        self._first: tuple[float, float] | None = None

    def seconds_left(self, steps_done: float, total_steps: float) -> float | None:
        """Return the remaining seconds; None while there is no estimate.

        Args:
            steps_done: steps, with the share of the one under way.
            total_steps: steps in all.
        """
        now = time.monotonic()
        if self._first is None or steps_done < self._first[0]:
            self._first = steps_done, now
        begun, at = self._first
        return (now - at) / (steps_done - begun) * (total_steps - steps_done) if steps_done > begun else None

    def leave_out(self, seconds: float) -> None:
        """Do not count the last ``seconds``, in which something was done that is not done again."""
        if self._first is not None:
            begun, at = self._first
            self._first = begun, at + seconds

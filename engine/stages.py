"""The stages of the main job, announced when they begin and end, and the time that each took."""

import time
from collections.abc import Iterator
from contextlib import contextmanager

from engine.events import Listener, StageFinished, StageStarted


class StageClock:
    """The time of a stage, with that of runs before this one that were stopped in it."""

    def __init__(self) -> None:
        self._began = time.perf_counter()
        self._stopped: float | None = None

    def add(self, earlier_seconds: float) -> None:
        """Count seconds of an earlier run as well."""
        self._began -= earlier_seconds

    def seconds(self) -> float:
        """The seconds until now, or until it was stopped."""
        return time.perf_counter() - self._began if self._stopped is None else self._stopped

    def stop(self) -> float:
        """The seconds, which are the same from now on: a time told twice is to be one figure."""
        self._stopped = self.seconds()
        return self._stopped


@contextmanager
def stage(name: str, tell: Listener, steps: int = 0) -> Iterator[StageClock]:
    """Announce a stage; yields its clock, which is stopped at the end if it was not before."""
    tell(StageStarted(name, steps))
    clock = StageClock()
    yield clock
    tell(StageFinished(name, clock.stop()))

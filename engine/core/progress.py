"""The stages of long work, announced when they begin and end, and the time that each took."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Protocol, runtime_checkable

from octasplat.engine.core.errors import Cancelled
from octasplat.engine.core.events import Event, Listener, StageFinished, StageProgress, StageStarted

DOING = {
    "load": "Loading",
    "train": "Training",
    "evaluate": "Evaluating",
    "export": "Exporting",
    "generate": "Generating",
    "render": "Rendering",
    "edit": "Editing",
    "check": "Checking poses",
    "features": "Finding features",
    "matches": "Matching",
    "poses": "Finding poses",
    "placing": "Placing photographs anew",
    "lenses": "Adjusting the lens of each photograph",
    "upload": "Uploading",
    "download": "Downloading",
    "read": "Reading",
    "depth": "Rendering depth",
    "fusing": "Fusing depth",
    "meshing": "Meshing",
    "settling": "Settling",
    "decimating": "Decimating",
    "unwrapping": "Unwrapping",
    "colouring": "Colouring",
    "fitting": "Fitting colours",
}
"""What is being done at a stage, in a word or two."""


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


@runtime_checkable
class Count(Protocol):
    """Told how many steps of a stage are done, of how many, and what share of the next one."""

    def __call__(self, done: int, total: int, part: float = 0.0) -> None:
        """Hear it."""


@contextmanager
def counted_stage(name: str, tell: Listener, steps: int = 0) -> Iterator[Count]:
    """Announce a stage that counts; yields its progress callback."""

    def count(done: int, total: int, part: float = 0.0) -> None:
        tell(StageProgress(name, done, total, part))

    with stage(name, tell, steps):
        yield count


def stopping(listener: Listener, should_stop: Callable[[], bool], message: str | None = None) -> Listener:
    """``listener``, but stopping the work at its next event if so asked; training does it by itself.

    The returned listener raises :class:`octasplat.engine.core.errors.Cancelled` with ``message``, or one that
    names the stage.
    """

    def listen(event: Event) -> None:
        listener(event)
        if isinstance(event, StageProgress) and should_stop():
            doing = DOING.get(event.stage, event.stage).lower()
            told = f"Stopped while {doing}; the same command with --resume goes on."
            raise Cancelled(message or told)

    return listen

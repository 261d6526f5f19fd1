"""Phases of long work: events at their beginning and end, and the time each took."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Protocol, runtime_checkable

from octasplat.engine.core.errors import CancelledError
from octasplat.engine.core.events import Event, EventListener, PhaseFinished, PhaseProgress, PhaseStarted

PHASE_TITLES = {
    "load": "Loading",
    "train": "Training",
    "residual": "Fitting residual colors",
    "evaluate": "Evaluating",
    "export": "Exporting",
    "generate": "Generating",
    "frames": "Choosing frames",
    "render": "Rendering",
    "edit": "Editing",
    "simplify": "Simplifying",
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
    "settling": "Moving the vertices",
    "decimating": "Decimating",
    "unwrapping": "Unwrapping",
    "coloring": "Coloring",
    "fitting": "Fitting colors",
}
"""What is being done at a stage, in a word or two."""


class PhaseClock:
    """Clock of a phase; includes the time of earlier, interrupted runs."""

    def __init__(self) -> None:
        self._began = time.perf_counter()
        self._stopped: float | None = None

    def add(self, earlier_seconds: float) -> None:
        """Add the seconds of an earlier run."""
        self._began -= earlier_seconds

    def seconds(self) -> float:
        """Return the seconds until now, or until the clock was stopped."""
        return time.perf_counter() - self._began if self._stopped is None else self._stopped

    def stop(self) -> float:
        """Stop the clock and return its seconds; :meth:`seconds` returns the same figure from now on."""
        self._stopped = self.seconds()
        return self._stopped


@contextmanager
def phase(name: str, progress: EventListener, steps: int = 0) -> Iterator[PhaseClock]:
    """Run a phase: reports its beginning and end, and yields its clock."""
    progress(PhaseStarted(name, steps))
    clock = PhaseClock()
    yield clock
    # Not in a finally clause: a phase that raised an error has not finished.
    progress(PhaseFinished(name, clock.stop()))


@runtime_checkable
class ProgressCallback(Protocol):
    """Receives how many steps of a stage are done, of how many, and what share of the next one."""

    def __call__(self, done: int, total: int, part: float = 0.0) -> None:
        """Report progress.

        Args:
            done: steps that are done.
            total: steps of the stage.
            part: share of the next step that is done, from 0 to 1.
        """


def no_progress(done: int, total: int, part: float = 0.0) -> None:
    """Receive progress that nobody wants to know of."""


@contextmanager
def counted_phase(name: str, progress: EventListener, steps: int = 0) -> Iterator[ProgressCallback]:
    """Run a phase that counts its steps; yields its progress callback."""

    def count(done: int, total: int, part: float = 0.0) -> None:
        progress(PhaseProgress(name, done, total, part))

    with phase(name, progress, steps):
        yield count


def stop_when_asked(
    progress: EventListener, should_stop: Callable[[], bool], message: str | None = None
) -> EventListener:
    """Return ``progress`` with a check that stops the work when ``should_stop`` is true.

    It is made where a stage begins, and at each step of one that counts its steps; training, which has events
    of its own, stops by itself.

    The returned listener raises :class:`octasplat.engine.core.errors.CancelledError` with ``message``, or
    one that names the stage.
    """

    def listen(event: Event) -> None:
        progress(event)
        if isinstance(event, PhaseStarted | PhaseProgress) and should_stop():
            doing = PHASE_TITLES.get(event.stage, event.stage).lower()
            default_message = f"Stopped while {doing}; the same command with --resume goes on."
            raise CancelledError(message or default_message)

    return listen

"""The engine's events as lines of text."""

import time
from collections.abc import Callable

from octasplat.engine.core.durations import format_clock, format_duration
from octasplat.engine.core.events import (
    Event,
    HeldOutMeasured,
    KernelsCompiled,
    Noted,
    PhaseFinished,
    PhaseProgress,
    PhaseStarted,
    TrainingProgress,
    Warned,
)
from octasplat.engine.core.progress import PHASE_TITLES
from octasplat.workers.reporting.time_left import TimeLeftEstimator, work_of_stage
from octasplat.workers.reporting.wording import format_training_state

LINE_INTERVAL_SECONDS = 5.0
# What a finished stage did, and what its steps are; "" where nobody would want them counted.
_STAGE_RESULTS = {
    "load": ("Loaded", "photograph"),
    "train": ("Trained", "iteration"),
    "residual": ("Fitted residual colors", ""),
    "evaluate": ("Evaluated", "view"),
    "export": ("Exported", "file"),
    "generate": ("Generated", "photograph"),
    "render": ("Rendered", "image"),
    "edit": ("Edited", ""),
    "check": ("Checked the poses", ""),
    "features": ("Found features", "photograph"),
    "matches": ("Matched", "pair"),
    "poses": ("Found the poses of", "photograph"),
    "placing": ("Asked where the matches put", "photograph"),
    "lenses": ("Adjusted the lens of each photograph", ""),
    "upload": ("Uploaded", "kB"),
    "download": ("Downloaded", "kB"),
    "read": ("Read", "file"),
    "depth": ("Rendered", "depth map"),
    "fusing": ("Fused the depth maps", ""),
    "meshing": ("Made the mesh", ""),
    "unwrapping": ("Cut the mesh open for the texture", ""),
    "settling": ("Moved the vertices to where the pictures agree", ""),
    "decimating": ("Merged triangles", ""),
    "coloring": ("Colored", "point"),
    "fitting": ("Fitted the colors", ""),
}


class ProgressState:
    """State of the progress that both displays share."""

    def __init__(self) -> None:
        self.step = self.total = 0
        self.held_out: HeldOutMeasured | None = None
        self.training: TrainingProgress | None = None
        self.seconds_left: float | None = None
        self._pace = TimeLeftEstimator()

    def update(self, event: Event) -> None:
        """Update the state by ``event``."""
        if isinstance(event, PhaseStarted):
            self.step, self.total = 0, event.total_steps
            self.seconds_left, self._pace = None, TimeLeftEstimator()
        elif isinstance(event, PhaseProgress):
            self.step, self.total = event.step, event.total_steps
            self.seconds_left = self._pace.seconds_left(
                *work_of_stage(event.step, event.total_steps, event.part, event.work_done)
            )
        elif isinstance(event, TrainingProgress):
            self.step, self.training = event.iteration, event
        elif isinstance(event, HeldOutMeasured):
            self.held_out = event
        elif isinstance(event, KernelsCompiled):
            self._pace.leave_out(event.seconds)

    def finished_line(self, event: PhaseFinished) -> str:
        """Return what the stage did and how long it took, as a line."""
        verb, what = _STAGE_RESULTS.get(event.stage, (f"Finished {event.stage}", "step"))
        if event.stage == "poses":  # some may be left out
            count = f" {self.step:,} of {self.total:,} photographs"
        else:
            plural = "" if self.step == 1 or what == "kB" else "s"
            count = f" {self.step:,} {what}{plural}" if self.step and what else ""
        line = f"{verb}{count} in {format_duration(event.seconds)}"
        if event.stage == "train" and self.training is not None:
            line += f": {format_training_state(self.training, self.held_out)}"
        return line


class EventLines:
    """Writes a line at the start and end of a stage and every few seconds in between.

    Args:
        write: takes a line.
        interval_seconds: between two lines of one stage.
        warn: takes a warning; by default as any other line.
        note: takes a note; by default as any other line.
    """

    def __init__(
        self,
        write: Callable[[str], None],
        interval_seconds: float = LINE_INTERVAL_SECONDS,
        *,
        warn: Callable[[str], None] | None = None,
        note: Callable[[str], None] | None = None,
    ) -> None:
        self._write = write
        self._write_warning = warn or write
        self._write_note = note or write
        self._interval_seconds = interval_seconds
        self._next_at = 0.0
        self._last = ""
        self._state = ProgressState()

    def __call__(self, event: Event) -> None:
        """Write a line for ``event``, unless the last line is too recent."""
        self._state.update(event)
        if isinstance(event, PhaseStarted):
            self._write(PHASE_TITLES.get(event.stage, event.stage))
            self._next_at, self._last = time.monotonic() + self._interval_seconds, ""
        elif isinstance(event, PhaseFinished):
            self._write(self._state.finished_line(event))
        elif isinstance(event, Warned):
            self._write_warning(f"Warning: {event.message}")
        elif isinstance(event, Noted):
            self._write_note(event.message)
        elif isinstance(event, PhaseProgress | TrainingProgress) and time.monotonic() >= self._next_at:
            line = self._event_line(event)
            if line == self._last:  # a long step tells that it goes on, which is no news
                return
            self._next_at, self._last = time.monotonic() + self._interval_seconds, line
            self._write(line)

    def _event_line(self, event: PhaseProgress | TrainingProgress) -> str:
        if isinstance(event, PhaseProgress):
            left = self._state.seconds_left
            return f"  {event.step}/{event.total_steps}" + (
                "" if left is None else f", {format_clock(left)} left"
            )
        state = format_training_state(event, self._state.held_out)
        return (
            f"  {event.iteration}/{event.total_iterations}: {state}, {format_clock(event.seconds_left)} left"
        )

"""The engine's events as progress bars, or as plain lines where the output is no terminal."""

import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager

import click
from rich.console import Console, RenderableType
from rich.progress import BarColumn, Progress, TaskID, TextColumn
from rich.text import Text

from engine.errors import Cancelled
from engine.events import (
    Event,
    HeldOutMeasured,
    Listener,
    StageFinished,
    StageProgress,
    StageStarted,
    TrainingProgress,
    Warned,
)
from workers.wording import clock, duration, training_state

SECONDS_BETWEEN_LINES = 5.0
_STOPPING = "Stopping at the next safe point; press Ctrl-C again to stop at once."
_DOING = {
    "load": "Loading",
    "train": "Training",
    "evaluate": "Evaluating",
    "export": "Exporting",
    "generate": "Generating",
    "render": "Rendering",
    "features": "Finding features",
    "matches": "Matching",
    "poses": "Finding poses",
    "upload": "Uploading",
    "download": "Downloading",
    "read": "Reading",
    "depth": "Rendering depth",
    "fusing": "Fusing depth",
    "meshing": "Meshing",
    "unwrapping": "Unwrapping",
    "colouring": "Colouring",
}
# What a finished stage did, and what its steps are; "" where nobody would want them counted.
_DONE = {
    "load": ("Loaded", "photograph"),
    "train": ("Trained", "iteration"),
    "evaluate": ("Evaluated", "held-out view"),
    "export": ("Exported", "file"),
    "generate": ("Generated", "photograph"),
    "render": ("Rendered", "image"),
    "features": ("Found features", "photograph"),
    "matches": ("Matched", "pair"),
    "poses": ("Found the poses of", "photograph"),
    "upload": ("Uploaded", "kB"),
    "download": ("Downloaded", "kB"),
    "read": ("Read", "file"),
    "depth": ("Rendered", "depth map"),
    "fusing": ("Fused the depth maps", ""),
    "meshing": ("Made the mesh", ""),
    "unwrapping": ("Cut the mesh open for the texture", ""),
    "colouring": ("Coloured", "point"),
}


class _State:
    """What both displays remember of the events so far."""

    def __init__(self) -> None:
        self.step = self.total = 0
        self.held_out: HeldOutMeasured | None = None
        self.training: TrainingProgress | None = None

    def update(self, event: Event) -> None:
        if isinstance(event, StageStarted):
            self.step, self.total = 0, event.total_steps
        elif isinstance(event, StageProgress):
            self.step, self.total = event.step, event.total_steps
        elif isinstance(event, TrainingProgress):
            self.step, self.training = event.iteration, event
        elif isinstance(event, HeldOutMeasured):
            self.held_out = event

    def finished(self, event: StageFinished) -> str:
        verb, what = _DONE.get(event.stage, (f"Finished {event.stage}", "step"))
        if event.stage == "poses":  # some may be left out
            count = f" {self.step:,} of {self.total:,} photographs"
        else:
            plural = "" if self.step == 1 or what == "kB" else "s"
            count = f" {self.step:,} {what}{plural}" if self.step and what else ""
        line = f"{verb}{count} in {duration(event.seconds)}"
        if event.stage == "train" and self.training is not None:
            line += f": {training_state(self.training, self.held_out)}"
        return line


class PlainLines:
    """Writes a line at the start and end of a stage and every few seconds in between."""

    def __init__(self, write: Callable[[str], None], every_seconds: float = SECONDS_BETWEEN_LINES) -> None:
        self._write = write
        self._every = every_seconds
        self._next = 0.0
        self._state = _State()

    def __call__(self, event: Event) -> None:
        """Show ``event``, or leave it out if the last line is only a moment old."""
        self._state.update(event)
        if isinstance(event, StageStarted):
            self._write(_DOING.get(event.stage, event.stage))
            self._next = time.monotonic() + self._every
        elif isinstance(event, StageFinished):
            self._write(self._state.finished(event))
        elif isinstance(event, Warned):
            click.echo(f"Warning: {event.message}", err=True)
        elif isinstance(event, StageProgress | TrainingProgress) and time.monotonic() >= self._next:
            self._next = time.monotonic() + self._every
            self._write(self._line(event))

    def _line(self, event: StageProgress | TrainingProgress) -> str:
        if isinstance(event, StageProgress):
            return f"  {event.step}/{event.total_steps}"
        state = training_state(event, self._state.held_out)
        return f"  {event.iteration}/{event.total_iterations}: {state}, {clock(event.seconds_left)} left"


class _Bars(Progress):
    """A bar, and under it a line of details."""

    def __init__(self, console: Console, should_stop: Callable[[], bool]) -> None:
        self.detail = ""
        self._should_stop = should_stop
        super().__init__(
            TextColumn("{task.description:<10}"),
            BarColumn(),
            TextColumn("{task.fields[count]}"),
            TextColumn("{task.fields[left]}"),
            console=console,
            transient=True,
        )

    def get_renderables(self) -> Iterable[RenderableType]:
        """The bars of the running stage and the details."""
        yield self.make_tasks_table(self.tasks)
        if self._should_stop():
            yield Text(_STOPPING, style="yellow")
        elif self.detail:
            yield Text(f"{'':11}{self.detail}", style="dim")


class Bars:
    """Shows a bar for the running stage; finished stages leave one line each."""

    def __init__(self, console: Console, should_stop: Callable[[], bool]) -> None:
        self._console = console
        self._state = _State()
        self._task: TaskID | None = None
        self.bars = _Bars(console, should_stop)

    def __call__(self, event: Event) -> None:
        """Show ``event``."""
        self._state.update(event)
        if isinstance(event, StageStarted):
            self._begin(event)
        elif isinstance(event, StageProgress):
            self._move(event.step, event.total_steps)
        elif isinstance(event, TrainingProgress):
            self.bars.detail = training_state(event, self._state.held_out)
            self._move(event.iteration, event.total_iterations, f"{clock(event.seconds_left)} left")
        elif isinstance(event, StageFinished):
            self._end()
            self._print(self._state.finished(event))
        elif isinstance(event, Warned):
            self._print(f"Warning: {event.message}", style="yellow")

    def _begin(self, event: StageStarted) -> None:
        self._end()
        self._task = self.bars.add_task(
            _DOING.get(event.stage, event.stage), total=event.total_steps or None, count="", left=""
        )

    def _move(self, step: int, total: int, left: str = "") -> None:
        if self._task is not None:
            self.bars.update(self._task, completed=step, total=total, count=f"{step}/{total}", left=left)

    def _end(self) -> None:
        self.bars.detail = ""
        if self._task is not None:
            self.bars.remove_task(self._task)
            self._task = None
            self.bars.refresh()  # lest the next printed line brings the old bar back for a moment

    def _print(self, text: str, style: str = "") -> None:
        self._console.print(text, style=style, highlight=False, markup=False, soft_wrap=True)


@contextmanager
def show_progress(
    *, quiet: bool = False, should_stop: Callable[[], bool] = lambda: False
) -> Iterator[Listener]:
    """A listener that shows events for as long as the block runs.

    Args:
        quiet: show warnings only.
        should_stop: whether the user asked to stop, which the bar then acknowledges.
    """
    if quiet:
        yield PlainLines(lambda _line: None)
        return
    console = Console(file=sys.stdout)
    if not sys.stdout.isatty() or console.is_dumb_terminal:
        yield PlainLines(_echo)
        return
    display = Bars(console, should_stop)
    with display.bars:
        yield display


def stopping(listener: Listener, should_stop: Callable[[], bool]) -> Listener:
    """``listener``, but stopping the work at its next event if so asked; training does it by itself.

    The returned listener raises :class:`engine.errors.Cancelled`.
    """

    def listen(event: Event) -> None:
        listener(event)
        if isinstance(event, StageProgress) and should_stop():
            doing = _DOING.get(event.stage, event.stage).lower()
            raise Cancelled(f"Stopped while {doing}; the same command with --resume goes on.")

    return listen


@contextmanager
def staged(name: str, tell: Listener, steps: int = 0) -> Iterator[Callable[[int, int], None]]:
    """Announce a stage that is not the engine's; yields its progress callback (steps done, steps in all)."""
    tell(StageStarted(name, steps))
    began = time.monotonic()
    yield lambda done, total: tell(StageProgress(name, done, total))
    tell(StageFinished(name, time.monotonic() - began))


def _echo(line: str) -> None:
    click.echo(line)
    sys.stdout.flush()

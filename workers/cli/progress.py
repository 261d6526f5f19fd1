"""The engine's events as progress bars, or as plain lines where the output is no terminal."""

import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager

import click
from rich.console import Console, RenderableType
from rich.progress import BarColumn, Progress, TaskID, TextColumn
from rich.text import Text

from octasplat.engine.core.durations import format_clock
from octasplat.engine.core.events import (
    Event,
    EventListener,
    Noted,
    PhaseFinished,
    PhaseProgress,
    PhaseStarted,
    TrainingProgress,
    Warned,
)
from octasplat.engine.core.progress import PHASE_TITLES
from octasplat.workers.reporting.event_lines import EventLines, ProgressState
from octasplat.workers.reporting.wording import format_training_state

_STOPPING_TEXT = "Stopping at the next safe point; press Ctrl-C again to stop at once."


class _ProgressWithDetail(Progress):
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
        """Return the bars of the running stage and the details."""
        yield self.make_tasks_table(self.tasks)
        if self._should_stop():
            yield Text(_STOPPING_TEXT, style="yellow")
        elif self.detail:
            yield Text(f"{'':11}{self.detail}", style="dim")


class ProgressBars:
    """Shows a bar for the running stage; finished stages leave one line each."""

    def __init__(self, console: Console, should_stop: Callable[[], bool]) -> None:
        self._console = console
        self._state = ProgressState()
        self._task: TaskID | None = None
        self.bars = _ProgressWithDetail(console, should_stop)

    def __call__(self, event: Event) -> None:
        """Update the progress bars by ``event``."""
        self._state.update(event)
        if isinstance(event, PhaseStarted):
            self._start_task(event)
        elif isinstance(event, PhaseProgress):
            left = self._state.seconds_left
            self._advance(
                event.step,
                event.total_steps,
                "" if left is None else f"{format_clock(left)} left",
                event.part,
            )
        elif isinstance(event, TrainingProgress):
            self.bars.detail = format_training_state(event, self._state.held_out)
            self._advance(event.iteration, event.total_iterations, f"{format_clock(event.seconds_left)} left")
        elif isinstance(event, PhaseFinished):
            self._end_task()
            self._print(self._state.finished_line(event))
        elif isinstance(event, Warned):
            self._print(f"Warning: {event.message}", style="yellow")
        elif isinstance(event, Noted):
            self._print(event.message, style="dim")

    def _start_task(self, event: PhaseStarted) -> None:
        self._end_task()
        self._task = self.bars.add_task(
            PHASE_TITLES.get(event.stage, event.stage), total=event.total_steps or None, count="", left=""
        )

    def _advance(self, step: int, total: int, time_left: str = "", step_fraction: float = 0.0) -> None:
        if self._task is not None:
            done, count = step + step_fraction, f"{step}/{total}"
            self.bars.update(self._task, completed=done, total=total, count=count, left=time_left)

    def _end_task(self) -> None:
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
) -> Iterator[EventListener]:
    """Yield a listener that shows events for as long as the block runs.

    Args:
        quiet: show warnings only.
        should_stop: whether the user asked to stop, which the bar then acknowledges.
    """
    if quiet:
        yield EventLines(lambda _line: None, warn=_write_error_line)
        return
    console = Console(file=sys.stdout)
    if not sys.stdout.isatty() or console.is_dumb_terminal:
        yield EventLines(_write_line, warn=_write_error_line, note=_write_error_line)
        return
    display = ProgressBars(console, should_stop)
    with display.bars:
        yield display


def _write_line(line: str) -> None:
    click.echo(line)
    sys.stdout.flush()


def _write_error_line(line: str) -> None:
    click.echo(line, err=True)

"""Progress and results for notebooks: a bar and small tables; elsewhere, log lines."""

import html
import logging
import sys
import time
from collections.abc import Mapping
from typing import Any

from octasplat.engine.core.events import (
    Event,
    EventListener,
    Noted,
    PhaseFinished,
    PhaseProgress,
    TrainingProgress,
    Warned,
)
from octasplat.workers.reporting.event_lines import EventLines

LOGGER = logging.getLogger("octasplat")
UPDATE_INTERVAL_SECONDS = 0.5
_MAX_SHOWN_LINES = 12


def log_event(event: Event) -> None:
    """Log an event of quick work: warnings as such, notes as information, anything else for debugging."""
    if isinstance(event, Warned):
        LOGGER.warning("%s", event.message)
    elif isinstance(event, Noted):
        LOGGER.info("%s", event.message)
    else:
        LOGGER.debug("%s", event)


def default_progress() -> EventListener:
    """Return what shows events where nobody says how: in the cell of a notebook, or else in the log."""
    return NotebookProgress() if in_notebook() else ProgressLog()


class ProgressLog:
    """Logs events as lines: stages as they begin and end, and every few seconds how far they are."""

    def __init__(self) -> None:
        self._lines = EventLines(LOGGER.info, warn=_log_warning)

    def __call__(self, event: Event) -> None:
        """Log the line of ``event``, if it has one."""
        self._lines(event)


def _log_warning(text: str) -> None:
    LOGGER.warning("%s", text.removeprefix("Warning: "))


def in_notebook() -> bool:
    """Return whether a notebook's kernel runs this process."""
    # Looked up, not imported: where nobody has loaded IPython there is no notebook.
    ipython = sys.modules.get("IPython")
    shell = None if ipython is None else ipython.get_ipython()
    return getattr(shell, "kernel", None) is not None


class NotebookProgress:
    """Shows events in the output of a notebook's cell: finished stages as lines, the running one with a bar.

    It may be called from another thread than the cell's.
    """

    def __init__(self) -> None:
        self._lines: list[str] = []
        # Only the beginnings and ends of stages; the bar shows what is between them.
        self._stage = EventLines(self._lines.append, interval_seconds=float("inf"))
        self._share: float | None = None
        self._next = 0.0
        self._handle: Any = None

    def __call__(self, event: Event) -> None:
        """Update the progress display by ``event``."""
        self._stage(event)
        if isinstance(event, PhaseProgress):
            self._share = (event.step + event.part) / event.total_steps if event.total_steps else None
        elif isinstance(event, TrainingProgress):
            self._share = event.iteration / event.total_iterations
        elif isinstance(event, PhaseFinished):
            self._share = None
        now = time.monotonic()
        # Ends and warnings are shown at once; of the others there may be hundreds in a second.
        if now >= self._next or isinstance(event, PhaseFinished | Warned):
            self._next = now + UPDATE_INTERVAL_SECONDS
            self._update()

    def _update(self) -> None:
        from IPython.display import HTML, display

        content = HTML(self.html())
        if self._handle is None:
            self._handle = display(content, display_id=True)
        else:
            self._handle.update(content)

    def html(self) -> str:
        """Return what is shown."""
        bar = "" if self._share is None else f'<progress value="{self._share:.4f}" max="1"></progress>'
        lines = "<br>".join(html.escape(line) for line in self._lines[-_MAX_SHOWN_LINES:])
        return f"<div>{lines}<br>{bar}</div>"


def table_html(title: str, rows: Mapping[str, object]) -> str:
    """Return a small table with a row for each entry; values are escaped."""
    body = "".join(
        f"<tr><th style='text-align:left'>{html.escape(name)}</th><td>{html.escape(str(value))}</td></tr>"
        for name, value in rows.items()
    )
    return f"<table><caption>{html.escape(title)}</caption>{body}</table>"

"""Typed progress events, written as JSON lines and displayed by listeners.

The engine emits events; progress bars, ``events.jsonl`` and the web pages listen. This module imports neither
torch nor numba, so that a front end can use it.
"""

import json
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import MISSING, asdict, dataclass, fields
from pathlib import Path
from typing import IO, Any, ClassVar

from octasplat.engine.core.writing import report_disk_full


@dataclass(frozen=True)
class Event:
    """Base of all events; ``kind`` names the event in ``events.jsonl``."""

    kind: ClassVar[str] = "event"

    def as_dict(self) -> dict[str, object]:
        """Return the event as JSON-ready values, including its kind."""
        return {"kind": self.kind, **asdict(self)}


@dataclass(frozen=True)
class PhaseStarted(Event):
    """A stage of a job begins; a reconstruction has ``load``, ``train``, ``evaluate`` and ``export``.

    One that fits residual colors has ``residual`` after ``train``.
    """

    kind: ClassVar[str] = "stage_started"
    stage: str
    total_steps: int = 0


@dataclass(frozen=True)
class PhaseProgress(Event):
    """Step ``step`` of a stage that counts its steps is done, and the share ``part`` of the next one.

    Where steps take very different times, ``work_done`` is the share of the stage's work that is done.
    """

    kind: ClassVar[str] = "stage_progress"
    stage: str
    step: int
    total_steps: int
    part: float = 0.0
    work_done: float | None = None


@dataclass(frozen=True)
class PhaseFinished(Event):
    """A stage ended after ``seconds``."""

    kind: ClassVar[str] = "stage_finished"
    stage: str
    seconds: float


@dataclass(frozen=True)
class TrainingProgress(Event):
    """State of the training after ``iteration``; ``psnr`` is the running value over training rays, in dB.

    ``seconds_left`` is until there is a scene; ``seconds_after`` of it are for residual colors, whose stage
    follows.
    """

    kind: ClassVar[str] = "training_progress"
    iteration: int
    total_iterations: int
    loss: float
    psnr: float
    gaussians: int
    rays_per_second: float
    hits_per_ray: float
    seconds: float
    seconds_left: float
    seconds_after: float = 0.0


@dataclass(frozen=True)
class HeldOutMeasured(Event):
    """PSNR of rays spread over the held-out views at ``iteration``, their errors pooled, in dB."""

    kind: ClassVar[str] = "held_out_measured"
    iteration: int
    psnr: float
    gaussians: int
    seconds: float


@dataclass(frozen=True)
class CheckpointWritten(Event):
    """A checkpoint of ``iteration``, or of that many images of a render, is stored at ``path``."""

    kind: ClassVar[str] = "checkpoint_written"
    iteration: int
    path: str


@dataclass(frozen=True)
class ImagesSaved(Event):
    """``count`` images of a render are stored; a resumed render continues with the others."""

    kind: ClassVar[str] = "images_kept"
    count: int


@dataclass(frozen=True)
class Warned(Event):
    """A warning for the user, in one sentence; the work continues."""

    kind: ClassVar[str] = "warning"
    message: str


@dataclass(frozen=True)
class Noted(Event):
    """A line for the log, in one sentence, that needs no attention."""

    kind: ClassVar[str] = "note"
    message: str


@dataclass(frozen=True)
class KernelsCompiled(Event):
    """Kernels were compiled, or waited for, which took ``seconds``; no pace is estimated from these."""

    kind: ClassVar[str] = "kernels_compiled"
    seconds: float


@dataclass(frozen=True)
class RunFinished(Event):
    """The whole job is done; ``outputs`` are paths relative to the output folder."""

    kind: ClassVar[str] = "run_finished"
    outputs: tuple[str, ...]
    seconds: float


EVENT_KINDS: dict[str, type[Event]] = {
    event.kind: event
    for event in (
        PhaseStarted,
        PhaseProgress,
        PhaseFinished,
        TrainingProgress,
        HeldOutMeasured,
        CheckpointWritten,
        ImagesSaved,
        Warned,
        Noted,
        KernelsCompiled,
        RunFinished,
    )
}

EventListener = Callable[[Event], None]


def parse_event(kind: str, content: Mapping[str, Any]) -> Event | None:
    """Return the event that was written as JSON; None for an unknown kind or missing fields.

    >>> parse_event("stage_finished", {"stage": "train", "seconds": 12.5})
    PhaseFinished(stage='train', seconds=12.5)
    >>> parse_event("stage_finished", {"stage": "train"}) is None
    True
    """
    model = EVENT_KINDS.get(kind)
    if model is None or not {f.name for f in fields(model) if f.default is MISSING} <= content.keys():
        return None
    given = {field.name: content[field.name] for field in fields(model) if field.name in content}
    # JSON has lists where events have tuples.
    return model(
        **{name: tuple(value) if isinstance(value, list) else value for name, value in given.items()}
    )


def ignore_events(_event: Event) -> None:
    """Discard an event: the listener of callers who want no progress."""


def broadcast(listeners: Iterable[EventListener]) -> EventListener:
    """Return a listener that passes every event on to ``listeners``, in order."""
    targets = tuple(listeners)

    def send(event: Event) -> None:
        for listener in targets:
            listener(event)

    return send


def read_events(path: Path) -> list[dict[str, object]]:
    """Return the rows of an event file, without an incomplete last line; empty if there is no file."""
    rows = []
    if path.exists():
        for line in path.read_text(encoding="utf-8").splitlines():
            try:
                rows.append(json.loads(line))
            except ValueError:
                continue  # a run that was killed and resumed goes on after a line cut short
    return rows


class JsonLinesWriter:
    """Appends each event, stamped with Unix time in seconds, as one line to a file.

    Args:
        path: the file.
        hold: leave the file as it is, and keep the events, until :meth:`release` is called.
    """

    def __init__(self, path: Path, *, hold: bool = False) -> None:
        self._path = path
        self._held: list[str] = []
        self._file: IO[str] | None = None
        if not hold:
            self.release()

    def release(self) -> None:
        """Write the events that were held back, and from now on each event at once."""
        if self._file is not None:
            return
        self._path.parent.mkdir(parents=True, exist_ok=True)
        self._file = self._path.open("a", encoding="utf-8")
        if self._file.tell() and not self._path.read_bytes().endswith(b"\n"):
            self._file.write("\n")  # a kill cut the last line short; the next event begins a new one
        self._write("".join(self._held))

    def __call__(self, event: Event) -> None:
        """Write ``event`` and flush, so that a reader beside the run sees whole lines.

        Raises:
            DiskFullError: there is no room for it.
        """
        line = json.dumps({"time": round(time.time(), 3), **event.as_dict()}) + "\n"
        if self._file is None:
            self._held.append(line)
        else:
            self._write(line)

    def close(self) -> None:
        """Close the file; the listener must not be called afterwards."""
        if self._file is not None:
            with suppress(OSError):  # what could not be written was told when it was to be
                self._file.close()

    def _write(self, text: str) -> None:
        assert self._file is not None
        with report_disk_full(self._path):
            self._file.write(text)
            self._file.flush()

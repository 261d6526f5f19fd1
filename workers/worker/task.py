"""Input of a job's program, and its transfer into the child process."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from octasplat.engine.core.events import Event, EventListener, ignore_events

RUN_FOLDER, RESULTS_FOLDER, FILES_FOLDER = "run", "results", "files"
"""Folders of an attempt: the engine's output, what is to be published, files that are named."""

SCENE_FILE, CONFIG_FILE = "scene.ply", "config.json"
"""Results that tell a scene, and that it is one of a run."""

FRAMES_FOLDER = "frames"
"""In the engine's output, images of a render that are done; they are kept for later attempts."""

MOVED_RESULTS_FILE = "moved_results.json"
"""In an attempt's folder, the results that are stored already and were removed from it."""

INFO_FILE = "info.json"
"""The result that tells what is in a scene."""

BLOCKS_FOLDER = "blocks"
"""The plan of a scene in blocks and its pieces, in the engine's output folder."""

POSES_FOLDER = "poses"
"""Poses that the engine found, in its output folder and among the results."""

NO_SPACE_ERROR = "no_space"
"""Type of the error of a job that met a full disk, which is no fault of its own."""
MAX_BLOCKS = 10_000
"""As many as may be asked for."""
EXIT_REFUSED = 1
"""The job cannot be done and another try would end the same way; the last line says why."""
EXIT_UNEXPECTED = 70
"""A fault of the program."""
EXIT_STOPPED = 75
"""Stopped as asked; what is needed to go on is in the folder."""


@dataclass(frozen=True)
class BlocksPlanned(Event):
    """A job has planned its blocks and ends; it is begun again when these are trained.

    Attributes:
        numbers: of the blocks to be trained by jobs of their own.
        iterations: of each.
        first_iterations: those before the blocks, which are done.
        total_iterations: of the whole job.
        disk_bytes: that the training of each takes beside what it begins with; empty where that is not known.
    """

    kind: ClassVar[str] = "blocks_planned"
    numbers: tuple[int, ...]
    iterations: tuple[int, ...]
    first_iterations: int
    total_iterations: int
    disk_bytes: tuple[int, ...] = ()


def read_planned_blocks(event: Mapping[str, Any]) -> BlocksPlanned | None:
    """Return the blocks that a program says it has planned; None where what it says is no plan."""
    try:
        numbers, iterations = ([int(n) for n in event[name]] for name in ("numbers", "iterations"))
        first, total = int(event["first_iterations"]), int(event["total_iterations"])
        disk_bytes = [int(n) for n in event.get("disk_bytes", ())]
    except (KeyError, TypeError, ValueError, OverflowError):
        return None
    is_plausible = 0 < len(numbers) == len(set(numbers)) == len(iterations) <= MAX_BLOCKS
    amounts = (first, total, *numbers, *iterations)
    if not is_plausible or not all(0 <= amount < 2**31 for amount in amounts):
        return None
    if len(disk_bytes) not in (0, len(numbers)) or not all(0 <= n < 2**53 for n in disk_bytes):
        return None
    return BlocksPlanned(tuple(numbers), tuple(iterations), first, total, tuple(disk_bytes))


def read_block_positions(event: Mapping[str, Any]) -> dict[str, tuple[float, float]]:
    """Return where blocks are on a preview by their numbers; empty where a program does not say so."""
    try:
        found = {str(int(number)): (float(x), float(y)) for number, x, y in event.get("block_positions", ())}
    except (TypeError, ValueError, OverflowError):
        return {}
    is_plausible = len(found) <= MAX_BLOCKS and all(0 <= place <= 1 for xy in found.values() for place in xy)
    return found if is_plausible else {}


def read_block_gaussians(event: Mapping[str, Any]) -> list[int] | None:
    """Return how many Gaussians of a live scene are of each block; None where a program does not say so."""
    try:
        counts = [int(count) for count in event.get("block_gaussians", ())]
    except (TypeError, ValueError, OverflowError):
        return None
    is_plausible = 0 < len(counts) <= MAX_BLOCKS and all(0 <= count < 2**31 for count in counts)
    return counts if is_plausible and sum(counts) == event.get("gaussians") else None


@dataclass(frozen=True)
class Task:
    """One job, as its program sees it.

    Attributes:
        folder: the attempt's own folder; ``folder / RUN_FOLDER`` holds the source job's results, or what an
            earlier attempt left to go on from.
        options: complete options, as JSON values.
        scene: folder of the photographs, or None.
        title: what the user calls the photographs.
        threads: to use; 0 means all cores.
        progress: receives the progress events.
        should_stop: asked now and then; True asks to stop with what is needed to go on.
        kind: name of the job's kind.
        begins_with: the run of another job that a new run begins with, or None; what an earlier attempt left
            has its own copy of it.
        requested: the options as they were asked for, as JSON values; None where that is not known.
    """

    folder: Path
    options: Mapping[str, Any]
    scene: Path | None = None
    title: str = ""
    threads: int = 0
    progress: EventListener = ignore_events
    should_stop: Callable[[], bool] = field(default=lambda: False)
    kind: str = ""
    begins_with: Path | None = None
    requested: Mapping[str, Any] | None = None

    @property
    def run(self) -> Path:
        """Return the engine's output folder."""
        return self.folder / RUN_FOLDER

    @property
    def source(self) -> Path:
        """Return the source job's results as a run, or, where they are not a complete run, its scene file."""
        return self.run if (self.run / CONFIG_FILE).exists() else self.run / SCENE_FILE

    @property
    def files(self) -> Path:
        """Return the folder of the files that the options name; they must not be changed."""
        return self.folder / FILES_FOLDER

    @property
    def results(self) -> Path:
        """Return the folder of the files to publish; it is created when first used."""
        folder = self.folder / RESULTS_FOLDER
        folder.mkdir(exist_ok=True)
        return folder

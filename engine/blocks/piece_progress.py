"""Progress of the trainings of a run in blocks, told as that of one training."""

from dataclasses import replace

from octasplat.engine.blocks.scene_plan import FINISH
from octasplat.engine.core.events import (
    CheckpointWritten,
    Event,
    EventListener,
    HeldOutMeasured,
    TrainingProgress,
)


class PieceProgress:
    """Tell the iterations of each piece as a part of all, and the time left for all pieces.

    Args:
        progress: receives the events.
    """

    def __init__(self, progress: EventListener) -> None:
        self._progress = progress
        self._iterations: dict[str, int] = {}
        self._seconds_done = 0.0
        self._last = ("", 0.0)

    def expect(self, iterations: dict[str, int]) -> None:
        """Set how many iterations the pieces take, in their order."""
        self._iterations = iterations

    @property
    def total(self) -> int:
        """Return the iterations of all pieces."""
        return sum(self._iterations.values())

    def of_piece(self, name: str, *, other_gaussians: int = 0) -> EventListener:
        """Return the listener of one piece.

        Args:
            name: of the piece.
            other_gaussians: of the whole scene, those that the piece does not train; told with its own.
        """

        def listen(event: Event) -> None:
            if isinstance(event, HeldOutMeasured):
                if name != FINISH:
                    return  # of the coarse scene alone, at another size
                event = replace(
                    event,
                    iteration=self._iterations_before(name) + event.iteration,
                    seconds=self._seconds_before(name) + event.seconds,
                )
            if isinstance(event, TrainingProgress):
                event = self._translate(name, event)
                event = replace(event, gaussians=event.gaussians + other_gaussians)
            elif isinstance(event, CheckpointWritten):
                event = replace(event, iteration=self._iterations_before(name) + event.iteration)
            self._progress(event)

        return listen

    def _iterations_before(self, name: str) -> int:
        names = list(self._iterations)
        return sum(self._iterations[other] for other in names[: names.index(name)])

    def _seconds_before(self, name: str) -> float:
        last_name, last_seconds = self._last
        return self._seconds_done + (last_seconds if last_name != name else 0.0)

    def _translate(self, name: str, event: TrainingProgress) -> TrainingProgress:
        """Return the progress of a piece as that of all."""
        names = list(self._iterations)
        place = names.index(name)
        counts = list(self._iterations.values())
        before, after = self._iterations_before(name), sum(counts[place + 1 :])
        left_here = event.total_iterations - event.iteration
        pace_s = event.seconds_left / left_here if left_here else event.seconds / max(event.iteration, 1)
        self._seconds_done = self._seconds_before(name)
        self._last = (name, event.seconds)
        return replace(
            event,
            iteration=before + event.iteration,
            total_iterations=before + event.total_iterations + after,
            seconds=self._seconds_done + event.seconds,
            seconds_left=event.seconds_left + pace_s * after,
        )

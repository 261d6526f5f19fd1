"""Frames of a render job that are stored while it runs, so that another attempt goes on from them."""

import time

from octasplat.engine.core.events import CheckpointWritten, Event, EventListener, ImagesSaved
from octasplat.workers.worker.task import FRAMES_FOLDER

FRAME_CHECKPOINT_SECONDS = 5.0
SECONDS_PER_FRAME = 0.03
"""Finished frames are stored so long after one another, or so long for each of them if that is longer."""


class FrameCheckpoints:
    """Passes events on, and asks for finished frames to be stored, not too often.

    Args:
        progress: hears the other events, and :class:`CheckpointWritten` where frames are to be stored.
    """

    def __init__(self, progress: EventListener) -> None:
        self._listener = progress
        self._count = self._stored = 0
        self._next_at = 0.0

    def __call__(self, event: Event) -> None:
        """Forward an event; saved images may trigger a checkpoint."""
        if not isinstance(event, ImagesSaved):
            self._listener(event)
            return
        self._count = event.count
        if time.monotonic() >= self._next_at:
            self.request_checkpoint()

    def request_checkpoint(self) -> None:
        """Ask for the frames to be stored now, if there are new ones."""
        if self._count > self._stored:
            self._listener(CheckpointWritten(self._count, FRAMES_FOLDER))
            self._stored = self._count
        # All their names are written each time.
        self._next_at = time.monotonic() + max(FRAME_CHECKPOINT_SECONDS, SECONDS_PER_FRAME * self._count)

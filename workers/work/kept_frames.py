"""Frames of a render job that are stored while it runs, so that another attempt goes on from them."""

import time

from octasplat.engine.events import CheckpointWritten, Event, ImagesKept, Listener
from octasplat.workers.work.task import FRAMES

KEEP_SECONDS = 5.0
KEEP_SECONDS_OF_FRAME = 0.03
"""Finished frames are stored so long after one another, or so long for each of them if that is longer."""


class KeptFrames:
    """Passes events on, and asks for finished frames to be stored, not too often.

    Args:
        listener: hears the other events, and :class:`CheckpointWritten` where frames are to be stored.
    """

    def __init__(self, listener: Listener) -> None:
        self._listener = listener
        self._count = self._stored = 0
        self._due = 0.0

    def __call__(self, event: Event) -> None:
        """Take an event."""
        if not isinstance(event, ImagesKept):
            self._listener(event)
            return
        self._count = event.count
        if time.monotonic() >= self._due:
            self.store()

    def store(self) -> None:
        """Ask for the frames to be stored now, if there are new ones."""
        if self._count > self._stored:
            self._listener(CheckpointWritten(self._count, FRAMES))
            self._stored = self._count
        # All their names are written each time.
        self._due = time.monotonic() + max(KEEP_SECONDS, KEEP_SECONDS_OF_FRAME * self._count)

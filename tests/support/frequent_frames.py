"""Renders that take their time, and whose finished frames are stored at once, not every few seconds."""

import time

from octasplat.engine.core.events import Event, ImagesSaved
from octasplat.workers.worker import frame_checkpoints
from octasplat.workers.worker.job_kinds import image_kinds

FRAME_SECONDS = 0.5


class SlowFrameCheckpoints(frame_checkpoints.FrameCheckpoints):
    """Stores each frame, and waits a while after it."""

    def __call__(self, event: Event) -> None:
        super().__call__(event)
        if isinstance(event, ImagesSaved):
            time.sleep(FRAME_SECONDS)


frame_checkpoints.FRAME_CHECKPOINT_SECONDS = frame_checkpoints.SECONDS_PER_FRAME = 0.0
image_kinds.FrameCheckpoints = SlowFrameCheckpoints  # type: ignore[misc]

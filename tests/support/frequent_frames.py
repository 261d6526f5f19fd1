"""Renders whose finished frames are stored at once, not every few seconds."""

from octasplat.workers.worker import frame_checkpoints

frame_checkpoints.FRAME_CHECKPOINT_SECONDS = frame_checkpoints.SECONDS_PER_FRAME = 0.0

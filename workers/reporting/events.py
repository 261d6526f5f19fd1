"""Conversion between the engine's events and the stored ones."""

from collections.abc import Mapping
from typing import Any

from octasplat.engine.core.events import EVENT_KINDS, Event, PhaseProgress, TrainingProgress, parse_event

EVENT_STREAM_KINDS = frozenset({"progress", *EVENT_KINDS})


def decode_event(kind: str, data: Mapping[str, Any]) -> Event | None:
    """Return the event; None if it is none of the engine's, or of another version.

    Args:
        kind: of the event; ``progress`` stands for that of the training and that of any other stage.
        data: its fields, and perhaps others.
    """
    if kind == "progress":
        kind = TrainingProgress.kind if "iteration" in data else PhaseProgress.kind
    if kind == TrainingProgress.kind and "training_psnr" in data:
        data = {**data, "psnr": data["training_psnr"]}
    return parse_event(kind, data)


def encode_training_progress(event: Mapping[str, Any]) -> dict[str, Any]:
    """Return a training's progress as the event log stores it, with ``training_psnr`` for its rays."""
    data = {key: value for key, value in event.items() if key != "kind"}
    return {**data, "training_psnr": data["psnr"]}

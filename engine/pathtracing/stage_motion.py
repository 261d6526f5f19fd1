"""The stage of one image of a film in which things and lamps move by keys.

Between two keys what they give changes evenly; before the first and after the last it rests.
"""

from collections.abc import Sequence
from typing import Any, TypeVar

from octasplat.engine.pathtracing.stage.base import StageModel
from octasplat.engine.pathtracing.stage.model import Stage
from octasplat.engine.pathtracing.stage.motion import MotionKey, unit_direction

MovingT = TypeVar("MovingT", bound=StageModel)


def is_moving(stage: Stage) -> bool:
    """Return whether anything in a stage has keys."""
    return any(part.keys for part in (*stage.meshes, *stage.lights))


def stage_at(stage: Stage, frame: int) -> Stage:
    """Return the stage of one image, in which nothing has keys any more.

    Args:
        stage: with or without keys.
        frame: number of the image, from 0.
    """
    return stage.model_copy(
        update={
            "meshes": tuple(_placed_at(mesh, mesh.keys, frame) for mesh in stage.meshes),
            "lights": tuple(_placed_at(light, light.keys, frame) for light in stage.lights),
        }
    )


def _placed_at(part: MovingT, keys: Sequence[MotionKey], frame: int) -> MovingT:
    changes: dict[str, Any] = {"keys": ()}
    for name in ("position", "direction", "turn_degrees"):
        given = [(key.frame, getattr(key, name)) for key in keys if name in key.moved]
        if not given:
            continue
        if name == "turn_degrees":
            changes[name] = _between([(number, (value,)) for number, value in given], frame)[0]
        else:
            even = unit_direction if name == "direction" else tuple
            changes[name] = _between([(number, even(value)) for number, value in given], frame)
    return part.model_copy(update=changes)


def _between(given: Sequence[tuple[int, tuple[float, ...]]], frame: int) -> tuple[float, ...]:
    """Return what lies between the values before and after a frame; those of the ends beyond them."""
    before = max((each for each in given if each[0] <= frame), default=given[0])
    after = min((each for each in given if each[0] >= frame), default=given[-1])
    if before[0] >= after[0]:
        return before[1] if frame >= before[0] else after[1]
    share = (frame - before[0]) / (after[0] - before[0])
    return tuple(a + share * (b - a) for a, b in zip(before[1], after[1], strict=True))

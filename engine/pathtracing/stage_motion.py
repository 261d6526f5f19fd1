"""The stage of one image of a film in which things and lamps move by keys.

Between two keys what they give changes evenly; before the first and after the last it rests.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

from octasplat.engine.pathtracing.stage.base import StageModel
from octasplat.engine.pathtracing.stage.model import Stage
from octasplat.engine.pathtracing.stage.motion import MotionKey, unit_direction

MovingT = TypeVar("MovingT", bound=StageModel)
Values = tuple[float, ...]
_SMALL_ANGLE = 1e-6
"""Half of an angle, in radians, below which its sine is the angle itself."""


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
        elif name == "direction":
            units = [(number, unit_direction(value)) for number, value in given]
            changes[name] = _between(units, frame, _turned)
        else:
            changes[name] = _between([(number, tuple(value)) for number, value in given], frame)
    return part.model_copy(update=changes)


def _mixed(one: Values, other: Values, share: float) -> Values:
    """Return what lies a share of the way from one place or angle to another."""
    return tuple(a + share * (b - a) for a, b in zip(one, other, strict=True))


def _turned(one: Values, other: Values, share: float) -> Values:
    """Return the direction a share of the angle from one unit direction to another, which is not opposite."""
    half_angle = math.atan2(math.dist(one, other), math.dist(one, [-value for value in other]))
    if half_angle < _SMALL_ANGLE:
        return _mixed(one, other, share)
    from_one, from_other = math.sin(2 * half_angle * (1 - share)), math.sin(2 * half_angle * share)
    return unit_direction([from_one * a + from_other * b for a, b in zip(one, other, strict=True)])


def _between(
    given: Sequence[tuple[int, Values]],
    frame: int,
    mix: Callable[[Values, Values, float], Values] = _mixed,
) -> Values:
    """Return what lies between the values before and after a frame; those of the ends beyond them."""
    before = max((each for each in given if each[0] <= frame), default=given[0])
    after = min((each for each in given if each[0] >= frame), default=given[-1])
    if before[0] >= after[0]:
        return before[1] if frame >= before[0] else after[1]
    return mix(before[1], after[1], (frame - before[0]) / (after[0] - before[0]))

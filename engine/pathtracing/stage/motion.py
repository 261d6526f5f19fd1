"""Keys of things and lamps that move in a film, and the stage of one image of it.

Between two keys what they give changes evenly; before the first and after the last it rests. Imports neither
torch nor numba.
"""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

from pydantic import Field, model_validator

from octasplat.engine.pathtracing.stage.base import Finite, StageModel, Vector

if TYPE_CHECKING:
    from octasplat.engine.pathtracing.stage.model import Stage

MAX_KEYS = 1000
_LEAST_SUM = 1e-3
"""Length of the sum of two unit directions below which they are taken as opposite."""


class MotionKey(StageModel):
    """What something has in one image; what a key leaves out moves as the other keys say.

    Attributes:
        frame: number of the image, from 0.
        position: as that of the thing or lamp.
    """

    frame: Annotated[int, Field(ge=0)]
    position: Vector | None = None

    @model_validator(mode="after")
    def _check_given(self) -> "MotionKey":
        if not self.moved:
            names = [f"`{name}`" for name in type(self).model_fields if name != "frame"]
            raise ValueError(f"the key moves nothing; give {' or '.join(names)}")
        return self

    @property
    def moved(self) -> tuple[str, ...]:
        """Return the names of what the key gives."""
        names = tuple(name for name in type(self).model_fields if name != "frame")
        return tuple(name for name in names if getattr(self, name) is not None)


class MeshKey(MotionKey):
    """Where a mesh is in one image.

    Attributes:
        turn_degrees: as that of the mesh; from 0 to 360 it turns once round.
    """

    turn_degrees: Finite | None = None


class LightKey(MotionKey):
    """Where a lamp is in one image.

    Attributes:
        direction: as that of the lamp.
    """

    direction: Vector | None = None

    @model_validator(mode="after")
    def _check_direction(self) -> "LightKey":
        if self.direction is not None and not any(self.direction):
            raise ValueError("the direction has no length")
        return self


MovingT = TypeVar("MovingT", bound=StageModel)
KeyT = TypeVar("KeyT", bound=MotionKey)
Keys = Annotated[tuple[KeyT, ...], Field(max_length=MAX_KEYS)]


def check_keys(keys: Sequence[MotionKey], movable: Sequence[str]) -> None:
    """Check the keys of one thing or lamp.

    Args:
        keys: in the order of the file.
        movable: names of what it has.

    Raises:
        ValueError: the images are not in order, or what is moved is not there or turns half round.
    """
    if any(one.frame >= other.frame for one, other in pairwise(keys)):
        raise ValueError("the frames of the keys must rise from key to key")
    for name in {name for key in keys for name in key.moved} - set(movable):
        raise ValueError(f"keys give `{name}`, which this kind does not have")
    directions = [_unit(key.direction) for key in keys if isinstance(key, LightKey) and key.direction]
    if any(math.dist(one, [-value for value in other]) < _LEAST_SUM for one, other in pairwise(directions)):
        raise ValueError("the direction turns half round between two keys; put a key between them")


def is_moving(stage: "Stage") -> bool:
    """Return whether anything in a stage has keys."""
    return any(part.keys for part in (*stage.meshes, *stage.lights))


def stage_at(stage: "Stage", frame: int) -> "Stage":
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
            even = _unit if name == "direction" else tuple
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


def _unit(direction: Sequence[float]) -> tuple[float, ...]:
    length = math.hypot(*direction)
    return tuple(value / length for value in direction)

"""Keys of things and lamps that move in a film. Imports neither torch nor numba."""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Annotated, TypeVar

from pydantic import Field, model_validator

from octasplat.engine.pathtracing.stage.base import IS_NUMBER, Finite, StageModel, Vector

MAX_KEYS = 1000
_LEAST_SUM = 1e-3
"""Length of the sum of two unit directions below which they are taken as opposite."""


class MotionKey(StageModel):
    """What something has in one image; what a key leaves out moves as the other keys say.

    Attributes:
        frame: number of the image, from 0.
        position: as that of the thing or lamp.
    """

    frame: Annotated[int, Field(ge=0), IS_NUMBER]
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
    directions = [
        unit_direction(key.direction) for key in keys if isinstance(key, LightKey) and key.direction
    ]
    if any(math.dist(one, [-value for value in other]) < _LEAST_SUM for one, other in pairwise(directions)):
        raise ValueError("the direction turns half round between two keys; put a key between them")


def unit_direction(direction: Sequence[float]) -> tuple[float, ...]:
    """Return a direction at length 1."""
    length = math.hypot(*direction)
    return tuple(value / length for value in direction)

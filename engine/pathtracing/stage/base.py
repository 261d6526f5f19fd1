"""Types of values in a stage, and the base of its models. Imports neither torch nor numba."""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
UnitInterval = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
Vector = tuple[Finite, Finite, Finite]
Color = tuple[UnitInterval, UnitInterval, UnitInterval]
WHITE = (1.0, 1.0, 1.0)


class StageModel(BaseModel):
    """Base of all stage models: unknown keys are refused, and instances are immutable."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class Transformed(StageModel):
    """Something with a placement in the world: scaled first, then rotated, then translated.

    Attributes:
        position: where its origin comes to lie.
        rotation_degrees: about the world's x, then y, then z axis.
        scale: one factor, or one for each axis of its own.
    """

    position: Vector = (0.0, 0.0, 0.0)
    rotation_degrees: Vector = (0.0, 0.0, 0.0)
    scale: Positive | tuple[Positive, Positive, Positive] = 1.0

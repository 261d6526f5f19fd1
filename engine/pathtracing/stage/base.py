"""Types of values in a stage, and the base of its models. Imports neither torch nor numba."""

from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, model_validator

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

    @model_validator(mode="before")
    @classmethod
    def _read_former_key(cls, given: Any) -> Any:
        """Read ``colour_srgb`` of earlier stage files as ``color_srgb``."""
        if isinstance(given, dict) and "colour_srgb" in given and "color_srgb" not in given:
            return {("color_srgb" if key == "colour_srgb" else key): value for key, value in given.items()}
        return given


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

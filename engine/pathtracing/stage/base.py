"""Types of values in a stage, and the base of its models. Imports neither torch nor numba."""

import re
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator
from pydantic_core import PydanticKnownError


def _refuse_truth(value: object) -> object:
    """Return any value but true and false: Python, and so pydantic, takes these as 1 and 0."""
    if isinstance(value, bool):
        raise PydanticKnownError("float_type")
    return value


IS_NUMBER = BeforeValidator(_refuse_truth)
"""Behind the bounds of a number, which the schema would lack otherwise."""
Finite = Annotated[float, Field(allow_inf_nan=False), IS_NUMBER]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False), IS_NUMBER]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False), IS_NUMBER]
UnitInterval = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False), IS_NUMBER]
Vector = tuple[Finite, Finite, Finite]
Rgb = tuple[UnitInterval, UnitInterval, UnitInterval]


def _read_hexadecimal(value: object) -> object:
    """Return the display values of a text such as ``#cc8033``; any other value as it is."""
    if isinstance(value, str) and re.fullmatch(r"#[0-9a-fA-F]{6}", value):
        return tuple(int(value[k : k + 2], 16) / 255 for k in (1, 3, 5))
    return value


Color = Annotated[Rgb, BeforeValidator(_read_hexadecimal, json_schema_input_type=Rgb | str)]
"""Display values, or a text such as ``#cc8033``."""
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

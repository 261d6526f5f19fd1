"""What may be asked of an edit: which Gaussians are meant, and what becomes of their materials."""

import re
from collections.abc import Callable
from typing import Annotated, Any

import numpy as np
from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    FiniteFloat,
    ValidationError,
    field_validator,
    model_validator,
)
from pydantic_core import InitErrorDetails, PydanticCustomError

from octasplat.engine.colour import srgb_to_linear
from octasplat.engine.edit.where import MAX_LENGTH, check_where
from octasplat.engine.errors import ConfigError
from octasplat.engine.fields import Spelling
from octasplat.engine.gaussians.materials import MATERIAL_WIDTHS

_HEX = re.compile(r"#([0-9a-fA-F]{6})")


_Box = tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat]
_Sphere = tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat]


class Selection(BaseModel):
    """Which Gaussians are meant: those for which all that is given holds."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    where: Annotated[str | None, Spelling(metavar="EXPRESSION")] = Field(
        None,
        max_length=MAX_LENGTH,
        description="Comparisons joined by and, or, not that hold for them, of x, y, z, opacity and channels "
        "such as metallic, roughness and albedo.r: 'metallic > 0.5 and z < 0'.",
    )
    box: Annotated[_Box | None, Spelling(metavar="X0 Y0 Z0 X1 Y1 Z1")] = Field(
        None,
        description="Two corners of a box that their centres lie in, smallest coordinates first.",
    )
    sphere: Annotated[_Sphere | None, Spelling(metavar="X Y Z R")] = Field(
        None, description="Centre and radius of a sphere that their centres lie in."
    )
    inverse: bool = Field(False, description="Take the other Gaussians instead.")

    @field_validator("where")
    @classmethod
    def _can_be_read(cls, text: str | None) -> str | None:
        try:
            if text is not None:
                check_where(text)
        except ConfigError as error:
            raise ValueError(str(error).removesuffix(".")) from None
        return text


def read_colour(value: object) -> object:
    """Linear values of a text: ``#rrggbb`` has display values, ``r,g,b`` linear ones.

    Anything else is given back as it is. Raises ValueError where a text is neither.
    """
    if not isinstance(value, str):
        return value
    if found := _HEX.fullmatch(value.strip()):
        shown = np.frombuffer(bytes.fromhex(found[1]), np.uint8) / 255.0
        return tuple(float(part) for part in srgb_to_linear(shown))
    try:
        return tuple(float(part) for part in value.split(","))
    except ValueError:
        raise ValueError("write it as r,g,b from 0 to 1, linear, or as #rrggbb, display values") from None


_Share = Annotated[float, Field(ge=0, le=1)]
_Factor = Annotated[FiniteFloat, Field(ge=0)]
_Colour = Annotated[
    tuple[_Share, _Share, _Share],
    BeforeValidator(read_colour, json_schema_input_type=tuple[_Share, _Share, _Share] | str),
]


def read_assignments(value: object) -> object:
    """Return the values of texts such as ``roughness=0.3`` by name; anything else as it is.

    Raises:
        ValueError: a text is no assignment.
    """
    texts = [value] if isinstance(value, str) else value
    if not isinstance(texts, list | tuple):
        return value
    found: dict[str, object] = {}
    for text in texts:
        name, equals, assigned = str(text).partition("=")
        if not equals:
            raise ValueError(f"write {str(text)!r} as NAME=VALUE, as in roughness=0.3")
        found[name.strip()] = assigned.strip()
    return found


class _Given(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    @model_validator(mode="wrap")
    @classmethod
    def _names_materials(cls, value: object, handler: Callable[[object], Any]) -> Any:
        try:
            return handler(value)
        except ValidationError as error:
            unknown = [found for found in error.errors() if found["type"] == "extra_forbidden"]
            if not unknown:
                raise
            told = PydanticCustomError(
                "no_material",
                "there is no such material; choose {names}",
                {"names": ", ".join(MATERIAL_WIDTHS)},
            )
            lines = [InitErrorDetails(type=told, loc=found["loc"], input=value) for found in unknown]
            raise ValidationError.from_exception_data(cls.__name__, lines) from None

    def given(self) -> dict[str, Any]:
        """What is not left as it is, by channel."""
        return {name: value for name in MATERIAL_WIDTHS if (value := getattr(self, name)) is not None}


class MaterialValues(_Given):
    """Values that materials get."""

    albedo: _Colour | None = Field(
        None,
        description="Base colour: r,g,b from 0 to 1, linear, or a text such as '#ff8000', display values.",
    )
    metallic: _Share | None = Field(None, description="0 is matt or glazed, 1 is metal.")
    roughness: _Share | None = Field(None, description="0 is a mirror, 1 is as rough as can be.")


class MaterialFactors(_Given):
    """Factors that materials are multiplied by; what comes out is kept within 0 and 1."""

    albedo: _Factor | None = Field(None, description="Of the linear base colour.")
    metallic: _Factor | None = Field(None, description="From 0, below 1 less metallic.")
    roughness: _Factor | None = Field(None, description="From 0, below 1 smoother.")


class MaterialChange(BaseModel):
    """What becomes of materials."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    set: Annotated[
        MaterialValues, BeforeValidator(read_assignments), Spelling(metavar="NAME=VALUE", repeated=True)
    ] = Field(
        MaterialValues(),
        description="Values to set: albedo=R,G,B (linear, 0 to 1), albedo=#rrggbb (display), "
        "metallic=0..1 or roughness=0..1.",
    )
    scale: Annotated[
        MaterialFactors, BeforeValidator(read_assignments), Spelling(metavar="NAME=FACTOR", repeated=True)
    ] = Field(
        MaterialFactors(),
        description="Factors to multiply albedo, metallic or roughness by; the result is at most 1.",
    )

    @model_validator(mode="after")
    def _says_something_once(self) -> "MaterialChange":
        both = self.set.given().keys() & self.scale.given().keys()
        if both:
            raise ValueError(f"{sorted(both)[0]} is set and scaled; choose one")
        if not self.set.given() and not self.scale.given():
            raise ValueError(
                "Say what to change: nothing is changed unless albedo, metallic or roughness is set or scaled"
            )
        return self

"""What may be asked of an edit: which Gaussians are meant, and what becomes of their materials."""

import re
from typing import Annotated, Any

import numpy as np
from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    FiniteFloat,
    field_validator,
    model_validator,
)

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


class _Given(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    def given(self) -> dict[str, Any]:
        """What is not left as it is, by channel."""
        return {name: value for name in MATERIAL_WIDTHS if (value := getattr(self, name)) is not None}


class MaterialValues(_Given):
    """Values of a material.

    Attributes:
        albedo: base colour: r,g,b from 0 to 1, linear, or a text such as '#ff8000', display values.
        metallic: 0 is matt or glazed, 1 is metal.
        roughness: 0 is a mirror, 1 is as rough as can be.
    """

    albedo: _Colour | None = None
    metallic: _Share | None = None
    roughness: _Share | None = None


class MaterialFactors(_Given):
    """Factors of a material; what comes out is kept within 0 and 1.

    Attributes:
        albedo: of the linear base colour.
        metallic: from 0, below 1 less metallic.
        roughness: from 0, below 1 smoother.
    """

    albedo: _Factor | None = None
    metallic: _Factor | None = None
    roughness: _Factor | None = None


class MaterialChange(BaseModel):
    """What becomes of materials.

    Attributes:
        set: values that they get.
        scale: factors that they are multiplied by.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    set: MaterialValues = MaterialValues()
    scale: MaterialFactors = MaterialFactors()

    @model_validator(mode="after")
    def _says_something_once(self) -> "MaterialChange":
        both = self.set.given().keys() & self.scale.given().keys()
        if both:
            raise ValueError(f"{sorted(both)[0]} is set and scaled; choose one")
        if not self.set.given() and not self.scale.given():
            raise ValueError("nothing is changed; set or scale albedo, metallic or roughness")
        return self

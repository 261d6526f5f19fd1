"""Options of edits: which Gaussians are selected, and how their materials change."""

import re
from collections.abc import Callable
from typing import Annotated, Any, Literal

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

from octasplat.engine.core.color import srgb_to_linear
from octasplat.engine.core.errors import ConfigError
from octasplat.engine.edit.axes import Axes
from octasplat.engine.edit.filter_expression import MAX_LENGTH, parse_filter
from octasplat.engine.gaussians.materials import MATERIAL_WIDTHS
from octasplat.engine.settings.fields import BoxCorners, Group, Spelling, Unit

_HEX = re.compile(r"#([0-9a-fA-F]{6})")


_Sphere = tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat]


class Selection(BaseModel):
    """Selection of Gaussians: those for which all given conditions hold."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    where: Annotated[str | None, Spelling(metavar="EXPRESSION")] = Field(
        None,
        max_length=MAX_LENGTH,
        description="Comparisons joined by and, or, not that hold for them, of x, y, z, opacity and channels "
        "such as metallic, roughness and albedo.r: 'metallic > 0.5 and z < 0'.",
    )
    box: Annotated[BoxCorners | None, Unit("scene units"), Spelling(metavar="X0 Y0 Z0 X1 Y1 Z1")] = Field(
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
                parse_filter(text)
        except ConfigError as error:
            raise ValueError(str(error).removesuffix(".")) from None
        return text


def read_color(value: object) -> object:
    """Return linear values of a text: ``#rrggbb`` has display values, ``r,g,b`` linear ones.

    Anything else is given back as it is. Raises ValueError where a text is neither.
    """
    if not isinstance(value, str):
        return value
    if found := _HEX.fullmatch(value.strip()):
        display = np.frombuffer(bytes.fromhex(found[1]), np.uint8) / 255.0
        return tuple(float(part) for part in srgb_to_linear(display))
    try:
        return tuple(float(part) for part in value.split(","))
    except ValueError:
        raise ValueError("write it as r,g,b from 0 to 1, linear, or as #rrggbb, display values") from None


_Share = Annotated[float, Field(ge=0, le=1)]
_Factor = Annotated[FiniteFloat, Field(ge=0)]
_Color = Annotated[
    tuple[_Share, _Share, _Share],
    BeforeValidator(read_color, json_schema_input_type=tuple[_Share, _Share, _Share] | str),
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


class _ChannelValues(BaseModel):
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
            no_material = PydanticCustomError(
                "no_material",
                "there is no such material; choose {names}",
                {"names": ", ".join(MATERIAL_WIDTHS)},
            )
            lines = [InitErrorDetails(type=no_material, loc=found["loc"], input=value) for found in unknown]
            raise ValidationError.from_exception_data(cls.__name__, lines) from None

    def set_values(self) -> dict[str, Any]:
        """Return the values that are given, by channel."""
        return {name: value for name in MATERIAL_WIDTHS if (value := getattr(self, name)) is not None}


class MaterialValues(_ChannelValues):
    """Values that materials are set to."""

    albedo: _Color | None = Field(
        None,
        description="Base color: r,g,b from 0 to 1, linear, or a text such as '#ff8000', display values.",
    )
    metallic: _Share | None = Field(None, description="0 is matt or glazed, 1 is metal.")
    roughness: _Share | None = Field(None, description="0 is a mirror, 1 is as rough as can be.")


class MaterialFactors(_ChannelValues):
    """Factors that materials are multiplied by; the products are clamped to [0, 1]."""

    albedo: _Factor | None = Field(None, description="Of the linear base color.")
    metallic: _Factor | None = Field(None, description="From 0, below 1 less metallic.")
    roughness: _Factor | None = Field(None, description="From 0, below 1 smoother.")


class MaterialChange(BaseModel):
    """Changes of the materials of the selected Gaussians."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    set: Annotated[
        MaterialValues, BeforeValidator(read_assignments), Spelling(metavar="NAME=VALUE", repeated=True)
    ] = Field(
        MaterialValues(),
        description="Values to set: albedo=R,G,B (linear, 0 to 1), albedo=#rrggbb (display), "
        "metallic=0..1 or roughness=0..1.",
    )
    multiply: Annotated[
        MaterialFactors, BeforeValidator(read_assignments), Spelling(metavar="NAME=FACTOR", repeated=True)
    ] = Field(
        MaterialFactors(),
        description="Factors to multiply albedo, metallic or roughness by; the result is at most 1.",
    )

    @model_validator(mode="after")
    def _says_something_once(self) -> "MaterialChange":
        both = self.set.set_values().keys() & self.multiply.set_values().keys()
        if both:
            raise ValueError(f"{sorted(both)[0]} is set and multiplied; choose one")
        if not self.set.set_values() and not self.multiply.set_values():
            raise ValueError(
                "Say what to change: nothing is changed unless albedo, metallic or roughness is set or "
                "multiplied"
            )
        return self


class MeshToGaussiansOptions(BaseModel):
    """Options of the conversion of an edited mesh to Gaussians."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    method: Literal["least-squares", "three-point"] = Field(
        "least-squares",
        description="How a frame follows from the corners of its octagon: least-squares over all of them, or "
        "three-point, the rule of the paper from corners 0, 2 and 6, which drops shear.",
    )
    damaged: Literal["repair", "drop"] = Field(
        "repair",
        description="What becomes of octagons that lost corners, flipped or crumpled: repair fits them to "
        "the corners left, turns them back or moves them as their neighbours were; drop leaves them out.",
    )
    axes: Literal["auto"] | Axes = Field(
        "auto", description="Turn of the mesh about x, in degrees, that brings it back to the scene's axes."
    )
    q: float | None = Field(
        None, gt=0.0, le=100.0, description="What the mesh was exported with, should it not say."
    )
    min_opacity: float | None = Field(
        None,
        ge=0.0,
        lt=1.0,
        description="Least opacity that the mesh was exported with, should it not say; without it every "
        "Gaussian that can have an octagon is taken to have one.",
    )
    max_residual: Annotated[float, Unit("standard deviations")] = Field(
        1.0,
        gt=0.0,
        description="Octagons further from an affine image than this many standard deviations are crumpled.",
    )
    whole_octagons: bool = Field(
        False,
        description="Octagons of which only some corners moved move as a whole, or not at all if most "
        "stayed.",
    )


class CleanupOptions(BaseModel):
    """Options of what to remove from a scene."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    min_opacity: float = Field(
        0.01, ge=0.0, lt=1.0, description="Remove fainter ones; below 0.01 they cannot be seen."
    )
    min_scale: Annotated[float, Unit("scene units")] = Field(
        0.0,
        ge=0.0,
        description="Remove those whose larger standard deviation is smaller, in the scene's units.",
    )
    max_scale: Annotated[float | None, Unit("scene units")] = Field(
        None,
        gt=0.0,
        description="Remove those whose larger standard deviation is larger, in the scene's units.",
    )
    floaters: bool = Field(True, description="Remove small groups by themselves.")
    min_group: Annotated[int, Unit("Gaussians")] = Field(
        20, ge=2, description="Groups of fewer Gaussians are floaters."
    )
    link: float = Field(
        1.0,
        gt=0.0,
        description="Neighbours belong together if their centres are no further apart than this many times "
        "the sum of their standard deviations.",
    )
    neighbors: Annotated[int, Group("advanced")] = Field(
        12, ge=1, le=64, description="How many nearest neighbours of a Gaussian may belong to its group."
    )

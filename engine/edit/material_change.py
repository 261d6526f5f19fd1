"""Materials of chosen Gaussians changed: set to values, or scaled by factors."""

import re
from dataclasses import replace
from typing import Annotated, Any

import numpy as np
from jaxtyping import Bool, Float64
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, FiniteFloat, model_validator

from engine.colour import linear_to_srgb, srgb_to_linear
from engine.gaussians.channels import stacked
from engine.gaussians.harmonics import sh_basis, spread_directions
from engine.gaussians.materials import AMBIENT, MATERIAL_WIDTHS
from engine.gaussians.model import FlatGaussians
from engine.shading.environment_levels import LightLevels
from engine.shading.split_sum import Surface, shade

_HEX = re.compile(r"#([0-9a-fA-F]{6})")
_AT_ONCE = 1 << 14
_DIRECTIONS = 64
"""From which a Gaussian is looked at to see how its look changes."""


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
        albedo: base colour, r, g, b from 0 to 1, linear; or a text such as '#ff8000', display values.
        metallic: from 0 to 1.
        roughness: from 0 to 1.
    """

    albedo: _Colour | None = None
    metallic: _Share | None = None
    roughness: _Share | None = None


class MaterialFactors(_Given):
    """Factors of a material; what comes out is kept within 0 and 1.

    Attributes:
        albedo: of the linear base colour.
        metallic: likewise.
        roughness: likewise.
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

    def applied(self, gaussians: FlatGaussians, chosen: Bool[np.ndarray, " n"]) -> FlatGaussians:
        """The scene, which has materials, with those of the chosen Gaussians changed and all else shared."""
        changed: dict[str, np.ndarray] = {}
        for name, value in (*self.set.given().items(), *self.scale.given().items()):
            changed[name] = gaussians.channels[name].copy()
            new = value if name in self.set.given() else changed[name][chosen] * np.float32(value)
            changed[name][chosen] = np.clip(new, 0.0, 1.0)
        return gaussians.with_channels(changed)


def with_harmonics_following(
    before: FlatGaussians,
    after: FlatGaussians,
    chosen: Bool[np.ndarray, " n"],
    light: LightLevels,
    frame: Float64[np.ndarray, "3 3"],
) -> FlatGaussians:
    """The changed scene with harmonics that show the change, for whoever draws harmonics.

    To those of each chosen Gaussian is added by how much its split sum differs between the two materials, in
    display values and from all directions, as nearly as its harmonics can say it. Its share of the light
    from all around stands for what it sees of the environment; a scene without that channel sees all.

    Args:
        before: the scene as it was.
        after: the same with other materials.
        chosen: whose harmonics follow.
        light: levels of the environment that the scene was learnt with.
        frame: its right, up and forward in the world, as rows.
    """
    directions_world = spread_directions(_DIRECTIONS)
    solve = np.linalg.pinv(sh_basis(directions_world, after.sh_degree))
    sh, rows = after.sh.copy(), np.flatnonzero(chosen)
    for start in range(0, len(rows), _AT_ONCE):
        part = rows[start : start + _AT_ONCE]
        looks = [_look(scene.select(part), directions_world, light, frame) for scene in (before, after)]
        sh[part] += np.einsum("kd,ndc->nkc", solve, looks[1] - looks[0]).astype(np.float32)
    return replace(after, sh=sh)


def _look(
    gaussians: FlatGaussians,
    directions_world: Float64[np.ndarray, "d 3"],
    light: LightLevels,
    frame: Float64[np.ndarray, "3 3"],
) -> Float64[np.ndarray, "n d 3"]:
    """Display colours of Gaussians as they are seen along directions."""
    count, views = len(gaussians), len(directions_world)
    directions = np.tile(directions_world, (count, 1))
    normals = np.repeat(gaussians.rotations[:, :, 0].astype(np.float64), views, axis=0)
    normals *= np.where((normals * directions).sum(axis=1) > 0, -1.0, 1.0)[:, None]
    material = np.repeat(stacked(gaussians.channels, list(MATERIAL_WIDTHS)), views, axis=0)
    surface = Surface.alone(material, normals, directions)
    if AMBIENT in gaussians.channels:
        seen = np.repeat(gaussians.channels[AMBIENT][:, 0].astype(np.float64), views)
        surface = replace(surface, visibility=seen, ambient=seen)
    shown = linear_to_srgb(np.minimum(shade(surface, light, frame), 1.0))
    return shown.reshape(count, views, 3)

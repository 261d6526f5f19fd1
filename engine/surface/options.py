"""Settings of surface extraction."""

from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, field_validator

from octasplat.engine.core.local_origin import Box
from octasplat.engine.settings.fields import Group, Spelling, Unit

_NEGATABLE = Spelling(negatable=True)
"""Of what ``room`` switches on where nothing is said."""


def _read_box(value: object) -> object:
    """Return the six numbers of a text with commas between them; anything else as it is."""
    if not isinstance(value, str):
        return value
    try:
        numbers = tuple(float(part) for part in value.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != 6:
        raise ValueError(f"{value!r} is not six numbers x0,y0,z0,x1,y1,z1")
    return numbers


def _read_rim(value: object) -> object:
    """Return a number of voxels, or ``all``."""
    if value == "all":
        return value
    number: Any = value
    try:
        number = float(number)
    except (TypeError, ValueError):
        number = -1.0
    if not number >= 0:
        raise ValueError(f"{value!r} is neither a number of voxels nor 'all'")
    return number


class ExtractionOptions(BaseModel):
    """Options of the surface extraction, see :func:`octasplat.engine.surface.extract.extract_levels`."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    unbounded: Annotated[bool, _NEGATABLE] = Field(
        False, description="Reach to the horizon, with ever coarser voxels, instead of meshing a box."
    )
    bounds: Annotated[
        Box | None,
        Spelling(metavar="X0,Y0,Z0,X1,Y1,Z1"),
        BeforeValidator(_read_box, json_schema_input_type=Box | str | None),
    ] = Field(
        None,
        description="The box to mesh, in scene units; octasplat info tells where the scene lies.  "
        "[default: what is seen of the space that the cameras surround]",
    )
    voxel: Annotated[float | None, Unit("scene units")] = Field(
        None,
        gt=0,
        description="Side of a voxel, in scene units, at the centre where unbounded.  "
        "[default: as resolution says]",
    )
    resolution: int | None = Field(
        None,
        ge=16,
        le=4096,
        description="Voxels along the longest side of the box.  [default: 512, or fewer where a voxel would "
        "be smaller than one and a half pixels of the depth maps]",
    )
    truncation: Annotated[float | None, Unit("voxels"), Spelling(metavar="VOXELS")] = Field(
        None,
        ge=2,
        le=128,
        description="Half width of the band around the surface in which distances are kept.  "
        "[default: 3% of the cameras' distance, about what trained depths are off by, and at least 4]",
    )
    depth_trunc: Annotated[float | None, Unit("scene units")] = Field(
        None, gt=0, description="Ignore depths beyond this, in scene units.  [default: none]"
    )
    depth_mode: Literal["median", "expected"] = Field(
        "median",
        description="Which depth is fused: the median, where half of the light is gone, or the expected one.",
    )
    depth_side: Annotated[int, Unit("px"), Spelling(metavar="PX")] = Field(
        640, ge=16, le=8192, description="Longer side of the depth maps."
    )
    min_alpha: Annotated[float, Group("advanced")] = Field(
        0.5, ge=0.5, lt=1, description="Pixels that the scene covers less than this have no depth."
    )
    min_weight: float = Field(
        0.5,
        gt=0,
        description="Least evidence for a voxel; a view that looks straight onto the surface gives 1.",
    )
    unseen: Literal["open", "solid"] = Field(
        "open",
        description="Space near the surface that no view saw: open leaves holes there, solid closes the "
        "mesh.",
    )
    backdrop: Annotated[bool, _NEGATABLE] = Field(
        False,
        description="A sphere around everything that shows what the scene shows in the gaps of the mesh.",
    )
    refine_vertices: Annotated[bool, _NEGATABLE] = Field(
        False, description="Move vertices along their normals to where the pictures agree, before colors."
    )
    keep_components: Annotated[int | None, Spelling(("--components",))] = Field(
        None,
        ge=1,
        description="Keep so many connected parts only, largest first.  [default: by min_component]",
    )
    min_component: float = Field(
        0.01, ge=0, le=1, description="Remove parts of less than this share of the largest part's area."
    )
    fill_holes: Annotated[
        Literal["all"] | float,
        Unit("voxels"),
        Spelling(metavar="VOXELS"),
        BeforeValidator(_read_rim, json_schema_input_type=Literal["all"] | float),
    ] = Field(0.0, description="Close holes whose rim is no longer than so many voxels; or 'all'.")
    fit: Annotated[bool, Group("advanced")] = Field(
        True,
        description="Of all colors, take those with which the mesh looks as like the pictures as it can.",
    )
    texture_size: Annotated[int | None, Unit("px"), Spelling(metavar="PX")] = Field(
        None,
        ge=64,
        le=16384,
        description="Colors in a square texture of this side instead of in the vertices; .glb, .obj and "
        ".usdz.",
    )
    max_memory_gb: Annotated[float, Unit("GB"), Spelling(("--max-memory",), metavar="GB")] = Field(
        4.0, gt=0, description="Refuse a volume that takes more memory than this."
    )

    @field_validator("resolution")
    @classmethod
    def _is_only_size(cls, resolution: int | None, info: Any) -> int | None:
        if resolution is not None and info.data.get("voxel") is not None:
            raise ValueError("voxel and resolution both say how large voxels are; give one of them")
        return resolution

    @field_validator("bounds")
    @classmethod
    def _is_box(cls, bounds: Box | None, info: Any) -> Box | None:
        if bounds is None:
            return None
        if info.data.get("unbounded"):
            raise ValueError("bounds and unbounded contradict each other")
        if not all(low < high for low, high in zip(bounds[:3], bounds[3:], strict=True)):
            raise ValueError("bounds must be x0,y0,z0,x1,y1,z1 with x0 < x1, y0 < y1 and z0 < z1")
        return bounds

"""Settings of surface extraction."""

from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, field_validator

from octasplat.engine.settings.fields import BoxCorners, Group, Spelling, Unit

_NEGATABLE = Spelling(negatable=True)
"""Of what ``room`` switches on where nothing is said."""


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
    box: Annotated[BoxCorners | None, Unit("scene units"), Spelling(metavar="X0 Y0 Z0 X1 Y1 Z1")] = Field(
        None,
        description="Two corners of the box to mesh, smallest coordinates first; octasplat info tells where "
        "the scene lies.  [default: what is seen of the space that the cameras surround]",
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
    keep_components: int | None = Field(
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

    @field_validator("box")
    @classmethod
    def _has_a_volume(cls, box: BoxCorners | None, info: Any) -> BoxCorners | None:
        if box is None:
            return None
        if info.data.get("unbounded"):
            raise ValueError("a box and unbounded contradict each other")
        if not all(low < high for low, high in zip(box[:3], box[3:], strict=True)):
            raise ValueError("the corners must be x0 y0 z0 x1 y1 z1 with x0 < x1, y0 < y1 and z0 < z1")
        return box

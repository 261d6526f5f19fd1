"""What a surface is extracted with."""

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

Box = tuple[float, float, float, float, float, float]


class SurfaceOptions(BaseModel):
    """Settings of :func:`octasplat.engine.surface.extract.extract_surface`.

    Attributes:
        unbounded: reach to infinity by fusing in contracted space instead of a box.
        bounds: the box (x0, y0, z0, x1, y1, z1) to fuse in, world units; None takes the region that the
            cameras stand around.
        voxel: side of a voxel, world units (at the centre where ``unbounded``); None follows ``resolution``.
        resolution: voxels along the longest side of the region; None takes 512, or fewer where a voxel would
            be smaller than one and a half pixels of the depth maps.
        truncation: half width of the band around the surface in which distances are kept, in voxels; None
            takes 3 % of the cameras' distance, which is about what trained depths are off by, and at least 4.
        depth_trunc: depths beyond this do not count, world units; None keeps all.
        depth: which depth is fused, the median (where half of the light is gone) or the expected one.
        depth_side: longer side of the depth maps, px.
        min_alpha: pixels that the scene covers less than this have no depth.
        min_weight: weight that a voxel must have collected to count; a view that looks straight onto the
            surface gives 1.
        unseen: what space near the surface is that no view saw: ``open`` leaves holes at its border,
            ``solid`` closes the mesh there.
        backdrop: put a sphere around everything that shows what the scene shows in the mesh's gaps.
        keep_components: how many connected parts to keep, largest first; None goes by ``min_component``.
        min_component: parts with less than this share of the largest part's area are removed.
        fill_holes: holes whose rim is shorter than this many voxels are closed; None closes all, 0 none.
        max_triangles: decimate to at most this many; None keeps all.
        settle: move vertices along their normals to where the pictures agree.
        fit: of all colours, those with which the mesh looks as like the pictures as it can.
        texture_side: bake colours into a square texture of this side, px; None bakes them into the vertices.
        max_memory_gb: refuse a volume that takes more, GB.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    unbounded: bool = False
    bounds: Box | None = None
    voxel: float | None = Field(None, gt=0)
    resolution: int | None = Field(None, ge=16, le=4096)
    truncation: float | None = Field(None, ge=2, le=128)
    depth_trunc: float | None = Field(None, gt=0)
    depth: Literal["median", "expected"] = "median"
    depth_side: int = Field(640, ge=16, le=8192)
    min_alpha: float = Field(0.5, ge=0.5, lt=1)
    min_weight: float = Field(0.5, gt=0)
    unseen: Literal["open", "solid"] = "open"
    backdrop: bool = False
    keep_components: int | None = Field(None, ge=1)
    min_component: float = Field(0.01, ge=0, le=1)
    fill_holes: float | None = Field(0.0, ge=0)
    max_triangles: int | None = Field(None, ge=4)
    settle: bool = False
    fit: bool = True
    texture_side: int | None = Field(None, ge=64, le=16384)
    max_memory_gb: float = Field(4.0, gt=0)

    @model_validator(mode="after")
    def _consistent(self) -> "SurfaceOptions":
        if self.unbounded and self.bounds is not None:
            raise ValueError("bounds and unbounded contradict each other")
        if self.bounds is not None and not all(
            low < high for low, high in zip(self.bounds[:3], self.bounds[3:], strict=True)
        ):
            raise ValueError("bounds must be x0,y0,z0,x1,y1,z1 with x0 < x1, y0 < y1 and z0 < z1")
        return self

"""Settings shared by all export formats."""

from collections.abc import Callable
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from octasplat.engine.gaussians.octagon import CHI2_2_99
from octasplat.engine.gaussians.scene_metadata import UNKNOWN_METADATA, SceneMetadata
from octasplat.engine.geometry.triangle_mesh import TriangleMesh
from octasplat.engine.settings.fields import Group, Spelling, Unit

OctagonQ = Annotated[float, Field(gt=0.0, le=100.0)]
"""Chi-square quantile Q of octagons, their squared radius in standard deviations; alpha falls to exp(-Q/2) at
their corners."""

_TEXTURE = Spelling(metavar="PX")


class ExportChoices(BaseModel):
    """Options of export that users choose; each format uses those that concern it."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    min_opacity: float = Field(0.0, ge=0.0, lt=1.0, description="Leave fainter Gaussians out.")
    sh_pad_degree: Annotated[int | None, Spelling(("--sh-pad",))] = Field(
        None,
        ge=0,
        le=3,
        description="Gaussian PLY: pad the spherical harmonics with zeros up to this degree.",
    )
    spz_version: Annotated[Literal[3, 4], Group("advanced")] = Field(
        3, description="SPZ: 3 (gzip), which every viewer reads, or 4 (Zstandard)."
    )
    opaque: bool = Field(
        False,
        description="GLB: cut alpha at a threshold instead of blending, for programs that cannot sort.",
    )
    chunks: Annotated[int, Group("advanced")] = Field(
        64,
        ge=1,
        le=4096,
        description="GLB: most spatial chunks, which programs sort by distance; rounded down to a power of "
        "two.",
    )
    falloff_texture_size: Annotated[int, _TEXTURE, Unit("px"), Group("advanced")] = Field(
        128, ge=8, le=4096, description="GLB, OBJ: side of the texture that holds the fall-off."
    )
    ids: Annotated[bool, Group("advanced")] = Field(
        True, description="GLB: write the numbers by which edits find back to their Gaussians."
    )


class ExportCamera(BaseModel):
    """A camera for programs that open a scene with one, as glTF has cameras: they look along -z, up is y.

    Attributes:
        name: of the photograph.
        position_world: its centre.
        rotation_xyzw: quaternion that turns the camera's axes to those of the world.
        yfov_rad: angle from top to bottom.
        aspect: width over height.
        near_world: distance from which on it sees.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    position_world: tuple[float, float, float]
    rotation_xyzw: tuple[float, float, float, float]
    yfov_rad: float
    aspect: float
    near_world: float


class ExportOptions(ExportChoices):
    """Options of export: the user's choices, and facts about the scene.

    Attributes:
        q: chi-square quantile of the octagons.
        cores: GLB: first draw solid what has at least this alpha, with the same vertices, so that what lies
            behind is hidden in any order of drawing; the blended octagons follow. Our readers pass over the
            former. None draws no cores.
        light_up: GLB: lit by the materials of the scene, for light whose up is this in the world; None writes
            colors as they are, to be seen without light. What is lit carries no ids.
        camera: GLB: a camera to look from.
        turn_xyzw: GLB for viewers, surface: rotation of the root node, which turns the scene upright; None is
            a half turn about x.
        surface: returns the mesh that is written as a surface; None meshes what cameras all around see.
        facts: Gaussian PLY: what is known of the scene as a whole.
    """

    q: OctagonQ = CHI2_2_99
    cores: float | None = Field(default=None, gt=0.0, lt=1.0)
    light_up: tuple[float, float, float] | None = None
    camera: ExportCamera | None = None
    turn_xyzw: tuple[float, float, float, float] | None = None
    surface: Callable[[], TriangleMesh] | None = None
    facts: SceneMetadata = UNKNOWN_METADATA

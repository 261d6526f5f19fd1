"""Settings shared by all export formats."""

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from octasplat.engine.gaussians.octagon import CHI2_2_99
from octasplat.engine.gaussians.scene_facts import NOTHING_KNOWN, SceneFacts


class ExportOptions(BaseModel):
    """How scenes are written; each format takes what concerns it.

    Attributes:
        q: chi-square quantile Q of the octagons; alpha falls to exp(-Q/2) at their corners.
        min_opacity: Gaussians fainter than this are left out, in every format.
        sh_pad_degree: Gaussian PLY: write at least this degree of spherical harmonics, padded with zeros.
        texture_size: side of the radial alpha texture of GLB and OBJ, in pixels.
        ids: GLB: write the vertex attributes ``_GID`` and ``_CORNER``, by which an edited mesh finds back to
            its Gaussians.
        chunks: GLB: most spatial chunks, a power of two or rounded down to one; viewers sort the chunks.
        opaque: GLB: cut alpha at a threshold instead of blending it, so that viewers have nothing to sort.
        cores: GLB: first draw solid what has at least this alpha, with the same vertices, so that what lies
            behind is hidden in any order of drawing; the blended octagons follow. Our readers pass over the
            former. None draws no cores.
        light_up: GLB: lit by the materials of the scene, for light whose up is this in the world; None writes
            colours as they are, to be seen without light. What is lit carries no ids.
        facts: Gaussian PLY: what is known of the scene as a whole.
        spz_version: SPZ: 3 (gzip), which every viewer reads, or 4 (Zstandard).
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    q: float = Field(default=CHI2_2_99, gt=0.0, le=100.0)
    min_opacity: float = Field(default=0.0, ge=0.0, lt=1.0)
    sh_pad_degree: int | None = Field(default=None, ge=0, le=3)
    texture_size: int = Field(default=128, ge=8, le=4096)
    ids: bool = True
    chunks: int = Field(default=64, ge=1, le=4096)
    opaque: bool = False
    cores: float | None = Field(default=None, gt=0.0, lt=1.0)
    light_up: tuple[float, float, float] | None = None
    facts: SceneFacts = NOTHING_KNOWN
    spz_version: Literal[3, 4] = 3

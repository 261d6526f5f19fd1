"""The settings of the search for poses, and the names that it goes by."""

from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field

FEATURES, MATCHES, STAGE = "features", "matches", "poses"
"""The stages of the search."""
PLACING = "placing"
"""The last stage where poses are given, and only those in doubt are asked."""
LENSES = "lenses"
"""The only stage where a model's lenses are adjusted."""
RECORD = "poses.json"
"""What was found, and for which photographs; beside the model's files."""
FOUND = "found"
"""The model's folder, while it lies below the one for the work."""
MIN_PHOTOGRAPHS = 3


class PosesConfig(BaseModel):
    """How poses are found.

    Attributes:
        max_image_side_px: features are looked for at most at this size.
        max_features: of a photograph; a second search takes twice as many, and fainter ones.
        exhaustive_up_to: up to so many photographs every pair is matched; above, those that a quick look at
            the largest features finds alike.
        quick_features: of a photograph, for the quick look.
        quick_matches: by which two photographs are alike.
        partners: most photographs that one is matched with for being alike.
        neighbours: by name on either side, which each photograph is matched with in any case.
        again_below: share of placed photographs below which a large set, too, is searched a second time.
        min_share: of the photographs that must get a pose.
        max_reprojection_px: mean error above which the result is not trusted.
        min_points: sparse points below which it is not either.
        first_witnesses: photographs, evenly by name, that one whose pose is in doubt is matched with.
        witnesses: the same, in all, where its pose does not fit these.
        agreement_px: distance at which a match agrees with a pose, at the size at which features are looked
            for.
        seed: of everything random.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    max_image_side_px: int = Field(1600, ge=64)
    max_features: int = Field(4096, ge=256)
    exhaustive_up_to: int = Field(40, ge=2)
    quick_features: int = Field(511, ge=64)
    quick_matches: int = Field(12, ge=1)
    partners: int = Field(40, ge=2)
    neighbours: int = Field(3, ge=0)
    again_below: float = Field(0.9, ge=0, le=1)
    min_share: float = Field(0.5, gt=0, le=1)
    max_reprojection_px: float = Field(2.5, gt=0)
    min_points: int = Field(100, ge=10)
    first_witnesses: int = Field(24, ge=2)
    witnesses: int = Field(100, ge=2)
    agreement_px: float = Field(1.5, gt=0)
    seed: int = Field(0, ge=0)


DEFAULT_CONFIG = PosesConfig()


class Given(BaseModel):
    """A model of which some poses may be wrong: see :func:`octasplat.engine.poses.misplaced.place_misplaced`.

    Attributes:
        model: folder of the COLMAP model.
        names: of the request's photographs in it.
        doubtful: which of them are in doubt.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    model: Path
    names: tuple[str, ...]
    doubtful: tuple[int, ...]


class Request(BaseModel):
    """What the process in which COLMAP works is asked.

    With ``given`` see :mod:`octasplat.engine.poses.misplaced`; with the folder of a model, ``lenses_of``, see
    :mod:`octasplat.engine.poses.lenses`; without either :class:`octasplat.engine.poses.search.Search`.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    images: Path
    names: tuple[str, ...]
    work: Path
    config: PosesConfig
    threads: int
    given: Given | None = None
    lenses_of: Path | None = None

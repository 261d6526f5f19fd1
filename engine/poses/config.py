"""The settings of the search for poses, and the names that it goes by."""

from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from octasplat.engine.core.scene_layout import POSE_RECORD
from octasplat.engine.settings.base import Settings
from octasplat.engine.settings.fields import ADVANCED, Unit

READING, FEATURES, MATCHES, MAPPING_STAGE = "read", "features", "matches", "poses"
"""The stages of the search."""
PLACING_STAGE = "placing"
"""The last stage where poses are given, and only those in doubt are asked."""
LENSES_STAGE = "lenses"
"""The only stage where a model's lenses are adjusted."""
RECORD_FILE = POSE_RECORD
"""What was found, and for which photographs; beside the model's files."""
FOUND_FOLDER = "found"
"""The model's folder, while it lies below the one for the work."""
MAX_IMAGE_SIDE_PX = 1600
"""Size at most to which photographs are shrunk before features are looked for."""
MAX_FEATURES = 4096
"""Of a photograph; a second search takes twice as many, and fainter ones."""
PRESELECTION_FEATURES = 511
"""Of a photograph, for the quick look that says which pairs are alike."""
PROPOSALS_PER_PHOTOGRAPH = 100
"""Most photographs that one proposes for the quick look in a large capture; others may propose it."""
_PAIRS_PER_PARTNER = 0.7
"""Of a large capture: pairs that are matched, for each partner that a photograph may have."""
MATCHES_PER_LOOK = 30
"""Quick looks that take as long as matching one pair."""
PRESELECTION_MATCHES = 12
"""By which two photographs are alike."""
RETRY_BELOW_SHARE = 0.9
"""Share of placed photographs below which a large set, too, is searched a second time."""
SEPARATE_PARTS_FROM = 100
"""Photographs of a capture from which on those of all its models count as placed. It may show several places
that nothing links, and a search that took so long is not repeated or given up for that."""
MAX_REPROJECTION_PX = 2.5
"""Mean error above which the result is not trusted."""
MIN_POINTS = 100
"""Sparse points below which it is not either."""
MAX_WITNESSES = 100
"""Photographs in all that one is matched with where its pose does not fit the first ones."""
INLIER_DISTANCE_PX = 1.5
"""Distance at which a match agrees with a pose, at the size at which features are looked for."""


class PosesConfig(Settings):
    """Settings of the pose estimation."""

    exhaustive_up_to: Annotated[int, Unit("photographs"), ADVANCED] = Field(
        40,
        ge=2,
        description="Up to so many photographs every pair is matched; above, those that a quick look at the "
        "largest features finds alike. Raise it where views are missed and time does not "
        "matter.",
    )
    quick_look_up_to: Annotated[int, Unit("photographs"), ADVANCED] = Field(
        500,
        ge=2,
        description="Up to so many photographs the quick look is at every pair; above, at those that GPS in "
        "the photographs, or else a vocabulary of their features, proposes.",
    )
    partners: Annotated[int, Unit("photographs"), ADVANCED] = Field(
        40,
        ge=2,
        description="Most photographs that one is matched with for being alike. Raise it for scenes that "
        "look alike everywhere.",
    )
    large_partners: Annotated[int, Unit("photographs"), ADVANCED] = Field(
        20,
        ge=2,
        description="The same in a large capture, of more photographs than quick_look_up_to.",
    )
    neighbours: Annotated[int, Unit("photographs"), ADVANCED] = Field(
        3,
        ge=0,
        description="Photographs by name on either side that each one is matched with in any case. Raise it "
        "for frames of a video.",
    )
    min_share: Annotated[float, Unit("share of photographs"), ADVANCED] = Field(
        0.5,
        gt=0,
        le=1,
        description="Share of the photographs that must get a pose; fewer are refused. Where there are 100 "
        "or more, a pose in any of the models counts.",
    )
    first_witnesses: Annotated[int, Unit("photographs"), ADVANCED] = Field(
        24,
        ge=2,
        description="Photographs, evenly by name, that one whose pose is in doubt is matched with at first.",
    )
    seed: Annotated[int, ADVANCED] = Field(0, ge=0, description="Seed of everything random in the search.")

    def is_large(self, photographs: int) -> bool:
        """Return whether a capture of so many photographs is searched with less effort for each of them."""
        return photographs > self.quick_look_up_to

    def expected_pairs(self, photographs: int) -> tuple[int, int]:
        """Return about how many pairs of photographs get a quick look, and how many of them are matched."""
        every = photographs * (photographs - 1) // 2
        if photographs <= self.exhaustive_up_to:
            return 0, every
        if not self.is_large(photographs):
            return every, min(every, photographs * self.partners // 2)
        looks = min(every, photographs * PROPOSALS_PER_PHOTOGRAPH)
        return looks, min(looks, round(_PAIRS_PER_PARTNER * photographs * self.large_partners))

    def quick_look_work_share(self, photographs: int) -> float:
        """Return the share of the work of matching that the quick look takes; 0 where there is none."""
        looks, matched = self.expected_pairs(photographs)
        return looks / (looks + MATCHES_PER_LOOK * matched)


DEFAULT_CONFIG = PosesConfig()


class GivenModel(BaseModel):
    """A model of which some poses may be wrong.

    See :func:`octasplat.engine.poses.pose_repair.repair_misplaced`.

    Attributes:
        model: folder of the COLMAP model.
        names: of the request's photographs, as the scene has them; the model may spell them otherwise.
        doubtful: which of them are in doubt.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    model: Path
    names: tuple[str, ...]
    doubtful: tuple[int, ...]


class PoseSearchRequest(BaseModel):
    """Request to the process in which COLMAP runs.

    With ``given`` see :mod:`octasplat.engine.poses.pose_repair`; with the folder of a model, ``lenses_of``,
    see :mod:`octasplat.engine.poses.principal_points`; without either
    :class:`octasplat.engine.poses.search.PoseSearch`.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    images: Path
    names: tuple[str, ...]
    work: Path
    config: PosesConfig
    threads: int
    given: GivenModel | None = None
    lenses_of: Path | None = None

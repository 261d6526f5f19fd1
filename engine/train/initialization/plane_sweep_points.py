"""Points lifted from pixels, and which of those at swept depths are to be believed.

See :mod:`octasplat.engine.train.initialization.plane_sweep` for how they are found.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64
from scipy.spatial import cKDTree

NEAR_SPARSE_POINT = 0.03
"""Something known nearer than that, as a share of the distance to the own camera, bears a point out."""
SAME_POINT, MIN_CONFIRMATIONS, MAX_RIVALRY = 0.04, 3, 0.5
"""So do pixels of so many other views that were lifted to within the first share of that distance, where the
own pixel matches clearly: its rivalry is below the last."""


@dataclass(frozen=True, eq=False)
class PlaneSweepPoints:
    """Points from pixels.

    Attributes:
        xyz_world: where they are.
        rgb_srgb: display colors.
        swept: whether no point around suggested the depth; more of these are wrong.
    """

    xyz_world: Float32[np.ndarray, "n 3"]
    rgb_srgb: Float32[np.ndarray, "n 3"]
    swept: Bool[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.xyz_world)

    def __getitem__(self, ids: np.ndarray) -> "PlaneSweepPoints":
        """Return some of them, by number or by a mask."""
        return PlaneSweepPoints(self.xyz_world[ids], self.rgb_srgb[ids], self.swept[ids])

    @classmethod
    def concatenate(cls, parts: Sequence["PlaneSweepPoints"]) -> "PlaneSweepPoints":
        """Return all parts one after the other; no points for no parts."""
        nothing = np.empty((0, 3), np.float32)
        parts = [cls(nothing, nothing, np.empty(0, np.bool_)), *parts]
        return cls(
            np.concatenate([part.xyz_world for part in parts]),
            np.concatenate([part.rgb_srgb for part in parts]),
            np.concatenate([part.swept for part in parts]),
        )


@dataclass(frozen=True, eq=False)
class MatchEvidence:
    """Evidence for points: whose pixels they were, and how clearly these matched.

    ``view`` is one of the dataset's, and ``distance`` that to its camera. Of swept depths, ``rivalry`` is the
    cost over that of the best other more than one step away: near 0 where only one depth matches.
    """

    view: Int64[np.ndarray, " n"]
    distance: Float64[np.ndarray, " n"]
    rivalry: Float64[np.ndarray, " n"]

    def __getitem__(self, ids: np.ndarray) -> "MatchEvidence":
        return MatchEvidence(*(row[ids] for row in vars(self).values()))

    @classmethod
    def concatenate(cls, parts: Sequence["MatchEvidence"]) -> "MatchEvidence":
        """Return all parts one after the other."""
        columns = zip(*(vars(part).values() for part in parts), strict=True)
        return cls(*(np.concatenate(column) for column in columns))


def is_confirmed(
    found: PlaneSweepPoints,
    evidence: MatchEvidence,
    known: Float64[np.ndarray, "k 3"],
) -> Bool[np.ndarray, " n"]:
    """Return which points at swept depths something else confirms; False for other points.

    Args:
        found: points of all training views.
        evidence: of the same points.
        known: points found before, or known from elsewhere.
    """
    right = np.zeros(len(found), np.bool_)
    swept = np.flatnonzero(found.swept)
    if not len(swept):
        return right
    xyz, seen = found.xyz_world[swept].astype(np.float64), evidence[swept]
    beside, _ = cKDTree(known).query(xyz)
    same_place = _count_confirmations(xyz, seen) >= MIN_CONFIRMATIONS
    right[swept] = (beside < NEAR_SPARSE_POINT * seen.distance) | (same_place & (seen.rivalry < MAX_RIVALRY))
    return right


def _count_confirmations(
    xyz_world: Float64[np.ndarray, "n 3"], seen: MatchEvidence
) -> Int64[np.ndarray, " n"]:
    """Return how many other views have a point at the same place as each."""
    near = cKDTree(xyz_world).query_ball_point(xyz_world, SAME_POINT * seen.distance)
    mine = np.repeat(np.arange(len(near)), [len(others) for others in near])
    views = seen.view[np.concatenate(near).astype(np.int64)]
    # each other view counts once
    pairs = np.unique(np.stack([mine, views], axis=1)[views != seen.view[mine]], axis=0)
    return np.bincount(pairs[:, 0], minlength=len(near))

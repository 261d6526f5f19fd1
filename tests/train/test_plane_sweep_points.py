"""Which points at swept depths are believed: what stands beside something known, what several views found."""

import numpy as np
import pytest

from octasplat.engine.train.initialization.plane_sweep_points import (
    MatchEvidence,
    PlaneSweepPoints,
    is_confirmed,
)

KNOWN = np.array([[0.0, 0.0, 10.0]])
FAR_OFF = np.array([[5.0, 0.0, 10.0]])
AROUND = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])


def believed(xyz_world: np.ndarray, view: list[int], rivalry: float, *, swept: bool = True) -> list[bool]:
    """What is said of points ten away from their cameras."""
    count = len(xyz_world)
    found = PlaneSweepPoints(
        xyz_world.astype(np.float32), np.zeros((count, 3), np.float32), np.full(count, swept, np.bool_)
    )
    evidence = MatchEvidence(np.array(view, np.int64), np.full(count, 10.0), np.full(count, rivalry))
    return is_confirmed(found, evidence, KNOWN).tolist()


def test_plane_sweep_point_near_known_depth() -> None:
    assert believed(np.array([[0.25, 0.0, 10.0], [0.35, 0.0, 10.0]]), [0, 0], 0.95) == [True, False]


@pytest.mark.parametrize(("views", "right"), [([0, 1, 2, 3], True), ([0, 1, 2, 2], False), ([4] * 4, False)])
def test_plane_sweep_point_needs_three_agreeing_views(views: list[int], right: bool) -> None:
    same = FAR_OFF + 0.1 * AROUND
    assert believed(same, views, 0.45) == [right] * 4
    assert believed(same, views, 0.6) == [False] * 4
    spread = FAR_OFF + 0.5 * AROUND
    assert believed(spread, views, 0.45) == [False] * 4


def test_lifted_points_without_other_suggestions_are_rejected() -> None:
    assert believed(KNOWN, [0], 0.1, swept=False) == [False]
    assert believed(np.empty((0, 3)), [], 0.1) == []

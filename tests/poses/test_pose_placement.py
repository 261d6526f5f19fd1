"""Where matches with photographs of known poses put another one, with known answers."""

import numpy as np
import pytest
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from octasplat.engine.poses.pose_estimation import Matches, estimate_pose, refine_pose, sampson_distances

PIXEL = 1e-3
Pose = tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, " 3"]]


def looking(centre_world: Float64[np.ndarray, " 3"]) -> Pose:
    """A camera that looks at the origin."""
    forward = -centre_world / np.linalg.norm(centre_world)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return rotation, -rotation @ centre_world


def seen(pose: Pose, points_world: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    points_cam = points_world @ pose[0].T + pose[1]
    return points_cam / points_cam[:, 2:]


def matched(
    pose: Pose,
    others: list[Pose],
    count: int,
    wrong: float = 0.0,
    noise: float = 0.0,
    about: Float64[np.ndarray, " 3"] | None = None,
) -> Matches:
    """Matches of a camera at ``pose`` with each of the others, a share of them wrong.

    The others are in a world that has the middle of what they see at ``about``.
    """
    middle = np.zeros(3) if about is None else about
    rng = np.random.default_rng(0)
    ours, theirs = [], []
    for other in others:
        points = rng.normal(0, 0.5, (count, 3))
        ours.append(seen(pose, points))
        false = rng.random(count) < wrong
        points[false] = rng.normal(0, 0.5, (int(false.sum()), 3))
        theirs.append(seen((other[0], other[1] + other[0] @ middle), points))
    rays, partner_rays = np.concatenate(ours), np.concatenate(theirs)
    rays[:, :2] += rng.normal(0, noise, (len(rays), 2)) if noise else 0.0
    return Matches(
        rays,
        partner_rays,
        np.repeat(np.arange(len(others)), count),
        np.stack([other[0] for other in others]),
        np.stack([other[1] for other in others]),
    )


def ring(count: int) -> list[Pose]:
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return [looking(np.array([4 * np.cos(a), 4 * np.sin(a), 1.0 + 0.3 * np.sin(3 * a)])) for a in angles]


TRUE = looking(np.array([3.0, 2.5, 2.0]))
WRONG = looking(np.array([-3.0, 1.0, 2.5]))


def test_distances_from_known_line() -> None:
    # Two cameras side by side that look the same way: a feature's line in the other is its own row.
    level = np.eye(3)[None], np.array([[-1.0, 0.0, 0.0]])
    rays = np.array([[0.2, 0.1, 1.0], [0.2, 0.1, 1.0], [0.2, 0.1, 1.0]])
    partner_rays = np.array([[-0.3, 0.1, 1.0], [-0.3, 0.13, 1.0], [0.9, 0.06, 1.0]])
    matches = Matches(rays, partner_rays, np.zeros(3, np.int64), *level)
    found = sampson_distances(np.eye(3), np.zeros(3), matches)
    # Both features move by half of what they are apart, which together is a root of a half of it.
    np.testing.assert_allclose(np.abs(found), [0.0, 0.03 / np.sqrt(2), 0.04 / np.sqrt(2)], atol=1e-12)


NEAR, FAR = np.zeros(3), np.array([512345.6, 5403210.9, 310.2])
"""Where the world has the middle of the ring; the second is of map coordinates."""


def at(middle: Float64[np.ndarray, " 3"], pose: Pose) -> Pose:
    return pose[0], pose[1] - pose[0] @ middle


def centre(pose: Pose) -> Float64[np.ndarray, " 3"]:
    return -pose[0].T @ pose[1]


@pytest.mark.parametrize("middle", [NEAR, FAR], ids=["near", "far"])
def test_refining_undoes_a_small_motion(middle: Float64[np.ndarray, " 3"]) -> None:
    matches = matched(TRUE, [at(middle, other) for other in ring(9)], 40, about=middle)
    turn = Rotation.from_rotvec([0.002, -0.003, 0.001]).as_matrix()
    given = at(middle, (turn @ TRUE[0], TRUE[1] + [0.01, -0.01, 0.005]))
    found = refine_pose(*given, matches, 0.02)
    np.testing.assert_allclose(found[0], TRUE[0], atol=1e-6)
    np.testing.assert_allclose(centre(found) - middle, centre(TRUE), atol=1e-5)


@pytest.mark.parametrize("middle", [NEAR, FAR], ids=["near", "far"])
def test_placing_replaces_wrong_pose(middle: Float64[np.ndarray, " 3"]) -> None:
    others = [at(middle, other) for other in ring(12)]
    matches = matched(TRUE, others, 40, wrong=0.4, noise=0.3 * PIXEL, about=middle)
    given = at(middle, WRONG)
    found = estimate_pose(matches, given, PIXEL, seed=0)
    assert found is not None
    turned = Rotation.from_matrix(found[0] @ TRUE[0].T).magnitude()
    assert turned < 0.6 * PIXEL and np.linalg.norm(centre(found) - middle - centre(TRUE)) < 0.003
    again = estimate_pose(matches, given, PIXEL, seed=0)
    assert again is not None and all(np.array_equal(a, b) for a, b in zip(found, again, strict=True))


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    ("given", "partners", "count"),
    [(TRUE, 12, 40), (WRONG, 2, 100), (WRONG, 12, 4)],
    ids=["it is right", "only two others agree", "few matches"],
)
def test_placing_keeps_consistent_pose(given: Pose, partners: int, count: int) -> None:
    matches = matched(TRUE, ring(12)[:partners], count, wrong=0.2, noise=0.3 * PIXEL)
    assert estimate_pose(matches, given, PIXEL, seed=0) is None


@pytest.mark.exhaustive
def test_placing_inconsistent_matches_keep_pose() -> None:
    assert estimate_pose(matched(TRUE, ring(12), 40, wrong=1.0), WRONG, PIXEL, seed=0) is None

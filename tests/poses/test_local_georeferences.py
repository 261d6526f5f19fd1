"""Neighborhoods put to the ground by GPS: those across a fold contradict; in a right model none do."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from octasplat.engine.poses.local_georeferences import find_contradictions, fit_neighborhoods

COUNT = 72
FIRST_OF_SECOND = 40
"""Photographs from this one on are the part that a fold puts elsewhere."""
SCENE_FROM_GROUND = 0.37 * Rotation.from_euler("xyz", (20, 100, 50), degrees=True).as_matrix()
REACH = 6
"""Photographs on either side that one has matches with."""


def capture(kind: str, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return centers in meters, z up, and cam-from-ground rotations of upright photographs."""
    t = np.arange(COUNT)
    if kind == "line":  # 72 m, the camera looks to the left
        centers = np.stack([1.0 * t, 0 * t, 0 * t], axis=1)
        heading = np.full(COUNT, np.pi / 2)
    else:  # around a building, or around a thing on a table
        angle = 2 * np.pi * t / COUNT
        radius = {"loop": 20.0, "object": 1.5}[kind]
        centers = radius * np.stack([np.cos(angle), np.sin(angle), 0 * t], axis=1)
        heading = angle + np.pi
    centers = centers + rng.normal(0, 0.05, (COUNT, 3))
    pitch = rng.normal(0, 0.15, COUNT)
    ahead = np.stack(
        [np.cos(heading) * np.cos(pitch), np.sin(heading) * np.cos(pitch), np.sin(pitch)], axis=1
    )
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return centers, np.stack([right, np.cross(ahead, right), ahead], axis=1)


def links(
    rng: np.random.Generator, *, is_loop: bool, is_folded: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return pairs, the matches of each, and which are false."""
    rows = [
        (a % COUNT, b % COUNT, int(rng.integers(50, 200)) // (b - a))
        for a in range(COUNT)
        for b in range(a + 1, a + REACH + 1)
        if is_loop or b < COUNT
    ]
    pairs, strengths = np.array(rows)[:, :2], np.array(rows)[:, 2]
    if is_folded:
        is_across = (pairs >= FIRST_OF_SECOND).sum(axis=1) == 1
        pairs, strengths = pairs[~is_across], strengths[~is_across]
    false = np.array([(k, FIRST_OF_SECOND + k) for k in range(10, 20)] * is_folded, np.int64).reshape(-1, 2)
    is_false = np.arange(len(pairs) + len(false)) >= len(pairs)
    return (
        np.concatenate([pairs, false]),
        np.concatenate([strengths, rng.integers(3, 8, len(false))]),
        is_false,
    )


@pytest.mark.parametrize("fold", [None, "turned", "displaced"])
@pytest.mark.parametrize(
    ("kind", "error_m", "is_seen"),
    [
        ("line", 0.0, True),
        ("line", 1.0, True),
        ("line", 5.0, False),  # too short a walk for such an error: nothing is said
        ("loop", 0.0, True),
        ("loop", 1.0, True),
        ("loop", 5.0, False),
        ("object", 0.0, False),
        ("object", 1.0, False),
        ("object", 5.0, False),
    ],
)
def test_contradictions_are_those_across_a_fold(
    kind: str, error_m: float, is_seen: bool, fold: str | None
) -> None:
    rng = np.random.default_rng(3)
    centers, rotations = capture(kind, rng)
    ground_m = centers[:, :2] + rng.normal(0, 1, (COUNT, 2)) * error_m
    pairs, strengths, is_false = links(rng, is_loop=kind != "line", is_folded=fold is not None)
    if fold is not None:
        second = slice(FIRST_OF_SECOND, None)
        turn = Rotation.from_euler("z", 120 if fold == "turned" else 0, degrees=True).as_matrix()
        pivot = centers[FIRST_OF_SECOND + 15]
        centers[second] = (centers[second] - pivot) @ turn.T + centers[15]
        rotations[second] = rotations[second] @ turn.T
    scene, cam_from_scene = centers @ SCENE_FROM_GROUND.T, rotations @ (SCENE_FROM_GROUND / 0.37).T
    fits = fit_neighborhoods(pairs, strengths, scene, cam_from_scene, ground_m)
    is_turned, is_displaced = find_contradictions(fits, pairs, scene, ground_m)
    expected = is_false & is_seen
    np.testing.assert_array_equal(is_turned, expected & (fold == "turned"))
    np.testing.assert_array_equal(is_displaced, expected & (fold == "displaced"))
    if is_seen:
        assert fits.is_known.mean() > 0.8
        np.testing.assert_allclose(fits.scale[fits.is_known], 1 / 0.37, rtol=0.15)
        east_m = fits.predict_m(np.arange(COUNT), scene)[fits.is_known, 0]
        assert np.abs(east_m - ground_m[fits.is_known, 0]).max() < 4 * error_m + 0.5


def test_one_position_for_many_photographs_tells_nothing() -> None:
    # a telephone that writes the last fix until it has another one, the error as large as the way
    rng = np.random.default_rng(0)
    centers, rotations = capture("line", rng)
    pairs, strengths, _ = links(rng, is_loop=False, is_folded=False)
    ground_m = np.repeat(rng.normal(0, 15, (4, 2)), COUNT // 4, axis=0)
    assert not fit_neighborhoods(pairs, strengths, centers, rotations, ground_m).is_known.any()

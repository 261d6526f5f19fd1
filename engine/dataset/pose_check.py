"""Check of the poses of a model: cameras absurdly far away, and poses that several images share."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from octasplat.engine.core.errors import DatasetError
from octasplat.engine.dataset.model import SparsePoints

FAR_CAMERA_RATIO = 10.0
"""Cameras farther off than this many times what is usual in the scene are told; of ten real scenes none goes
beyond 1.6."""
BEYOND_FLOAT32 = 1e5
"""From beyond this many times what is usual, rays in float32 miss by a hundredth of the scene and more."""
_MAX_NAMES = 3


def check_poses(
    folder: Path,
    names: Sequence[str],
    rotations_cam_from_world: Float64[np.ndarray, "n 3 3"],
    translations_cam_from_world: Float64[np.ndarray, "n 3"],
    points: SparsePoints,
) -> list[str]:
    """Refuse unusable poses, and warn of suspicious ones.

    Distances are measured from the median camera. What is usual is their median, or that of the points where
    this is larger, as it is where a camera only turned.

    Args:
        folder: of the model, to be named.
        names: of the images with a pose.
        rotations_cam_from_world: their rotations.
        translations_cam_from_world: the world origin in their frames, world units.
        points: the sparse points.

    Returns:
        Warnings, a sentence each.

    Raises:
        DatasetError: all poses are one, or a camera is so far off that its rays would be noise.
    """
    if len(names) < 2:
        return []
    rotations, translations = rotations_cam_from_world, translations_cam_from_world
    centres_world = -np.einsum("nji,nj->ni", rotations, translations)
    poses = np.concatenate([rotations.reshape(-1, 9), translations], axis=1)
    return [
        *_check_shared_poses(folder, names, poses),
        *_check_far_cameras(folder, names, centres_world, points),
    ]


def _check_shared_poses(folder: Path, names: Sequence[str], poses: Float64[np.ndarray, "n 12"]) -> list[str]:
    _, groups, counts = np.unique(poses, axis=0, return_inverse=True, return_counts=True)
    if len(counts) == 1:
        raise DatasetError(
            f"All {len(names)} images of the model in {folder} have one and the same pose "
            f"({names[0]} to {names[-1]}), which shows nothing from two sides; run COLMAP again."
        )
    # NumPy 2.0 gives the inverse a second axis.
    groups = groups.reshape(-1)
    shared = np.flatnonzero(counts[groups] > 1)
    if len(shared) == 0:
        return []
    together = [names[index] for index in np.flatnonzero(groups == groups[shared[0]]).tolist()]
    return [
        f"{len(shared)} images of the model in {folder} have exactly the pose of another "
        f"({_name_list(together, ' = ')}); remove them if they were not taken from one place."
    ]


def _check_far_cameras(
    folder: Path, names: Sequence[str], centres_world: Float64[np.ndarray, "n 3"], points: SparsePoints
) -> list[str]:
    middle = np.median(centres_world, axis=0)
    distances = np.linalg.norm(centres_world - middle, axis=1)
    usual = float(np.median(distances))
    if len(points):
        usual = max(usual, float(np.median(np.linalg.norm(points.xyz_world - middle, axis=1))))
    if usual == 0:
        return []
    far = [
        int(index)
        for index in np.argsort(-distances, kind="stable")
        if distances[index] > FAR_CAMERA_RATIO * usual
    ]
    if not far:
        return []
    farthest = distances[far[0]] / usual
    named = _name_list([names[index] for index in far], ", ")
    which = named if len(far) == 1 else f"{len(far)} images ({named}) up to"
    sentence = f"The model in {folder} places {which} {farthest:,.0f} times as far from the "
    sentence += "other cameras as is usual in it"
    them = "it" if len(far) == 1 else "them"
    if farthest > BEYOND_FLOAT32:
        raise DatasetError(f"{sentence}; remove {them} from the model or run COLMAP again.")
    return [f"{sentence}; if that is wrong, remove {them} from the model."]


def _name_list(names: Sequence[str], between: str) -> str:
    return between.join(names[:_MAX_NAMES]) + (f"{between}..." if len(names) > _MAX_NAMES else "")

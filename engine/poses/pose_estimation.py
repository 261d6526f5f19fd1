"""Photographs whose given pose may be wrong, placed anew among all others; runs in COLMAP's process.

Nothing but the poses of the others is taken for granted. The features of a doubtful photograph are matched
with theirs; as these stand at known places, six matches with several of them fix the whole pose, distances
included, as between two rigs of cameras (Stewénius, Nistér, Oskarsson and Åström, "Solutions to Minimal
Generalized Relative Pose Problems", 2005). It is found by RANSAC and refined on the Sampson distances of all
matches that agree, and takes the place of the given one only if far more matches agree with it: a photograph
that is blurred, or shows a thing that has moved, stays where it is.

Not done: matches among the others, so that photographs in doubt that overlap with each other alone stay.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from octasplat.engine.core.colmap_binding import pycolmap

Pose = tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, " 3"]]
"""Rotation and translation, camera from world."""

MIN_PARTNERS = 3
"""Other photographs that must agree on where one was taken ..."""
MIN_MATCHES = 50
"""... and matches with them in all, see :class:`Matches`."""
MIN_GIVEN_INLIER_SHARE = 0.5
"""The given pose stays where it explains so many of the matches that the new one explains."""
_REFINEMENT_ROUNDS = 2
_DEGREES_OF_FREEDOM = 6  # numbers of a pose
_MAX_RANSAC_TRIALS = 5000
"""Enough where a third of the matches are true; without an end, none that are would take minutes."""


@dataclass(frozen=True, eq=False)
class Matches:
    """Matches of one photograph with others whose poses are known.

    Attributes:
        rays_cam: of the features in the photograph, at a depth of 1.
        partner_rays_cam: of those in the other ones.
        partner: index of the other one.
        rotations_cam_from_world: of the others.
        translations_cam_from_world: of the others.
    """

    rays_cam: Float64[np.ndarray, "m 3"]
    partner_rays_cam: Float64[np.ndarray, "m 3"]
    partner: Int64[np.ndarray, " m"]
    rotations_cam_from_world: Float64[np.ndarray, "p 3 3"]
    translations_cam_from_world: Float64[np.ndarray, "p 3"]

    def select(self, chosen: Bool[np.ndarray, " m"]) -> "Matches":
        """Return the matches where ``chosen`` is true."""
        return Matches(
            self.rays_cam[chosen],
            self.partner_rays_cam[chosen],
            self.partner[chosen],
            self.rotations_cam_from_world,
            self.translations_cam_from_world,
        )

    @property
    def middle_world(self) -> Float64[np.ndarray, " 3"]:
        """Return the mean of where the others stand: map coordinates are large beside the distances there."""
        centres = -np.einsum("pji,pj->pi", self.rotations_cam_from_world, self.translations_cam_from_world)
        return np.asarray(centres.mean(axis=0))

    def about(self, origin_world: Float64[np.ndarray, " 3"]) -> "Matches":
        """Return the matches in a world with its origin there."""
        moved = self.translations_cam_from_world + self.rotations_cam_from_world @ origin_world
        return replace(self, translations_cam_from_world=moved)


def sampson_distances(
    rotation_cam_from_world: Float64[np.ndarray, "3 3"],
    translation_cam_from_world: Float64[np.ndarray, " 3"],
    matches: Matches,
) -> Float64[np.ndarray, " m"]:
    """Return the signed Sampson distance of each match from a pose, in units of the focal length.

    To first order the distance that both features together must be moved (Hartley and Zisserman, "Multiple
    View Geometry", section 11.4.3).
    """
    turned = np.einsum("ij,pkj->pik", rotation_cam_from_world, matches.rotations_cam_from_world)
    moved = translation_cam_from_world - np.einsum("pij,pj->pi", turned, matches.translations_cam_from_world)
    rotation, translation = turned[matches.partner], moved[matches.partner]
    # epipolar lines in the photograph: t x R x'
    lines = np.cross(translation, np.einsum("mij,mj->mi", rotation, matches.partner_rays_cam))
    partner_lines = np.einsum("mji,mj->mi", rotation, np.cross(matches.rays_cam, translation))
    slopes = np.concatenate([lines[:, :2], partner_lines[:, :2]], axis=1)
    distances: Float64[np.ndarray, " m"] = np.sum(matches.rays_cam * lines, axis=1) / np.maximum(
        np.linalg.norm(slopes, axis=1), 1e-12
    )
    return distances


def refine_pose(
    rotation_cam_from_world: Float64[np.ndarray, "3 3"],
    translation_cam_from_world: Float64[np.ndarray, " 3"],
    matches: Matches,
    inlier_distance: float,
) -> Pose:
    """Return the pose nearby that fits best the matches within ``inlier_distance`` of the given one."""
    middle = matches.middle_world
    matches, pose = (
        matches.about(middle),
        _about((rotation_cam_from_world, translation_cam_from_world), middle),
    )
    for _ in range(_REFINEMENT_ROUNDS):
        close = matches.select(inlier_mask(pose, matches, inlier_distance))
        if len(close.partner) < _DEGREES_OF_FREEDOM:
            break
        # again with the matches that agree with the better pose
        pose = _minimise_sampson(pose, close, inlier_distance)
    return _about(pose, -middle)


def _about(pose: Pose, origin_world: Float64[np.ndarray, " 3"]) -> Pose:
    """Return a pose in a world with its origin there."""
    return pose[0], pose[1] + pose[0] @ origin_world


def _minimise_sampson(pose: Pose, matches: Matches, inlier_distance: float) -> Pose:
    """Return the pose, starting from ``pose``, that minimises the robust Sampson distances of the matches."""
    rotation, translation = pose
    # shifts in units of the distance to the others, so that all six numbers are alike in size
    size = float(np.median(np.linalg.norm(translation - matches.translations_cam_from_world, axis=1)))

    def moved(step: Float64[np.ndarray, " 6"]) -> Pose:
        return Rotation.from_rotvec(step[:3]).as_matrix() @ rotation, translation + size * step[3:]

    def distances(step: Float64[np.ndarray, " 6"]) -> Float64[np.ndarray, " m"]:
        weighed: Float64[np.ndarray, " m"] = sampson_distances(*moved(step), matches) / inlier_distance
        return weighed

    return moved(least_squares(distances, np.zeros(_DEGREES_OF_FREEDOM), loss="soft_l1", f_scale=0.25).x)


def collect_matches(
    number: int, model: Any, images: dict[int, Any], database: Path, sizes_px: Sequence[tuple[int, int]]
) -> Matches | None:
    """Return the feature matches of a photograph with others whose poses are known.

    Args:
        number: of the photograph in the database.
        model: with everybody's camera.
        images: of the model, by their numbers in the database; those whose poses are known, and this one.
        database: with features and matches.
        sizes_px: width and height of each photograph on disk; the cameras may be those of other sizes.

    Returns:
        The matches; None if there are none.
    """
    rays, partner_rays, partner = [], [], []
    partners: list[int] = []
    with pycolmap.Database.open(database) as source:

        def rays_of(which: int) -> Float64[np.ndarray, "f 3"]:
            camera = model.cameras[images[which].camera_id]
            width_px, height_px = sizes_px[which - 1]
            # keypoints are in pixels of the photograph on disk, cameras may be of another size
            scale = (camera.width / width_px, camera.height / height_px)
            flat = camera.cam_from_img(source.read_keypoints(which)[:, :2].astype(np.float64) * scale)
            return np.concatenate([flat, np.ones((len(flat), 1))], axis=1)

        if not source.exists_keypoints(number):
            return None  # nothing in it can be recognised
        all_ours = rays_of(number)
        for other in sorted(images):
            if other == number or not source.exists_two_view_geometry(number, other):
                continue
            found = source.read_two_view_geometry(number, other).inlier_matches
            pairs = np.asarray(found, dtype=np.int64).reshape(-1, 2)
            if len(pairs) == 0:
                continue
            ours, theirs = all_ours[pairs[:, 0]], rays_of(other)[pairs[:, 1]]
            known = np.isfinite(ours).all(axis=1) & np.isfinite(theirs).all(axis=1)
            rays.append(ours[known])
            partner_rays.append(theirs[known])
            partner.append(np.full(int(known.sum()), len(partners), dtype=np.int64))
            partners.append(other)
    if not partners:
        return None
    poses = [images[other].cam_from_world() for other in partners]
    return Matches(
        np.concatenate(rays),
        np.concatenate(partner_rays),
        np.concatenate(partner),
        np.stack([pose.rotation.matrix() for pose in poses]),
        np.stack([pose.translation for pose in poses]),
    )


def inlier_mask(pose: Pose, matches: Matches, inlier_distance: float) -> Bool[np.ndarray, " m"]:
    """Return which matches agree with a pose."""
    agrees: Bool[np.ndarray, " m"] = np.abs(sampson_distances(*pose, matches)) < inlier_distance
    return agrees


def is_explained_by_pose(pose: Pose, matches: Matches, inlier_distance: float) -> bool:
    """Return whether a pose explains most of the matches, and there are enough of them to decide."""
    agrees = inlier_mask(pose, matches, inlier_distance)
    return len(agrees) >= MIN_MATCHES and float(agrees.mean()) > MIN_GIVEN_INLIER_SHARE


def estimate_pose(matches: Matches, given_pose: Pose, inlier_distance: float, *, seed: int) -> Pose | None:
    """Return a corrected pose where the matches contradict the given one.

    Args:
        matches: of the photograph.
        given_pose: the pose that they may contradict.
        inlier_distance: distance at which a match agrees with a pose, see :func:`sampson_distances`.
        seed: of the search for it.

    Returns:
        The new pose; None where the given one stays.
    """
    if len(matches.partner) < MIN_MATCHES:
        return None
    middle = matches.middle_world
    matches, given_pose = matches.about(middle), _about(given_pose, middle)
    count = len(matches.rotations_cam_from_world)
    # One rig holds the others as they stand in the world, the other one the photograph; both lists are one.
    ideal = pycolmap.Camera(model="SIMPLE_PINHOLE", width=2, height=2, params=[1.0, 0.0, 0.0])
    known = [
        pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), translation)
        for rotation, translation in zip(
            matches.rotations_cam_from_world, matches.translations_cam_from_world, strict=True
        )
    ]
    options = pycolmap.RANSACOptions()
    options.max_error = inlier_distance
    options.random_seed = seed
    options.max_num_trials = _MAX_RANSAC_TRIALS
    found = pycolmap.estimate_generalized_relative_pose(
        matches.partner_rays_cam[:, :2],
        matches.rays_cam[:, :2],
        matches.partner.tolist(),
        [count] * len(matches.partner),
        [*known, pycolmap.Rigid3d()],
        [ideal] * (count + 1),
        options,
    )
    if found is None:
        return None
    pose = found["rig2_from_rig1"]
    new = refine_pose(pose.rotation.matrix(), np.asarray(pose.translation), matches, inlier_distance)
    agrees = inlier_mask(new, matches, inlier_distance)
    agreed = int(inlier_mask(given_pose, matches, inlier_distance).sum())
    partners = len(np.unique(matches.partner[agrees]))
    if (
        agrees.sum() < MIN_MATCHES
        or partners < MIN_PARTNERS
        or agreed > MIN_GIVEN_INLIER_SHARE * agrees.sum()
    ):
        return None
    return _about(new, -middle)

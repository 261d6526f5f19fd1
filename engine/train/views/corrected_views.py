"""Photographs whose poses are corrected, and the part of such corrections that moves the scene as a whole."""

from dataclasses import replace
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64
from scipy.spatial.transform import Rotation

from octasplat.engine.core.rays import RayBatch
from octasplat.engine.dataset import Camera, DatasetView
from octasplat.engine.train.sampling.pixel_sampler import (
    TrainingData,
    has_known_distances,
    known_distances,
    trained_pixels,
)
from octasplat.engine.train.views.image_alignment import RigidMotion

FIT_ROUNDS = 3
"""The common part is found for small angles, and again for what that leaves."""


@runtime_checkable
class PosedTrainingData(TrainingData, Protocol):
    """Photographs with their cameras (see :class:`octasplat.engine.dataset.Dataset`)."""

    cameras: tuple[Camera, ...]


class CorrectedDataset:
    """The same photographs seen from corrected poses; follows :class:`PosedTrainingData`.

    Views of no correction keep every bit of their rays.

    Args:
        given: the photographs as they are.

    Attributes:
        original: the given photographs.
        views: with the poses as they are corrected.
    """

    def __init__(self, given: PosedTrainingData) -> None:
        self.original = given
        self.views: tuple[DatasetView, ...] = given.views
        self.cameras = given.cameras
        self.train_indices: Int64[np.ndarray, " t"] = given.train_indices
        self.test_indices: Int64[np.ndarray, " h"] = given.test_indices
        self.has_alpha = given.has_alpha
        self.extent = given.extent
        self.has_known_distances = has_known_distances(given)
        self.trained_pixels = trained_pixels(given)
        self.set_corrections(np.zeros((len(given.views), 6)))

    def set_corrections(self, corrections: Float64[np.ndarray, "v 6"]) -> None:
        """Correct all views: the rotation vector and shift by which each camera's points move."""
        self.views = tuple(
            correct_view(view, RigidMotion.from_vector(numbers)) if numbers.any() else view
            for view, numbers in zip(self.original.views, corrections, strict=True)
        )
        pairs = list(zip(self.views, self.original.views, strict=True))
        self._moved: Bool[np.ndarray, " v"] = np.asarray(corrections.any(axis=1))
        self._turns_world = np.stack(
            [now.rotation_cam_from_world.T @ given.rotation_cam_from_world for now, given in pairs]
        )
        self._origins_world = np.stack([now.origin_world for now, _ in pairs]).astype(np.float32)

    def rays(
        self, view: Int64[np.ndarray, " r"], y: Int64[np.ndarray, " r"], x: Int64[np.ndarray, " r"]
    ) -> RayBatch:
        """Return unit rays of pixels, world frame."""
        rays = self.original.rays(view, y, x)
        moved = self._moved[view]
        if not moved.any():
            return rays
        turned = np.einsum("nij,nj->ni", self._turns_world[view], rays.directions_world)
        return replace(
            rays,
            # unmoved views keep their rays to the bit
            origins_world=np.where(moved[:, None], self._origins_world[view], rays.origins_world),
            directions_world=np.where(moved[:, None], turned, rays.directions_world),
        )

    def pixels(
        self, view: Int64[np.ndarray, " r"], y: Int64[np.ndarray, " r"], x: Int64[np.ndarray, " r"]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the pixels of the photographs."""
        return self.original.pixels(view, y, x)

    def known_distances(
        self, view: Int64[np.ndarray, " r"], y: Int64[np.ndarray, " r"], x: Int64[np.ndarray, " r"]
    ) -> Float32[np.ndarray, " r"]:
        """Return distances of the surface along the rays of pixels, world units; 0 where unknown."""
        return known_distances(self.original, view, y, x)


def correct_view(view: DatasetView, motion: RigidMotion) -> DatasetView:
    """Return a view whose camera's points have moved."""
    rotation = motion.rotation @ view.rotation_cam_from_world
    return replace(
        view,
        rotation_cam_from_world=rotation,
        translation_cam_from_world=motion.rotation @ view.translation_cam_from_world + motion.shift_cam,
    )


def remove_common_motion(
    corrections: Float64[np.ndarray, "v 6"], dataset: PosedTrainingData, used: Int64[np.ndarray, " t"]
) -> Float64[np.ndarray, "v 6"]:
    """Return the corrections without their common rotation, shift and scale of the whole scene.

    Photographs do not tell where the scene as a whole is, and views that were held out keep their places in
    it. Views of no correction have a say in what is common, but stay.

    Args:
        corrections: see :meth:`CorrectedDataset.set_corrections`.
        dataset: the photographs with their given poses.
        used: views that could be corrected.
    """
    given = [dataset.views[i] for i in used.tolist()]
    places = np.stack([view.origin_world for view in given])
    middle = places.mean(axis=0)
    common = corrections.copy()
    for _ in range(FIT_ROUNDS):
        now = [
            correct_view(v, RigidMotion.from_vector(common[i]))
            for v, i in zip(given, used.tolist(), strict=True)
        ]
        turn, shift, growth = _common_similarity(given, now, middle, dataset.extent)
        back = Rotation.from_rotvec(-turn).as_matrix()
        for old, new, index in zip(given, now, used.tolist(), strict=True):
            if not corrections[index].any():
                continue
            rotation = new.rotation_cam_from_world @ back.T
            # the inverse of the common similarity, on the camera's center
            origin = middle + back @ (new.origin_world - middle - shift) / (1 + growth)
            relative = rotation @ old.rotation_cam_from_world.T
            moved = RigidMotion(relative, -rotation @ origin - relative @ old.translation_cam_from_world)
            common[index] = moved.to_vector
    return common


def _common_similarity(
    given: list[DatasetView], now: list[DatasetView], middle: Float64[np.ndarray, "3"], extent: float
) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"], float]:
    """Return the small rotation (rad) about ``middle``, shift and relative scale nearest to all motions.

    Least squares of what is left of the turns, in rad, and of the shifts, of the extent.
    """
    jacobian = np.zeros((len(given), 6, 7))
    motions = np.zeros((len(given), 6))
    for k, (old, new) in enumerate(zip(given, now, strict=True)):
        rotation = new.rotation_cam_from_world.T @ old.rotation_cam_from_world
        motions[k, :3] = Rotation.from_matrix(rotation).as_rotvec()
        motions[k, 3:] = (new.origin_world - old.origin_world) / extent
        jacobian[k, :3, :3] = np.eye(3)
        jacobian[k, 3:, 3:6] = np.eye(3) / extent
        offset = old.origin_world - middle
        # a turn about the middle shifts a camera by turn x offset
        jacobian[k, 3:, :3] = np.cross(np.eye(3), offset).T / extent
        jacobian[k, 3:, 6] = offset / extent
    hessian = np.einsum("vik,vil->kl", jacobian, jacobian)
    diagonal = hessian.diagonal()
    ridge = np.diag(1e-9 * diagonal + 1e-12)  # against a singular matrix, as of cameras in one line
    common = np.linalg.solve(hessian + ridge, np.einsum("vik,vi->k", jacobian, motions))
    return common[:3], common[3:6], float(common[6])

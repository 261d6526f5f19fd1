"""View frusta: tests of which points lie in the image of a view."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64

from octasplat.engine.dataset.camera import Camera
from octasplat.engine.dataset.model import PosedView, Viewpoints


@dataclass(frozen=True, eq=False)
class ViewFrusta:
    """Union of the view frusta of some views, at any depth, occluded or not.

    Attributes:
        views: the views.
        cameras: their cameras.
    """

    views: Sequence[PosedView]
    cameras: Sequence[Camera]

    @classmethod
    def from_views(cls, viewpoints: Viewpoints, which: Int64[np.ndarray, " t"]) -> "ViewFrusta":
        """Return the frusta of the views ``which`` of a dataset."""
        return cls([viewpoints.views[i] for i in which.tolist()], viewpoints.cameras)

    def contains(self, xyz_world: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Return whether each point lies in any of the frusta."""
        return self.contains_often(xyz_world, 1)

    def contains_often(self, xyz_world: Float[np.ndarray, "n 3"], count: int) -> Bool[np.ndarray, " n"]:
        """Return whether each point lies in at least ``count`` of the frusta."""
        found = np.zeros(len(xyz_world), np.int64)
        for view in self.views:
            left = np.flatnonzero(found < count)
            if len(left) == 0:
                break
            in_cam = cam_from_world(xyz_world[left].astype(np.float64), view)
            found[left] += is_in_image(in_cam, self.cameras[view.camera_index])
        return np.asarray(found >= count)


def cam_from_world(xyz_world: Float64[np.ndarray, "n 3"], view: PosedView) -> Float64[np.ndarray, "n 3"]:
    """Transform world points to the camera coordinates of ``view``."""
    return rotate_vectors(xyz_world, view.rotation_cam_from_world) + view.translation_cam_from_world


def rotate_vectors(
    vectors: Float64[np.ndarray, "n 3"], rotation: Float64[np.ndarray, "3 3"]
) -> Float64[np.ndarray, "n 3"]:
    """Return ``rotation @ vector``, summed column by column: the same bits on any number of threads.

    >>> quarter_turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    >>> rotate_vectors(np.array([[1.0, 0.0, 0.0]]), quarter_turn)
    array([[0., 1., 0.]])
    """
    return np.asarray(sum(vectors[:, k, None] * rotation[:, k] for k in range(3)))


def is_in_image(in_cam: Float64[np.ndarray, "n 3"], camera: Camera) -> Bool[np.ndarray, " n"]:
    """Return whether points project into a camera's image; points behind it only for a panorama.

    >>> camera = Camera("PINHOLE", (100.0, 100.0, 50.0, 50.0), 100, 100)
    >>> is_in_image(np.array([[0.0, 0.0, 2.0], [0.0, 0.0, -2.0], [5.0, 0.0, 2.0]]), camera).tolist()
    [True, False, False]
    """
    if camera.is_panorama:
        return np.asarray(np.isfinite(camera.project(in_cam).reshape(-1, 2)).all(axis=1))
    in_front = in_cam[:, 2] > 0
    before = in_cam[in_front]
    if camera.is_pinhole:
        fx, fy, cx, cy = camera.pinhole_params
        xy = before[:, :2] / before[:, 2:] * (fx, fy) + (cx, cy)
    else:
        xy = camera.project(before).reshape(-1, 2) if len(before) else np.zeros((0, 2))
        # Far outside the picture some lens models fold back into it.
        xy[before[:, 2] < 0.98 * min_corner_cosine(camera) * np.linalg.norm(before, axis=1)] = np.nan
    with np.errstate(invalid="ignore"):
        in_front[in_front] = ((xy >= 0) & (xy <= (camera.width_px, camera.height_px))).all(axis=1)
    return in_front


def min_corner_cosine(camera: Camera) -> float:
    """Return the cosine between the camera's axis and its corner rays, at least 0.1; 0.1 if unknown."""
    width, height = float(camera.width_px), float(camera.height_px)
    corners = np.array([[0.0, 0.0], [width, 0.0], [0.0, height], [width, height]])
    cosines = camera.directions_cam(corners)[:, 2]
    return max(float(np.min(cosines)), 0.1) if np.isfinite(cosines).all() else 0.1

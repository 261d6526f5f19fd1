"""Check of whether the principal point moved between photographs, from the sparse points of a model.

A stabilised lens is shifted while a photograph is taken, and its picture with it. A model whose photographs
share one camera then has errors that are much alike all over a photograph. What part of them a small shift
of each picture would take away, the photograph turned and moved to suit, is found without solving for the
points: more than this is to be had where the points may move, too.
"""

from itertools import pairwise

import numpy as np
from jaxtyping import Float64

from octasplat.engine.dataset.camera import Camera
from octasplat.engine.dataset.image_motion import image_motion_by_pose
from octasplat.engine.dataset.model import Observations, SparsePoints, Viewpoints
from octasplat.engine.dataset.view_frusta import rotate_vectors

MIN_OBSERVATIONS = 100
"""Photographs that show fewer points are not asked, nor given a lens of their own."""
MIN_VIEWS = 8
"""From fewer photographs nothing is said."""
MIN_ERROR_RATIO = 1e-4
"""Better models need nothing: mean distance between where points are seen and where they should be, as a
share of the picture's longer side."""
MIN_GAIN = 0.05
"""From this share of the errors on, the lens is in doubt."""
_ITERATIONS = 5


def needs_per_view_principal_points(
    viewpoints: Viewpoints, points: SparsePoints, observations: Observations
) -> bool:
    """Return whether each photograph needs a principal point of its own."""
    before, after = [], []
    for view, shown in zip(
        viewpoints.views, _observations_by_view(viewpoints, points, observations), strict=True
    ):
        points_world, xy_px = shown
        camera = viewpoints.cameras[view.camera_index]
        points_cam = (
            rotate_vectors(points_world, view.rotation_cam_from_world) + view.translation_cam_from_world
        )
        errors = _reprojection_errors(points_cam, xy_px, camera)
        if errors is not None:
            side_px = max(view.width_px, view.height_px)
            before.append(errors[0] / side_px)
            after.append(errors[1] / side_px)
    if len(before) < MIN_VIEWS:
        return False
    mean, left = float(np.mean(before)), float(np.mean(after))
    return mean >= MIN_ERROR_RATIO and left <= (1 - MIN_GAIN) * mean


def _observations_by_view(
    viewpoints: Viewpoints, points: SparsePoints, observations: Observations
) -> list[tuple[Float64[np.ndarray, "k 3"], Float64[np.ndarray, "k 2"]]]:
    """Return the sparse points that each view observes (world), and their image positions (px)."""
    place, known = points.rows_of(observations.point)
    view, place, xy_px = observations.view[known], place[known], observations.xy_px[known]
    order = np.argsort(view, kind="stable")
    ends = np.searchsorted(view[order], np.arange(len(viewpoints.views) + 1))
    return [
        (points.xyz_world[place[some]].astype(np.float64), xy_px[some])
        for some in (order[begin:end] for begin, end in pairwise(ends.tolist()))
    ]


def _reprojection_errors(
    points_cam: Float64[np.ndarray, "k 3"], xy_px: Float64[np.ndarray, "k 2"], camera: Camera
) -> tuple[float, float] | None:
    """Return the mean reprojection error now, and after the best shift, rotation and translation."""
    # points behind the camera have no place in the picture
    points_cam, xy_px = points_cam[points_cam[:, 2] > 0], xy_px[points_cam[:, 2] > 0]
    away = xy_px - camera.project(points_cam)
    fine = np.isfinite(away).all(axis=1)
    points_cam, away = points_cam[fine], away[fine]
    if len(away) < MIN_OBSERVATIONS:
        return None
    flow = image_motion_by_pose(points_cam, camera, float(np.median(points_cam[:, 2])))
    # the pose's six numbers, and a shift of the picture
    slopes = np.concatenate([flow, np.broadcast_to(np.eye(2), (len(away), 2, 2))], axis=2)
    # alike in size, so that one ridge suits all
    slopes = slopes / np.sqrt(np.square(slopes).mean(axis=(0, 1)) + 1e-30)
    distances = first = np.linalg.norm(away, axis=1)
    least = max(float(np.median(first)), 1e-9)
    for _ in range(_ITERATIONS):  # what lies far off counts little
        weights = 1 / np.maximum(distances, least)
        curvature = np.einsum("nck,ncl,n->kl", slopes, slopes, weights)
        downhill = np.einsum("nck,nc,n->k", slopes, away, weights)
        # against a singular system, as of points in one plane
        ridge = 1e-9 * np.trace(curvature) * np.eye(len(curvature))
        motion = np.linalg.solve(curvature + ridge, downhill)
        distances = np.linalg.norm(away - np.einsum("nck,k->nc", slopes, motion), axis=1)
    return float(first.mean()), float(distances.mean())

"""Which side of each Gaussian is its outer one: the side from which the training views see it.

A flat Gaussian has no side of its own. Where one is known, the blend of a ray that grazes an outline can tell
what has just turned away from the viewer from what has not (``flip_normal_cos`` of
:class:`octasplat.engine.trace.protocol.TraceSettings`).
"""

import numpy as np
from jaxtyping import Bool, Float64, Int32, Int64

from octasplat.engine.core.rays import RayBatch
from octasplat.engine.dataset.view_frusta import cam_from_world, is_in_image
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.trace.protocol import TraceGradients, Tracer
from octasplat.engine.train.sampling.batches import grid_pixels
from octasplat.engine.train.sampling.pixel_sampler import TrainingData, view_sizes_px
from octasplat.engine.train.views.corrected_views import PosedTrainingData

GRID_TILES = 6
"""So many tiles of a view each way tell who sees what.

See :func:`octasplat.engine.train.sampling.batches.grid_pixels`.
"""
VIEWS_PER_TRACE = 8
VISIBLE_TRANSMITTANCE = 0.5
"""A view sees a Gaussian to whose mean at least this much of the light from the camera gets through."""
VISIBILITY_GAP = 0.005
"""How far before the mean that way ends, as a share of its length: so much may a surface be uneven."""
MAX_VISIBILITY_RAYS = 1 << 18
"""So many of these ways are traced at once."""


def orient_normals(
    gaussians: FlatGaussians, dataset: TrainingData, indices: Int64[np.ndarray, " v"], tracer: Tracer
) -> Int32[np.ndarray, " t"]:
    """Turn Gaussians over, in place, that are mostly seen from behind.

    Those whose normal points away from the views in which they weigh most are looked at more closely: a
    surface that few views see at grazing angles weighs less in these than in the many views on the other side
    that see it faintly through what hides it. Such a Gaussian is turned only where most of the views that see
    its mean unhidden see it from behind; one that no view sees so stays as it is. What lies outside of a
    picture is not seen: a camera that looks elsewhere may stand behind what no view has seen from there.

    A Gaussian that is turned looks as before: only its normal points the other way.

    Args:
        gaussians: with a normal each.
        dataset: whose views look at them.
        indices: of these views.
        tracer: built around the Gaussians, with three features or more; their values do not matter. Call its
            ``refresh`` afterwards.

    Returns:
        Numbers of those that were turned, ascending.
    """
    towards = np.zeros((len(gaussians), 3))
    for start in range(0, len(indices), VIEWS_PER_TRACE):
        towards += _summed_view_directions(
            len(gaussians), dataset, indices[start : start + VIEWS_PER_TRACE], tracer
        )
    normals = gaussians.rotations[:, :, 0].astype(np.float64)
    candidates = np.flatnonzero((normals * towards).sum(axis=1) < 0).astype(np.int32)
    towards_seen = _summed_unhidden_directions(gaussians, candidates, dataset, indices, tracer)
    flipped_ids = candidates[(normals[candidates] * towards_seen).sum(axis=1) < 0]
    gaussians.quats_wxyz[flipped_ids] = _flip_frames(gaussians.quats_wxyz[flipped_ids])
    return flipped_ids


def _summed_view_directions(
    count: int, dataset: TrainingData, indices: Int64[np.ndarray, " v"], tracer: Tracer
) -> Float64[np.ndarray, "n 3"]:
    """Return for each Gaussian the directions to the cameras, summed by its weight in their pictures.

    That is what the backward pass makes of directions given as gradients of features.
    """
    rays = dataset.rays(*grid_pixels(indices, view_sizes_px(dataset), GRID_TILES))
    seen = tracer.trace(rays, record=True)
    assert seen.recording is not None
    by_features = np.zeros_like(seen.features)
    by_features[:, :3] = -rays.directions_world
    given = TraceGradients(rgb_srgb=np.zeros((len(rays), 3), np.float32), features=by_features)
    found = tracer.backward(seen.recording, given).numpy()
    sums = np.zeros((count, 3))
    sums[found.ids] = found.features[:, :3]
    return sums


def _view_origins(dataset: TrainingData, indices: Int64[np.ndarray, " v"]) -> Float64[np.ndarray, "v 3"]:
    """Return where the cameras of views stand."""
    corner = np.zeros(len(indices), np.int64)
    origins = dataset.rays(indices, corner, corner).origins_world.astype(np.float64)
    return np.broadcast_to(origins, (len(indices), 3))


def _summed_unhidden_directions(
    gaussians: FlatGaussians,
    ids: Int32[np.ndarray, " c"],
    dataset: TrainingData,
    indices: Int64[np.ndarray, " v"],
    tracer: Tracer,
) -> Float64[np.ndarray, "c 3"]:
    """Return for each Gaussian the sum of the unit directions to the cameras that see its mean unhidden."""
    sums = np.zeros((len(ids), 3))
    if len(indices) == 0:
        return sums
    origins_world = _view_origins(dataset, indices)
    most = max(1, MAX_VISIBILITY_RAYS // len(indices))
    for start in range(0, len(ids), most):
        means_world = gaussians.means_world[ids[start : start + most]].astype(np.float64)
        rows, views = np.nonzero(_is_in_pictures(means_world, dataset, indices))
        if len(rows) == 0:
            continue
        cameras = origins_world[views]
        ways = RayBatch.between(cameras, means_world[rows])
        clear = RayBatch(cameras, ways.directions_world, 0.0, (1 - VISIBILITY_GAP) * ways.t_max)
        is_seen = tracer.transmittance(clear) >= VISIBLE_TRANSMITTANCE
        towards = -ways.directions_world[is_seen].astype(np.float64)
        for axis in range(3):
            sums[start : start + most, axis] = np.bincount(
                rows[is_seen], weights=towards[:, axis], minlength=len(means_world)
            )
    return sums


def _is_in_pictures(
    points_world: Float64[np.ndarray, "p 3"], dataset: TrainingData, indices: Int64[np.ndarray, " v"]
) -> Bool[np.ndarray, "p v"]:
    """Return which points lie in the pictures of which views, in all where the cameras are not known."""
    found = np.ones((len(points_world), len(indices)), np.bool_)
    if isinstance(dataset, PosedTrainingData):
        for place, index in enumerate(indices.tolist()):
            view = dataset.views[index]
            in_cam = cam_from_world(points_world, view)
            found[:, place] = is_in_image(in_cam, dataset.cameras[view.camera_index])
    return found


def _flip_frames(quats_wxyz: np.ndarray) -> np.ndarray:
    """Return frames after half a turn about the first axis in the plane, which octagons do not show."""
    w, x, y, z = quats_wxyz.T
    return np.stack([-y, -z, w, x], axis=-1)

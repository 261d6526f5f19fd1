"""Which side of each Gaussian is its outer one: the side from which the training views see it.

A flat Gaussian has no side of its own. Where one is known, the blend of a ray that grazes an outline can tell
what has just turned away from the viewer from what has not (``flip_normal_cos`` of
:class:`octasplat.engine.trace.protocol.TraceSettings`).
"""

import numpy as np
from jaxtyping import Float64, Int32, Int64

from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.trace.protocol import TraceGradients, Tracer
from octasplat.engine.train.sampling.batches import grid_pixels
from octasplat.engine.train.sampling.pixel_sampler import TrainingData, view_sizes_px

GRID_TILES = 6
"""So many tiles of a view each way tell who sees what.

See :func:`octasplat.engine.train.sampling.batches.grid_pixels`.
"""
VIEWS_PER_TRACE = 8


def orient_normals(
    gaussians: FlatGaussians, dataset: TrainingData, indices: Int64[np.ndarray, " v"], tracer: Tracer
) -> Int32[np.ndarray, " t"]:
    """Turn Gaussians over, in place, that are mostly seen from behind.

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
    flipped_ids = np.flatnonzero((normals * towards).sum(axis=1) < 0).astype(np.int32)
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


def _flip_frames(quats_wxyz: np.ndarray) -> np.ndarray:
    """Return frames after half a turn about the first axis in the plane, which octagons do not show."""
    w, x, y, z = quats_wxyz.T
    return np.stack([-y, -z, w, x], axis=-1)

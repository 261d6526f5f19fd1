"""Colors and materials of surface points, baked from the cameras that see them best."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64

from octasplat.engine.core.rays import RayBatch
from octasplat.engine.geometry.triangle_mesh import TriangleMesh
from octasplat.engine.render.pinhole_camera import PinholeCamera
from octasplat.engine.surface.occlusion import Occluder
from octasplat.engine.trace.protocol import Tracer, TraceResult

Progress = Callable[[int, int], None]
VIEWS_PER_POINT = 3
POINTS_PER_BATCH = 1 << 15
MIN_COSINE = 0.1
UNSEEN_VALUE = 0.5
MIN_ALPHA = 0.25
"""Rays that the scene covers less than this say nothing of its color."""


@dataclass(frozen=True)
class BakeTarget:
    """Quantity that is baked from traced rays.

    Attributes:
        width: how many numbers.
        read: takes them from a trace; what shows through the scene is none of it. Rays that met nothing may
            give anything.
    """

    width: int
    read: Callable[[TraceResult], Float32[np.ndarray, "r c"]]


COLOR_TARGET = BakeTarget(3, lambda traced: np.clip(traced.rgb_srgb / traced.alpha[:, None], 0.0, 1.0))
"""Display values."""


def bake(
    points_world: Float32[np.ndarray, "n 3"],
    normals_world: Float32[np.ndarray, "n 3"],
    mesh: TriangleMesh,
    cameras: Sequence[PinholeCamera],
    tracer: Tracer,
    look: BakeTarget,
    tolerance: float,
    progress: Progress = lambda _done, _total: None,
) -> tuple[Float32[np.ndarray, "n c"], Bool[np.ndarray, " n"]]:
    """Trace the scene from the best cameras to points on its surface and average what they see.

    The best cameras of a point are those that have it in their image, unhidden by the mesh, and look at it
    most squarely and from nearby. What they see is averaged with the squares of that measure as weights.

    Args:
        points_world: where something is to be known.
        normals_world: unit normals there, outwards.
        mesh: the surface, which hides points from cameras.
        cameras: candidates.
        tracer: with the scene built.
        look: what.
        tolerance: surface this near to a point (world units) does not hide it.
        progress: called with (points done, total).

    Returns:
        The means, 0.5 where no camera sees the point, and whether one does.
    """
    occluder = Occluder(mesh)
    means: list[np.ndarray] = []
    visible: list[np.ndarray] = []
    progress(0, len(points_world))
    for start in range(0, len(points_world), POINTS_PER_BATCH):
        part = slice(start, start + POINTS_PER_BATCH)
        choice, weights = _best_cameras(
            points_world[part].astype(np.float64), normals_world[part], cameras, occluder, tolerance
        )
        mean, met = _weighted_means(
            points=points_world[part],
            choice=choice,
            weights=weights,
            cameras=cameras,
            tracer=tracer,
            look=look,
        )
        means.append(mean)
        visible.append(met)
        progress(min(start + POINTS_PER_BATCH, len(points_world)), len(points_world))
    return np.concatenate(means), np.concatenate(visible)


def _best_cameras(
    points: Float64[np.ndarray, "n 3"],
    normals: Float32[np.ndarray, "n 3"],
    cameras: Sequence[PinholeCamera],
    occluder: Occluder,
    tolerance: float,
) -> tuple[np.ndarray, Float32[np.ndarray, "n k"]]:
    """Return the best cameras of each point and their weights, 0 where there are fewer."""
    count = len(points)
    choice = np.zeros((count, VIEWS_PER_POINT), np.int32)
    weights = np.zeros((count, VIEWS_PER_POINT), np.float32)
    for number, camera in enumerate(cameras):
        way = camera.centre_world - points
        length = np.maximum(np.linalg.norm(way, axis=1), 1e-12)
        cosine = np.sum(way * normals, axis=1) / length
        xy = camera.project(points)
        with np.errstate(invalid="ignore"):
            inside = ((xy >= 0) & (xy < [camera.width_px, camera.height_px])).all(axis=1)
        # Pixels per length on the surface, up to a factor that all cameras of one scene share more or less.
        merit = np.where(inside & (cosine > MIN_COSINE), cosine * camera.fy_px / length, 0.0)
        better = np.flatnonzero(merit > weights[:, -1])  # better than the worst of the best so far
        if len(better) == 0:
            continue
        viewers = np.broadcast_to(camera.centre_world, (len(better), 3))
        better = better[occluder.is_visible(points[better], viewers, tolerance)]
        weights[better, -1], choice[better, -1] = merit[better], number
        order = np.argsort(-weights[better], axis=1, kind="stable")
        weights[better] = np.take_along_axis(weights[better], order, axis=1)
        choice[better] = np.take_along_axis(choice[better], order, axis=1)
    return choice, weights


def _weighted_means(
    points: Float32[np.ndarray, "n 3"],
    choice: np.ndarray,
    weights: Float32[np.ndarray, "n k"],
    cameras: Sequence[PinholeCamera],
    tracer: Tracer,
    look: BakeTarget,
) -> tuple[Float32[np.ndarray, "n c"], Bool[np.ndarray, " n"]]:
    centres = np.stack([camera.centre_world for camera in cameras]).astype(np.float32)
    near_world = np.array([camera.near_world for camera in cameras], np.float32)
    total = np.zeros((len(points), look.width))
    sums = np.zeros(len(points))
    for k in range(choice.shape[1]):
        used = np.flatnonzero(weights[:, k] > 0)
        if len(used) == 0:
            continue
        # Rays of one camera side by side, so that the tracer can follow neighbours together.
        used = used[np.argsort(choice[used, k], kind="stable")]
        origins = centres[choice[used, k]]
        way = points[used] - origins
        directions = way / np.linalg.norm(way, axis=1, keepdims=True)
        traced = tracer.trace(RayBatch(origins, directions, near_world[choice[used, k]]))
        # rays that met nothing divide by an alpha of 0; they are left out below
        with np.errstate(invalid="ignore", divide="ignore"):
            values = look.read(traced)
        solid = traced.alpha >= MIN_ALPHA
        # squares favor the best camera
        weight = weights[used[solid], k].astype(np.float64) ** 2
        total[used[solid]] += weight[:, None] * values[solid]
        sums[used[solid]] += weight
    is_visible = sums > 0
    mean = np.full(total.shape, UNSEEN_VALUE)
    mean[is_visible] = total[is_visible] / sums[is_visible, None]
    return mean.astype(np.float32), is_visible

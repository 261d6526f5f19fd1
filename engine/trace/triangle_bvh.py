"""Rays through triangle meshes, by Embree: first hits and occlusion."""

from dataclasses import dataclass

import numba
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int32

from octasplat.engine.core.compilation import run_ranges
from octasplat.engine.core.rays import RayBatch
from octasplat.engine.trace.cpu.memory import aligned_empty
from octasplat.engine.trace.embree import (
    EmbreeDevice,
    EmbreeTriangleScene,
    intersect8_address,
    occluded8_address,
)
from octasplat.engine.trace.kernels.triangles import (
    LANES,
    SCRATCH_ROWS,
    EmbreeQuery,
    TriangleHitArrays,
    TriangleRays,
    write_any_hits,
    write_closest_hits,
)


@dataclass(frozen=True)
class TriangleHits:
    """First hits of ``r`` rays.

    Attributes:
        distances: in lengths of the ray's direction; infinite where a ray meets nothing.
        faces: row of the face; -1 where a ray meets nothing.
        barycentrics: weights of the face's second and third corner; the first corner has the rest.
    """

    distances: Float32[np.ndarray, " r"]
    faces: Int32[np.ndarray, " r"]
    barycentrics: Float32[np.ndarray, "r 2"]

    @property
    def is_hit(self) -> Bool[np.ndarray, " r"]:
        """Return whether each ray hits anything."""
        return self.faces >= 0


class TriangleBvh:
    """Hierarchy of a triangle mesh; both sides of a triangle are hit.

    Directions may have any length. A ray's result depends on the ray and the mesh alone.

    Args:
        vertices_world: corners.
        faces: rows of three corners; none at all is a scene that is never hit.
        threads: threads for building and tracing; 0 takes all that numba has. With 1 the methods may be
            called from several threads at once.
        is_watertight: whether a ray that meets an edge exactly never slips through between its triangles;
            without, other rays take less time.

    >>> corner = TriangleBvh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]]))
    >>> towards = np.full((1, 3), 2.0, np.float32)
    >>> float(corner.closest(RayBatch(np.zeros((1, 3)), towards)).distances[0] * 6)
    1.0
    >>> corner.occluded(RayBatch(np.zeros((1, 3)), towards, t_max=0.1)).tolist()
    [False]

    Raises:
        ValueError: a face names a vertex that is not there.
    """

    def __init__(
        self,
        vertices_world: Float[np.ndarray, "v 3"],
        faces: Int[np.ndarray, "f 3"],
        *,
        threads: int = 0,
        is_watertight: bool = True,
    ) -> None:
        count = len(vertices_world)
        if len(faces) and not 0 <= faces.min() <= faces.max() < count:
            raise ValueError(f"a face names a vertex that is not among the {count} of the mesh")
        self._threads = threads or int(numba.config.NUMBA_NUM_THREADS)
        self._scene = EmbreeTriangleScene(
            EmbreeDevice(self._threads), vertices_world, faces, is_watertight=is_watertight
        )

    def closest(self, rays: RayBatch) -> TriangleHits:
        """Return the nearest triangle between ``t_min`` and ``t_max`` of each ray."""
        count = len(rays)
        out = TriangleHitArrays(
            np.empty(count, np.float32), np.empty(count, np.int32), np.empty((count, 2), np.float32)
        )
        scratch = self._allocate_scratch(count)
        run_ranges(
            write_closest_hits, self._threads, len(scratch),
            self.closest_query, _ray_arrays(rays), scratch, out, grain=1,
        )  # fmt: skip
        return TriangleHits(*out)

    def occluded(self, rays: RayBatch) -> Bool[np.ndarray, " r"]:
        """Return whether any triangle lies between ``t_min`` and ``t_max``; cheaper than :meth:`closest`."""
        found = np.empty(len(rays), np.bool_)
        scratch = self._allocate_scratch(len(rays))
        run_ranges(
            write_any_hits, self._threads, len(scratch),
            self.any_query, _ray_arrays(rays), scratch, found, grain=1,
        )  # fmt: skip
        return found

    @property
    def closest_query(self) -> EmbreeQuery:
        """Return the query for kernels' first hits; valid while this object lives."""
        return EmbreeQuery(intersect8_address(), self._scene.handle)

    @property
    def any_query(self) -> EmbreeQuery:
        """Return the query for kernels' occlusion tests; valid while this object lives."""
        return EmbreeQuery(occluded8_address(), self._scene.handle)

    def _allocate_scratch(self, rays: int) -> Float32[np.ndarray, "c w"]:
        # one row a thread, and one chunk of rays for each
        return allocate_embree_scratch(max(1, min(rays, self._threads)))


_ALL_RAYS = np.empty(0, np.int32)


def allocate_embree_scratch(chunks: int) -> Float32[np.ndarray, "c w"]:
    """Return buffers for Embree calls in kernels, one row per parallel call."""
    return aligned_empty((chunks, SCRATCH_ROWS * LANES))


def _ray_arrays(rays: RayBatch) -> TriangleRays:
    return TriangleRays(rays.origins_world, rays.directions_world, rays.t_min, rays.t_max, _ALL_RAYS)

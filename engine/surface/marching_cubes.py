"""The surface of a sparse volume, by marching cubes (Lorensen and Cline 1987)."""

import numpy as np

from octasplat.engine.core.compilation import run_ranges
from octasplat.engine.core.errors import ConfigError
from octasplat.engine.core.threads import threads_in_use
from octasplat.engine.geometry.triangle_mesh import TriangleMesh
from octasplat.engine.surface.kernels.marching_cubes import (
    VolumeArrays,
    count_block_elements,
    place_triangles,
    place_vertices,
)
from octasplat.engine.surface.marching_cubes_table import EDGES, marching_table
from octasplat.engine.surface.tsdf_volume import BLOCKS_PER_THREAD, TsdfVolume


def marching_cubes(volume: TsdfVolume, min_weight: float) -> TriangleMesh:
    """Return the triangles of the zero level set, wound as seen from positive distances.

    Cells with a corner that has collected less than ``min_weight`` are left out, which leaves holes where
    nothing was seen. Elsewhere the mesh is closed: vertices are shared, and every edge has two triangles.

    Raises:
        ConfigError: there is no surface.
    """
    edge_table, triangle_counts = marching_table()
    edge_corners = np.array(EDGES, np.int32)
    count = len(volume.blocks)
    arrays = VolumeArrays(
        volume.table, volume.blocks, volume.values, volume.weights, float(np.float32(min_weight))
    )
    threads = threads_in_use()
    crossed = np.empty(volume.values.shape, np.uint8)
    vertex_counts, face_counts = np.empty(count, np.int64), np.empty(count, np.int64)
    run_ranges(
        count_block_elements, threads, count,
        arrays, triangle_counts, crossed, vertex_counts, face_counts, grain=BLOCKS_PER_THREAD,
    )  # fmt: skip
    if face_counts.sum() == 0:
        raise ConfigError(
            "No surface was found in the region to mesh; name another with --box, or ask for less "
            "certainty with --min-weight."
        )
    if max(vertex_counts.sum(), face_counts.sum()) >= 2**31 - 1:
        raise ConfigError("The surface has more than two thousand million parts; choose larger voxels.")
    # exclusive sums: where each block's elements begin
    vertex_starts = np.cumsum(vertex_counts) - vertex_counts
    face_starts = np.cumsum(face_counts) - face_counts
    first = np.empty(volume.values.shape, np.int32)
    points = np.empty((int(vertex_counts.sum()), 3), np.float32)
    run_ranges(
        place_vertices, threads, count,
        arrays, crossed, vertex_starts, first, points, grain=BLOCKS_PER_THREAD,
    )  # fmt: skip
    faces = np.empty((int(face_counts.sum()), 3), np.int32)
    run_ranges(
        place_triangles, threads, count, arrays,
        edge_corners, edge_table, triangle_counts, crossed, first, face_starts, faces,
        grain=BLOCKS_PER_THREAD,
    )  # fmt: skip
    world = volume.region.world_from_grid(points).astype(np.float32)
    # Only the vertices that a cell with all its corners uses.
    return TriangleMesh(world, faces).select_faces(np.arange(len(faces)))

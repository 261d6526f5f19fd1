"""The surface of a sparse volume, by marching cubes (Lorensen and Cline 1987)."""

import numpy as np

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.geometry.triangle_mesh import TriangleMesh
from octasplat.engine.surface.kernels.marching_cubes import (
    count_block_elements,
    place_triangles,
    place_vertices,
)
from octasplat.engine.surface.marching_cubes_table import EDGES, marching_table
from octasplat.engine.surface.tsdf_volume import TsdfVolume


def marching_cubes(volume: TsdfVolume, min_weight: float) -> TriangleMesh:
    """The triangles where the signed distance is zero, as seen from where it is positive.

    Cells with a corner that has collected less than ``min_weight`` are left out, which leaves holes where
    nothing was seen. Elsewhere the mesh is closed: vertices are shared, and every edge has two triangles.

    Raises:
        ConfigError: there is no surface.
    """
    edge_table, triangle_counts = marching_table()
    edge_corners = np.array(EDGES, np.int32)
    count = len(volume.blocks)
    of_volume = (volume.table, volume.blocks, volume.values, volume.weights, np.float32(min_weight))
    crossed = np.empty(volume.values.shape, np.uint8)
    vertex_counts, face_counts = np.empty(count, np.int64), np.empty(count, np.int64)
    count_block_elements(*of_volume, triangle_counts, crossed, vertex_counts, face_counts)
    if face_counts.sum() == 0:
        raise ConfigError(
            "No surface was found in the region to mesh; name another with --bounds, or ask for less "
            "certainty with --min-weight."
        )
    if max(vertex_counts.sum(), face_counts.sum()) >= 2**31 - 1:
        raise ConfigError("The surface has more than two thousand million parts; choose larger voxels.")
    vertex_starts = np.cumsum(vertex_counts) - vertex_counts
    face_starts = np.cumsum(face_counts) - face_counts
    first = np.empty(volume.values.shape, np.int32)
    points = np.empty((int(vertex_counts.sum()), 3), np.float32)
    place_vertices(*of_volume, crossed, vertex_starts, first, points)
    faces = np.empty((int(face_counts.sum()), 3), np.int32)
    place_triangles(*of_volume, edge_corners, edge_table, triangle_counts, crossed, first, face_starts, faces)
    world = volume.region.world_from_grid(points).astype(np.float32)
    # Only the vertices that a cell with all its corners uses.
    return TriangleMesh(world, faces).select_faces(np.arange(len(faces)))

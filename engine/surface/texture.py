"""UV unwrapping of a mesh into a square texture, and the surface points of its texels."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int32
from scipy.ndimage import distance_transform_edt
from scipy.sparse import coo_matrix

from octasplat.engine.geometry.triangle_mesh import TriangleMesh, directed_edges
from octasplat.engine.surface.kernels.rasterize import rasterise
from octasplat.engine.surface.unwrap_process import unwrap_in_process

PADDING_PX = 2
SMOOTHING_ROUNDS = 20
SMOOTHING_STEPS = (0.5, -0.53)
"""There and a little further back, so that nothing shrinks."""


@dataclass(frozen=True)
class TextureLayout:
    """The layout of a surface in its texture.

    Attributes:
        mesh: the mesh cut along the seams, with texture coordinates.
        side_px: of the square image.
        rows: row of each pixel that shows surface.
        columns: column of each such pixel.
        corners: vertices of the triangle that each such pixel shows.
        weights: how much each of them counts in its middle.
    """

    mesh: TriangleMesh
    side_px: int
    rows: np.ndarray
    columns: np.ndarray
    corners: Int32[np.ndarray, "n 3"]
    weights: Float64[np.ndarray, "n 3"]

    def interpolate(self, of_vertices: Float32[np.ndarray, "v c"]) -> Float64[np.ndarray, "n c"]:
        """Return vertex attributes, interpolated at the texels' centres."""
        return np.asarray(sum(self.weights[:, k, None] * of_vertices[self.corners[:, k]] for k in range(3)))

    @property
    def points_world(self) -> Float32[np.ndarray, "n 3"]:
        """Return the surface points at the texels' centres."""
        return self.interpolate(self.mesh.vertices_world).astype(np.float32)

    @property
    def normals_world(self) -> Float32[np.ndarray, "n 3"]:
        """Return the unit normals at the texels' centres."""
        bent = self.interpolate(self.mesh.vertex_normals())
        return (bent / np.maximum(np.linalg.norm(bent, axis=1, keepdims=True), 1e-12)).astype(np.float32)

    def image(self, values: Float32[np.ndarray, "n c"]) -> Float32[np.ndarray, "h w c"]:
        """Return texel values as an image; texels without surface copy their nearest."""
        shape = (self.side_px, self.side_px)
        image = np.zeros((*shape, values.shape[1]), np.float32)
        known = np.zeros(shape, dtype=bool)
        image[self.rows, self.columns] = values
        known[self.rows, self.columns] = True
        if known.any():
            rows, columns = distance_transform_edt(~known, return_distances=False, return_indices=True)
            image = image[rows, columns]
        return image


def unwrap(mesh: TriangleMesh, side_px: int) -> TextureLayout:
    """Unwrap a mesh into a square of ``side_px`` pixels (by xatlas).

    It is cut where a smooth surface of its shape would be: along its own creases, one that was measured falls
    into hundreds of scraps, on which nobody can paint.

    Raises:
        ExportError: xatlas failed.
    """
    smooth = smooth_mesh(mesh)
    atlas = unwrap_in_process(
        smooth.vertices_world,
        mesh.faces.astype(np.uint32),
        smooth.vertex_normals(),
        resolution_px=side_px,
        padding_px=PADDING_PX,
    )
    # xatlas picks a scale at which everything fits about; the image may come out a little larger or smaller.
    normals = mesh.vertex_normals()
    uv = atlas.uv.astype(np.float64) * atlas.size_px / atlas.size_px.max()  # in units of the longer side
    cut = TriangleMesh(
        mesh.vertices_world[atlas.origin], atlas.faces.astype(np.int32), uv=uv.astype(np.float32),
        normals_world=normals[atlas.origin],
    )  # fmt: skip
    owner = np.full((side_px, side_px), -1, np.int32)
    weights = np.zeros((side_px, side_px, 2), np.float32)
    rasterise(uv * side_px, cut.faces, owner, weights)
    rows, columns = np.nonzero(owner >= 0)
    others = weights[rows, columns].astype(np.float64)
    first = 1 - others.sum(axis=1, keepdims=True)
    corners = cut.faces[owner[rows, columns]]
    return TextureLayout(
        mesh=cut,
        side_px=side_px,
        rows=rows,
        columns=columns,
        corners=corners,
        weights=np.concatenate([first, others], axis=1),
    )


def smooth_mesh(mesh: TriangleMesh) -> TriangleMesh:
    """Return the smoothed mesh, its size preserved.

    "A signal processing approach to fair surface design" (Taubin 1995,
    https://doi.org/10.1145/218380.218473).
    """
    count, edges = len(mesh.vertices_world), directed_edges(mesh.faces)
    ends = np.concatenate([edges, edges[:, ::-1]]).T
    beside = coo_matrix((np.ones(ends.shape[1]), tuple(ends)), (count, count)).tocsr()
    beside.data[:] = 1.0  # an edge of two triangles is there twice
    neighbours = np.maximum(np.asarray(beside.sum(axis=1)), 1.0)
    points = mesh.vertices_world.astype(np.float64)
    for _ in range(SMOOTHING_ROUNDS):
        for step in SMOOTHING_STEPS:
            points = points + step * (beside @ points / neighbours - points)
    return TriangleMesh(points.astype(np.float32), mesh.faces)

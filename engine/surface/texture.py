"""A mesh cut open and laid out in a square image, and the surface points of the image's pixels."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32
from scipy.ndimage import distance_transform_edt

from engine.colour import to_bytes
from engine.surface.kernels_texture import rasterise
from engine.surface.mesh import TriangleMesh

PADDING_PX = 2


@dataclass(frozen=True)
class TextureLayout:
    """Where the surface lies in its texture.

    Attributes:
        mesh: the mesh cut along the seams, with texture coordinates.
        rows: row of each pixel that shows surface.
        columns: column of each such pixel.
        points_world: the surface point in its middle.
        normals_world: the unit normal there.
    """

    mesh: TriangleMesh
    rows: np.ndarray
    columns: np.ndarray
    points_world: Float32[np.ndarray, "n 3"]
    normals_world: Float32[np.ndarray, "n 3"]


def lay_out(mesh: TriangleMesh, side_px: int) -> TextureLayout:
    """Unwrap a mesh into a square of ``side_px`` pixels (by xatlas)."""
    import xatlas

    atlas = xatlas.Atlas()
    atlas.add_mesh(mesh.vertices_world, mesh.faces.astype(np.uint32), mesh.vertex_normals())
    charts, packing = xatlas.ChartOptions(), xatlas.PackOptions()
    packing.resolution, packing.padding, packing.bilinear = side_px, PADDING_PX, True
    atlas.generate(charts, packing)
    origin, faces, uv = atlas[0]
    # xatlas picks a scale at which everything fits about; the image may come out a little larger or smaller.
    uv = uv.astype(np.float64) * [atlas.width, atlas.height] / max(atlas.width, atlas.height)
    normals = mesh.vertex_normals()[origin]
    cut = TriangleMesh(mesh.vertices_world[origin], faces.astype(np.int32), uv=uv.astype(np.float32))
    owner = np.full((side_px, side_px), -1, np.int32)
    weights = np.zeros((side_px, side_px, 2), np.float32)
    rasterise(uv * side_px, cut.faces, owner, weights)
    rows, columns = np.nonzero(owner >= 0)
    corners = cut.faces[owner[rows, columns]]
    b, c = weights[rows, columns].T[:, :, None]
    a = 1 - b - c
    points, bent = (
        a * of[corners[:, 0]] + b * of[corners[:, 1]] + c * of[corners[:, 2]]
        for of in (cut.vertices_world, normals)
    )
    bent /= np.maximum(np.linalg.norm(bent, axis=1, keepdims=True), 1e-12)
    return TextureLayout(cut, rows, columns, points.astype(np.float32), bent.astype(np.float32))


def with_texture(layout: TextureLayout, rgb_srgb: Float32[np.ndarray, "n 3"], side_px: int) -> TriangleMesh:
    """The laid-out mesh with its texture; pixels that show nothing copy their nearest."""
    image = np.zeros((side_px, side_px, 3), np.float32)
    known = np.zeros((side_px, side_px), dtype=bool)
    image[layout.rows, layout.columns] = rgb_srgb
    known[layout.rows, layout.columns] = True
    if known.any():
        rows, columns = distance_transform_edt(~known, return_distances=False, return_indices=True)
        image = image[rows, columns]
    return replace(layout.mesh, texture_srgb=to_bytes(image))

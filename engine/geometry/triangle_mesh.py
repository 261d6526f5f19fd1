"""A triangle mesh with colors, and measurements of it."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, Int64, UInt8

from octasplat.engine.core.georeference import Georeference
from octasplat.engine.core.local_origin import NO_ORIGIN, Origin


@dataclass(frozen=True)
class MaterialMaps:
    """Material textures of a lit surface besides its base color, in the same layout.

    Attributes:
        occlusion_roughness_metallic: in red the share of the light from all around that arrives, roughness
            in green, metallic in blue, each as it means.
        normals: (n + 1) / 2 of unit normals along the tangent, the bitangent and the normal of the surface.
        tangents: of the vertices: unit vectors in the world along which u grows, and the side (1 or -1) of
            normal x tangent on which the bitangent lies, which points up in the image.
        light_frame: right, up and forward of the light around it, as rows in the world.
    """

    occlusion_roughness_metallic: UInt8[np.ndarray, "h w 3"]
    normals: UInt8[np.ndarray, "h w 3"]
    tangents: Float32[np.ndarray, "n 4"]
    light_frame: Float64[np.ndarray, "3 3"]


@dataclass(frozen=True)
class TriangleMesh:
    """Triangles in the world frame; corners run anticlockwise as seen from outside.

    Attributes:
        vertices_world: positions.
        faces: vertex indices.
        rgb_srgb: display colors of the vertices in [0, 1]; None before they are baked.
        uv: texture coordinates of the vertices, (0, 0) at the upper left of the image as in glTF; None
            without a texture.
        texture_srgb: the texture's display values; None without one. With materials, the base color's.
        normals_world: unit normals of the vertices where they are not those of the triangles around them, as
            at the seams of a mesh that was cut open; None elsewhere.
        materials: how it is to be lit; None where its colors have their light in them.
        origin_world: where the mesh has its origin in the coordinates of its user, see
            :mod:`octasplat.engine.core.local_origin`.
        georeference: where it lies on the Earth, and how large it is; None where that is not known.
    """

    vertices_world: Float32[np.ndarray, "n 3"]
    faces: Int32[np.ndarray, "m 3"]
    rgb_srgb: Float32[np.ndarray, "n 3"] | None = None
    uv: Float32[np.ndarray, "n 2"] | None = None
    texture_srgb: UInt8[np.ndarray, "h w 3"] | None = None
    normals_world: Float32[np.ndarray, "n 3"] | None = None
    materials: MaterialMaps | None = None
    origin_world: Origin = NO_ORIGIN
    georeference: Georeference | None = None

    @property
    def face_corners_world(self) -> Float64[np.ndarray, "m 3 3"]:
        """Return the positions of each triangle's corners."""
        return self.vertices_world.astype(np.float64)[self.faces]

    @property
    def face_areas(self) -> Float64[np.ndarray, " m"]:
        """Return the area of each triangle, square world units."""
        corners = self.face_corners_world
        across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        return np.asarray(0.5 * np.linalg.norm(across, axis=1))

    def vertex_normals(self) -> Float32[np.ndarray, "n 3"]:
        """Return the given normals, or area-weighted unit normals, outwards.

        (0, 0, 1) where a vertex has no triangle with an area.
        """
        if self.normals_world is not None:
            return self.normals_world
        corners = self.face_corners_world
        # Cross products are twice as long as triangles are large, which weights the sum.
        across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        sums = np.stack(
            [
                np.bincount(
                    self.faces.reshape(-1), np.repeat(across[:, axis], 3), minlength=len(self.vertices_world)
                )
                for axis in range(3)
            ],
            axis=1,
        )
        lengths = np.linalg.norm(sums, axis=1, keepdims=True)
        unit = np.divide(sums, lengths, out=np.tile([0.0, 0.0, 1.0], (len(sums), 1)), where=lengths > 0)
        return unit.astype(np.float32)

    def select_faces(self, index: Bool[np.ndarray, " m"] | Int64[np.ndarray, " k"]) -> "TriangleMesh":
        """Return the triangles at ``index`` with their vertices, of a mesh without materials."""
        faces = self.faces[index]
        used = np.zeros(len(self.vertices_world), dtype=bool)
        used[faces.reshape(-1)] = True
        new_index = np.cumsum(used, dtype=np.int32) - 1  # new number of each vertex that is used
        return replace(
            self,
            vertices_world=self.vertices_world[used],
            faces=new_index[faces].astype(np.int32),
            rgb_srgb=None if self.rgb_srgb is None else self.rgb_srgb[used],
            uv=None if self.uv is None else self.uv[used],
            normals_world=None if self.normals_world is None else self.normals_world[used],
        )


@dataclass(frozen=True)
class EdgeReport:
    """Counts of edges by how triangles share them.

    Attributes:
        open_edges: edges with one triangle; a watertight mesh has none.
        non_manifold_edges: edges with more than two triangles.
        inconsistent_edges: edges whose two triangles wind in opposite senses.
    """

    open_edges: int
    non_manifold_edges: int
    inconsistent_edges: int

    @property
    def is_watertight(self) -> bool:
        """Return whether every edge has two consistently wound triangles."""
        return self.open_edges == 0 and self.non_manifold_edges == 0 and self.inconsistent_edges == 0


def edge_report(faces: Int32[np.ndarray, "m 3"]) -> EdgeReport:
    """Count the open, crowded (more than two triangles) and inconsistently wound edges.

    >>> tetrahedron = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]], np.int32)
    >>> edge_report(tetrahedron)
    EdgeReport(open_edges=0, non_manifold_edges=0, inconsistent_edges=0)
    """
    directed = directed_edges(faces)
    ordered = np.sort(directed, axis=1)
    forward = directed[:, 0] < directed[:, 1]
    if len(ordered) == 0:
        return EdgeReport(0, 0, 0)
    key = ordered[:, 0].astype(np.int64) * (int(faces.max()) + 1) + ordered[:, 1]  # one number an edge
    _, place, counts = np.unique(key, return_inverse=True, return_counts=True)
    # 0 where two triangles run along the edge in opposite directions, as in a consistent winding
    ways = np.bincount(place.reshape(-1), np.where(forward, 1.0, -1.0))
    return EdgeReport(
        int((counts == 1).sum()), int((counts > 2).sum()), int(((counts == 2) & (ways != 0)).sum())
    )


def directed_edges(faces: Int32[np.ndarray, "m 3"]) -> Int32[np.ndarray, "e 2"]:
    """Return the three edges of each triangle in its winding, triangle by triangle.

    >>> directed_edges(np.array([[0, 1, 2]], np.int32)).tolist()
    [[0, 1], [1, 2], [2, 0]]
    """
    return np.ascontiguousarray(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2))


def unique_edges(faces: Int32[np.ndarray, "m 3"]) -> Int32[np.ndarray, "e 2"]:
    """Return the ends of each edge, the lower number first, each edge once and in order.

    >>> unique_edges(np.array([[0, 1, 2], [2, 1, 3]], np.int32)).tolist()
    [[0, 1], [0, 2], [1, 2], [1, 3], [2, 3]]
    """
    ends = np.sort(directed_edges(faces), axis=1)
    # One number an edge, as sorting rows takes ten times as long.
    size = int(ends.max(initial=0)) + 1
    keys = np.sort(ends[:, 0].astype(np.int64) * size + ends[:, 1])
    keys = keys[np.diff(keys, prepend=-1) > 0]
    return np.stack([keys // size, keys % size], axis=1).astype(np.int32)

"""A mesh or a cloud of points that is known beside photographs, as the depth maps that it gives them.

    geometry.ply, .obj or .glb     a mesh, or a cloud of points
    geometry.las or .laz           a cloud of a laser scanner

It stands in the coordinates of the poses and need not show everything. The depth of a pixel is where its ray
first meets the mesh. Points get a square each, as large as their distance from each other, so that near
points hide far ones; a depth counts where a ray passes close to the point itself.
"""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, Int64

from octasplat.engine.core.rays import RayBatch
from octasplat.engine.dataset.camera import Camera
from octasplat.engine.dataset.model import PosedView, Viewpoints
from octasplat.engine.geometry.imported_mesh import ImportedMesh

MAX_SIDE_PX = 800
"""Longer side of the depth maps; a ray of the training takes the depth of the pixel that it falls into."""
MAX_POINTS = 1_000_000
"""Of more points, one in each cell of a grid is kept."""
SPREAD_SHARE = 0.02
"""Share of the points beyond each end of the spread by which the grid is chosen."""
POINTS_AT_ONCE = 1 << 16
"""So many get their planes at once, to take little memory."""
NEIGHBOURS = 8
"""So many nearest points give the plane of a point's square."""
SPACING_NEIGHBOUR = 4
"""The distance to this nearest point is the spacing: on a square grid it is the side of a cell."""
HALF_SIDE = 1.0
"""Of a square, in spacings: neighbours overlap, so that nothing is seen between them."""
KNOWN_RADIUS = 0.6
"""Farther from the point than this, in spacings, a square hides what is behind it and gives no depth."""
MAX_SPACING = 5.0
"""A spacing counts at most so many times the median one: single points far from all others stay small."""


@dataclass(frozen=True)
class KnownGeometry:
    """The known geometry of a scene.

    Attributes:
        path: its file.
        sha256: of the file.
        read: reads it, in the coordinates of the file.
    """

    path: Path
    sha256: str
    read: Callable[[], ImportedMesh]


class GeometryDepths:
    """Depths of a mesh, or of a cloud of points, as cameras see it.

    Args:
        mesh: about the local origin of the scene; without triangles it is a cloud.
        threads: to use; 0 takes all.
    """

    def __init__(self, mesh: ImportedMesh, threads: int = 0) -> None:
        from octasplat.engine.trace.triangle_bvh import TriangleBvh  # here: most scenes have no geometry

        vertices, faces = mesh.vertices, mesh.triangles
        self._cloud: PointCloud | None = None
        if len(faces) == 0:
            self._cloud = PointCloud(thin_points(vertices, MAX_POINTS), threads)
            vertices, faces = self._cloud.squares()
        self._bvh = TriangleBvh(vertices.astype(np.float32), faces, threads=threads)

    def view(self, view: PosedView, camera: Camera) -> Float32[np.ndarray, "h w"]:
        """Return the depths along the axis of view, world units; 0 where nothing is known."""
        height, width = map_size(view.width_px, view.height_px)
        columns = (np.arange(width) + 0.5) * (view.width_px / width)
        rows = (np.arange(height) + 0.5) * (view.height_px / height)
        at_px = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
        directions_cam = camera.directions_cam(at_px)
        is_ray = np.isfinite(directions_cam).all(axis=1)
        depth = np.zeros(len(at_px), np.float32)
        directions = directions_cam[is_ray]
        # rotation_cam_from_world maps world to camera: from the right it is the inverse
        rays = RayBatch(
            np.broadcast_to(view.origin_world, directions.shape).astype(np.float32),
            (directions @ view.rotation_cam_from_world).astype(np.float32),
        )
        hits = self._bvh.closest(rays)
        known = hits.is_hit
        if self._cloud is not None:
            reach = hits.distances[known, None].astype(np.float64)
            met_world = view.origin_world + reach * rays.directions_world[known]
            known[known] = self._cloud.is_near_point(met_world, hits.faces[known])
        z = np.zeros(len(rays))
        z[known] = hits.distances[known] * directions[known, 2]
        depth[is_ray] = np.maximum(z, 0.0)
        return depth.reshape(height, width)


def digest_with_cameras(digest: str, viewpoints: Viewpoints) -> str:
    """Return a digest of the geometry as cameras see it, which may be moved, from one of the geometry."""
    total = hashlib.sha256(digest.encode())
    for view in viewpoints.views:
        pose = np.column_stack([view.rotation_cam_from_world, view.translation_cam_from_world])
        total.update(f"{view.name}\0{viewpoints.cameras[view.camera_index]}\0{pose.tolist()}\0".encode())
    return total.hexdigest()


def map_size(width_px: int, height_px: int) -> tuple[int, int]:
    """Return the height and width of the depth map of a photograph of this size.

    >>> map_size(1600, 1200), map_size(640, 480)
    ((600, 800), (480, 640))
    """
    shrink = max(1.0, max(width_px, height_px) / MAX_SIDE_PX)
    return max(1, round(height_px / shrink)), max(1, round(width_px / shrink))


def thin_points(points: Float64[np.ndarray, "n 3"], at_most: int) -> Float64[np.ndarray, "m 3"]:
    """Return the first point in each cell of a grid, whose cells are large enough that few remain.

    All are returned, in their order, where they are few enough.
    """
    if len(points) <= at_most:
        return points
    low, middle, high = np.quantile(points, (SPREAD_SHARE, 0.5, 1 - SPREAD_SHARE), axis=0)
    # of a surface, so that the count falls with the square of the side; single points far away do not count
    side = float(np.linalg.norm(high - low)) / np.sqrt(at_most) or np.inf
    while True:
        # 21 bits an axis are one key; what lies farther away than that shares the outermost cells
        cells = np.clip(np.floor((points - middle) / side), -(1 << 20), (1 << 20) - 1).astype(np.int64)
        keys = np.einsum("nk,k->n", cells + (1 << 20), np.array([1 << 42, 1 << 21, 1]))
        first = np.sort(np.unique(keys, return_index=True)[1])
        if len(first) <= at_most:
            return points[first]
        side *= 1.2


class PointCloud:
    """Points of a surface, with the plane and the spacing at each.

    Args:
        points_world: positions.
        threads: to use; 0 takes all.
    """

    def __init__(self, points_world: Float64[np.ndarray, "n 3"], threads: int = 0) -> None:
        from scipy.spatial import cKDTree

        count = min(len(points_world), NEIGHBOURS + 1)
        self._points = points_world
        distances, near = cKDTree(points_world).query(points_world, count, workers=threads or -1)
        shape = len(points_world), count
        spacing = distances.reshape(shape)[:, min(SPACING_NEIGHBOUR, count - 1)]
        self._spacing = np.minimum(spacing, MAX_SPACING * np.median(spacing))
        self._neighbours = near.reshape(shape)

    def squares(self) -> tuple[Float64[np.ndarray, "v 3"], Int64[np.ndarray, "f 3"]]:
        """Return a square on each point, in the plane of its neighbours, as corners and triangles."""
        corners = np.empty((len(self._points), 4, 3))
        for start in range(0, len(self._points), POINTS_AT_ONCE):
            part = slice(start, start + POINTS_AT_ONCE)
            around = self._points[self._neighbours[part]]
            around = around - around.mean(axis=1, keepdims=True)
            # ascending eigenvalues: the first axis is the normal, the others span the plane
            axes = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))[1]
            along = HALF_SIDE * self._spacing[part, None, None] * axes[:, :, 1:].transpose(0, 2, 1)
            for corner, (sign_u, sign_v) in enumerate(((-1, -1), (1, -1), (1, 1), (-1, 1))):
                corners[part, corner] = self._points[part] + sign_u * along[:, 0] + sign_v * along[:, 1]
        first = 4 * np.arange(len(self._points), dtype=np.int64)[:, None, None]
        faces = first + np.array([[0, 1, 2], [0, 2, 3]])
        return corners.reshape(-1, 3), faces.reshape(-1, 3)

    def is_near_point(
        self, positions_world: Float64[np.ndarray, "r 3"], faces: Int32[np.ndarray, " r"]
    ) -> Bool[np.ndarray, " r"]:
        """Return whether each position, on the square of such a face, is close to a point of the cloud."""
        is_near = np.zeros(len(faces), np.bool_)
        for start in range(0, len(faces), POINTS_AT_ONCE):
            part = slice(start, start + POINTS_AT_ONCE)
            # a square reaches over the points around its own, and no farther
            near = self._neighbours[faces[part] // 2]
            away = np.linalg.norm(positions_world[part, None] - self._points[near], axis=2)
            is_near[part] = (away <= KNOWN_RADIUS * self._spacing[near]).any(axis=1)
        return is_near

"""Distance of a surface from a reference surface: Chamfer distance and F-score."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64, Int64
from scipy.spatial import cKDTree

from octasplat.engine.geometry.triangle_mesh import TriangleMesh

NEIGHBOURS = 8
"""Triangles tried for each point: those of the nearest samples."""


@dataclass(frozen=True)
class SurfaceMetrics:
    """Distances between a surface and the truth, world units.

    Attributes:
        accuracy: mean distance from the surface to the truth.
        completeness: mean distance from the truth to the surface.
        threshold: distance up to which a point counts as right.
        precision: share of the surface within the threshold of the truth.
        recall: share of the truth within the threshold of the surface.
    """

    accuracy: float
    completeness: float
    threshold: float
    precision: float
    recall: float

    @property
    def chamfer(self) -> float:
        """Return the mean of accuracy and completeness."""
        return 0.5 * (self.accuracy + self.completeness)

    @property
    def f_score(self) -> float:
        """Return the harmonic mean of precision and recall.

        As in "Tanks and Temples: Benchmarking Large-Scale Scene Reconstruction"
        (https://doi.org/10.1145/3072959.3073599).
        """
        total = self.precision + self.recall
        return 2 * self.precision * self.recall / total if total > 0 else 0.0


def surface_metrics(
    surface_distances: Float[np.ndarray, " n"], truth_distances: Float[np.ndarray, " m"], threshold: float
) -> SurfaceMetrics:
    """Sum up the distances of samples of the surface and of the truth to each other."""
    return SurfaceMetrics(
        float(surface_distances.mean()),
        float(truth_distances.mean()),
        threshold,
        float((surface_distances <= threshold).mean()),
        float((truth_distances <= threshold).mean()),
    )


def sample_surface(
    mesh: TriangleMesh, count: int, rng: np.random.Generator
) -> tuple[Float64[np.ndarray, "n 3"], Int64[np.ndarray, " n"]]:
    """Sample points uniformly over the area of a mesh; returns them and their triangles."""
    sums = np.cumsum(mesh.face_areas)
    face = np.searchsorted(sums, rng.random(count) * sums[-1], side="right").astype(np.int64)
    face = np.minimum(face, len(sums) - 1)  # a sum of rounded areas may end below the number drawn
    a, b, c = mesh.face_corners_world[face].transpose(1, 0, 2)
    # The root makes points uniform over the area of the triangle.
    s, t = np.sqrt(rng.random((count, 1))), rng.random((count, 1))
    return (1 - s) * a + s * (1 - t) * b + s * t * c, face


def distances_to_surface(
    points_world: Float[np.ndarray, "n 3"],
    mesh: TriangleMesh,
    rng: np.random.Generator,
    samples: int = 1_000_000,
) -> Float64[np.ndarray, " n"]:
    """Return distances of points to a mesh: to the triangles of the nearest of many samples.

    Never too small; too large by no more than the spacing of the samples, and only where the triangle
    nearest to the point is not among those of its eight nearest samples.
    """
    points, faces = sample_surface(mesh, samples, rng)
    # A small triangle may get no sample by chance; its corners stand for it then.
    corners = mesh.face_corners_world
    tree = cKDTree(np.concatenate([points, corners.reshape(-1, 3)]))
    owners = np.concatenate([faces, np.repeat(np.arange(len(mesh.faces)), 3)])
    _, near = tree.query(points_world, k=NEIGHBOURS)
    best = np.full(len(points_world), np.inf)
    for k in range(NEIGHBOURS):
        triangle = corners[owners[near[:, k]]]
        best = np.minimum(best, point_triangle_distances(points_world.astype(np.float64), triangle))
    return best


def point_triangle_distances(
    points: Float64[np.ndarray, "n 3"], triangles: Float64[np.ndarray, "n 3 3"]
) -> Float64[np.ndarray, " n"]:
    """Return the distance of each point to its own triangle."""
    a, b, c = triangles.transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    squared = np.maximum(np.sum(normal * normal, axis=1), 1e-300)
    offset = points - a
    height = np.sum(offset * normal, axis=1)
    # Barycentric coordinates of the foot of the perpendicular.
    foot_b = np.sum(np.cross(offset, c - a) * normal, axis=1) / squared
    foot_c = np.sum(np.cross(b - a, offset) * normal, axis=1) / squared
    # Without area there is no plane, and every point would lie on it.
    has_plane = np.sum(normal * normal, axis=1) > 1e-300
    inside = has_plane & (foot_b >= 0) & (foot_c >= 0) & (foot_b + foot_c <= 1)
    to_plane = np.abs(height) / np.sqrt(squared)
    to_rim = np.minimum.reduce(
        [_to_segment(points, a, b), _to_segment(points, b, c), _to_segment(points, c, a)]
    )
    return np.where(inside, to_plane, to_rim)


def _to_segment(
    points: Float64[np.ndarray, "n 3"], start: Float64[np.ndarray, "n 3"], end: Float64[np.ndarray, "n 3"]
) -> Float64[np.ndarray, " n"]:
    way = end - start
    share = np.sum((points - start) * way, axis=1) / np.maximum(np.sum(way * way, axis=1), 1e-300)
    nearest = start + np.clip(share, 0, 1)[:, None] * way
    return np.asarray(np.linalg.norm(points - nearest, axis=1))

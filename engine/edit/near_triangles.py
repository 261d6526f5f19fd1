"""Search for the triangles near points."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64
from scipy.spatial import KDTree

from octasplat.engine.core.compilation import run_ranges
from octasplat.engine.core.threads import threads_in_use
from octasplat.engine.edit.kernels.proxy import triangle_weights

CANDIDATES = 24
MAX_SUBDIVISIONS = 16


class NearTriangles:
    """Search for the triangles near points.

    Candidates come from samples spread over the triangles, one on a triangle of usual size, so that a large
    one is found from everywhere on it. Triangles so large that this would take too many samples have coarser
    ones, which are looked for apart: each class of size has a tree of its own, and the distance to a sample
    counts less what the samples of the class are coarser, so that many small triangles farther away do not
    push a large one out of the candidates.

    Args:
        corners_world: of the triangles.
    """

    def __init__(self, corners_world: Float64[np.ndarray, "t 3 3"]) -> None:
        self._corners = np.ascontiguousarray(corners_world)
        edges = np.linalg.norm(self._corners - np.roll(self._corners, 1, axis=1), axis=-1)
        self._spacing = float(np.median(edges))
        self._classes = _size_classes(self._corners, edges.max(axis=1), self._spacing)

    def query(
        self, points: Float64[np.ndarray, "p 3"]
    ) -> tuple[Int32[np.ndarray, "p k"], Float32[np.ndarray, "p k"], Float64[np.ndarray, " p"]]:
        """Return the triangles near each point with smooth weights, and the distance to the nearest one."""
        points = np.ascontiguousarray(points)
        apart, candidates = self._nearest_samples(points)
        chosen = np.zeros(candidates.shape, np.int32)
        weights = np.zeros(candidates.shape, np.float32)
        distances = np.zeros(len(points))
        run_ranges(
            triangle_weights, threads_in_use(), len(points),
            points, self._corners, candidates, apart, self._spacing, chosen, weights, distances,
        )  # fmt: skip
        return chosen, weights, distances

    def _nearest_samples(
        self, points: Float64[np.ndarray, "p 3"]
    ) -> tuple[Float64[np.ndarray, "p k"], Int64[np.ndarray, "p k"]]:
        """Return ascending distances to the samples nearest to each point, and the samples' triangles."""
        found = [each.nearest(points) for each in self._classes]
        if len(found) == 1:
            return found[0]
        apart, candidates = (np.concatenate(parts, axis=1) for parts in zip(*found, strict=True))
        first = np.argsort(apart, axis=1, kind="stable")[:, :CANDIDATES]
        return np.take_along_axis(apart, first, axis=1), np.take_along_axis(candidates, first, axis=1)


@dataclass(frozen=True)
class _SizeClass:
    """Samples of triangles of similar size.

    Attributes:
        tree: of the samples.
        owners: the triangle of each sample.
        coarser: how much farther from a sample its triangle can reach than one of usual size.
    """

    tree: KDTree
    owners: Int64[np.ndarray, " s"]
    coarser: float

    def nearest(
        self, points: Float64[np.ndarray, "p 3"]
    ) -> tuple[Float64[np.ndarray, "p k"], Int64[np.ndarray, "p k"]]:
        """Return ascending distances to the samples nearest to each point, and the samples' triangles."""
        count = min(CANDIDATES, len(self.owners))
        apart, near = self.tree.query(points, k=count, workers=threads_in_use())
        apart = np.maximum(apart.reshape(-1, count) - self.coarser, 0.0) if self.coarser else apart
        return apart.reshape(-1, count), self.owners[near.reshape(-1, count)]


def _size_classes(
    corners: Float64[np.ndarray, "t 3 3"], longest: Float64[np.ndarray, " t"], spacing: float
) -> tuple[_SizeClass, ...]:
    """Return triangles of usual size as one class, and larger ones by powers of two."""
    ratio = longest / (2.0 * spacing)
    octave = np.ceil(np.log2(np.maximum(ratio / MAX_SUBDIVISIONS, 1.0))).astype(np.int64)
    classes = []
    for number in np.unique(octave):
        rows = np.flatnonzero(octave == number)
        cuts = np.clip(np.ceil(ratio[rows]), 1, MAX_SUBDIVISIONS).astype(np.int64)
        samples, owners = _spread_samples(corners[rows], cuts)
        coarser = float((longest[rows] / cuts).max()) - 2.0 * spacing if number > 0 else 0.0
        classes.append(_SizeClass(KDTree(samples), rows[owners], coarser))
    return tuple(classes)


def _spread_samples(
    corners: Float64[np.ndarray, "t 3 3"], cuts: Int64[np.ndarray, " t"]
) -> tuple[Float64[np.ndarray, "s 3"], Int64[np.ndarray, " s"]]:
    """Return points spread over triangles whose edges are cut into ``cuts`` parts, and their triangles."""
    samples, owners = [], []
    for cut in np.unique(cuts):
        rows = np.flatnonzero(cuts == cut)
        i, j = np.meshgrid(np.arange(cut), np.arange(cut), indexing="ij")
        # Centroids of the sub-triangles that are not turned over
        u, v = ((i + 1 / 3) / cut).ravel(), ((j + 1 / 3) / cut).ravel()
        inner = u + v <= 1
        barycentric = np.stack([1 - u - v, u, v], axis=-1)[inner]
        samples.append(np.einsum("sk,tkc->tsc", barycentric, corners[rows]).reshape(-1, 3))
        owners.append(np.repeat(rows, len(barycentric)))
    return np.concatenate(samples), np.concatenate(owners)

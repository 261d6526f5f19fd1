"""Colors of a surface mesh, fitted to renders of the scene by least squares.

What a pixel shows is a mean of the colors at a few points of the surface, its vertices or the pixels of its
texture. So all pixels of all pictures make one sparse linear system, solved by least squares.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float32, Int, Int32, UInt8
from scipy.sparse import csr_matrix, identity

from octasplat.engine.core.rays import ImageRays
from octasplat.engine.geometry.triangle_mesh import TriangleMesh, unique_edges
from octasplat.engine.surface.least_squares import (
    conjugate_gradients,
    difference_matrix,
    interpolation_matrix,
)
from octasplat.engine.surface.texture import TextureLayout
from octasplat.engine.trace.triangle_bvh import TriangleBvh

Progress = Callable[[int, int], None]
SMOOTHNESS = 0.3
"""How much neighbours may be corrected differently, against the error of one pixel."""
PRIOR_WEIGHT = 1e-3
"""How much a color that pixels say little of stays as it was."""
CG_ITERATIONS = 15
SAMPLES_PER_PIXEL = ((-0.25, -0.25), (0.25, 0.25))
"""Where in a pixel the surface is looked at, from its middle, px; the pixel shows their mean."""
MIN_ALPHA = 0.25
"""Pixels that the scene covers less than this say nothing of its color."""
RAYS_PER_BATCH = 1 << 20


@runtime_checkable
class Palette(Protocol):
    """The colored points of a surface: vertices or texels."""

    @property
    def mesh(self) -> TriangleMesh:
        """Return the surface mesh whose colors are fitted."""

    @property
    def neighbours(self) -> Int[np.ndarray, "e 2"]:
        """Return the pairs of neighbouring points, each once."""

    def shares(
        self, faces: Int32[np.ndarray, " r"], weights: Float32[np.ndarray, "r 3"]
    ) -> tuple[Int[np.ndarray, "r k"], Float32[np.ndarray, "r k"]]:
        """Return the points, and their interpolation weights, that color places on triangles."""


@dataclass(frozen=True)
class VertexPalette:
    """Colors at a mesh's vertices, interpolated over triangles."""

    mesh: TriangleMesh

    @property
    def neighbours(self) -> Int[np.ndarray, "e 2"]:
        """Return both ends of each edge."""
        return unique_edges(self.mesh.faces)

    def shares(
        self, faces: Int32[np.ndarray, " r"], weights: Float32[np.ndarray, "r 3"]
    ) -> tuple[Int[np.ndarray, "r k"], Float32[np.ndarray, "r k"]]:
        """Return the triangles' corners with the barycentric weights."""
        return self.mesh.faces[faces], weights


@dataclass(frozen=True)
class TexturePalette:
    """Colors at the texels that show surface, interpolated bilinearly."""

    layout: TextureLayout

    @property
    def mesh(self) -> TriangleMesh:
        """Return the unwrapped mesh."""
        return self.layout.mesh

    @cached_property
    def _texel_numbers(self) -> Int32[np.ndarray, "h w"]:
        layout = self.layout
        numbers = np.full((layout.side_px, layout.side_px), -1, np.int32)
        numbers[layout.rows, layout.columns] = np.arange(len(layout.rows), dtype=np.int32)
        return numbers

    @property
    def neighbours(self) -> Int[np.ndarray, "e 2"]:
        """Return horizontally and vertically neighbouring texels."""
        numbers = self._texel_numbers
        pairs = np.concatenate(
            [
                np.stack([numbers[:, :-1], numbers[:, 1:]], axis=-1).reshape(-1, 2),
                np.stack([numbers[:-1], numbers[1:]], axis=-1).reshape(-1, 2),
            ]
        )
        return pairs[(pairs >= 0).all(axis=1)]

    def shares(
        self, faces: Int32[np.ndarray, " r"], weights: Float32[np.ndarray, "r 3"]
    ) -> tuple[Int[np.ndarray, "r k"], Float32[np.ndarray, "r k"]]:
        """Return the four texels around each place, as far as they show surface."""
        mesh, side = self.mesh, self.layout.side_px
        assert mesh.uv is not None
        at = (weights[:, :, None] * mesh.uv[mesh.faces[faces]]).sum(axis=1) * side - 0.5
        low = np.floor(at)
        part = at - low
        numbers, shares = [], []
        for down in (0, 1):
            for across in (0, 1):
                column, row = np.clip(low + np.array([across, down]), 0, side - 1).astype(np.int64).T
                numbers.append(self._texel_numbers[row, column])
                of_row = part[:, 1] if down else 1 - part[:, 1]
                shares.append(of_row * (part[:, 0] if across else 1 - part[:, 0]))
        number, share = np.stack(numbers, axis=1), np.stack(shares, axis=1)
        # texels that show no surface have no color: the others take their shares
        share[number < 0] = 0.0
        share /= np.maximum(share.sum(axis=1, keepdims=True), 1e-6)
        return np.maximum(number, 0), share.astype(np.float32)


Picture = Callable[[], tuple[ImageRays, UInt8[np.ndarray, "_h _w 4"]]]
"""The rays of a picture, and what they show: display values over black and the alpha, as bytes."""


def fit_colors(
    points: Palette,
    start_srgb: Float32[np.ndarray, "n 3"],
    pictures: Sequence[Picture],
    progress: Progress = lambda _done, _total: None,
) -> tuple[Float32[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
    """Return the colors with which the surface's renders match the scene's best.

    Corrections of ``start_srgb`` are sought, by conjugate gradients on the normal equations with a few steps;
    a correction that differs from its neighbours' costs a little, so that what lies between the pixels
    keeps its detail and what no picture shows follows what is around it.

    Args:
        points: that have colors.
        start_srgb: display values to begin with.
        pictures: of the scene.
        progress: called with (pictures done, total).

    Returns:
        The colors, and which points any pixel shows.
    """
    count = len(start_srgb)
    normal, right_side = _normal_equations(points, start_srgb, pictures, progress)
    smooth = SMOOTHNESS * difference_matrix(points.neighbours, count)
    system = (normal + smooth + PRIOR_WEIGHT * identity(count, np.float32)).tocsr().astype(np.float32)
    correction = conjugate_gradients(
        lambda x: system @ x, system.diagonal()[:, None], right_side, CG_ITERATIONS
    )
    return np.clip(start_srgb + correction, 0.0, 1.0).astype(np.float32), normal.diagonal() > 0


def _normal_equations(
    points: Palette, start_srgb: Float32[np.ndarray, "n 3"], pictures: Sequence[Picture], progress: Progress
) -> tuple[csr_matrix, Float32[np.ndarray, "n 3"]]:
    """Return the matrix and right side: summed products of the shares, and the pixels' residuals."""
    count = len(start_srgb)
    scene = TriangleBvh(points.mesh.vertices_world, points.mesh.faces)
    normal = csr_matrix((count, count), dtype=np.float32)
    right_side = np.zeros((count, 3), np.float32)
    waiting: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    total = len(pictures)
    progress(0, total)
    for done, picture in enumerate(pictures, 1):
        waiting.append(_pixel_equations(scene, points, *picture()))
        # several pictures at once: adding a sparse matrix costs as much for few rows
        if sum(len(numbers) for numbers, _, _ in waiting) >= RAYS_PER_BATCH or done == total:
            numbers, shares, rgb = (np.concatenate(parts) for parts in zip(*waiting, strict=True))
            rows = interpolation_matrix(shares, numbers, count)
            columns = rows.T.tocsr()
            normal = normal + columns @ rows
            right_side += columns @ (rgb - rows @ start_srgb)
            waiting.clear()
        progress(done, total)
    return normal, right_side


def _pixel_equations(
    scene: TriangleBvh, points: Palette, rays: ImageRays, rgba: UInt8[np.ndarray, "h w 4"]
) -> tuple[Int[np.ndarray, "r k"], Float32[np.ndarray, "r k"], Float32[np.ndarray, "r 3"]]:
    """Return points and shares of each pixel that shows only surface in both, and its color."""
    observed = rgba.reshape(-1, 4).astype(np.float32) / 255
    samples = [scene.closest(rays.shifted(*offset).rays) for offset in SAMPLES_PER_PIXEL]
    # rims show what is behind as well
    used = np.flatnonzero(np.all([hits.is_hit for hits in samples], axis=0) & (observed[:, 3] >= MIN_ALPHA))
    numbers, shares = [], []
    for hits in samples:
        others = hits.barycentrics[used]
        weights = np.concatenate([1 - others.sum(axis=1, keepdims=True), others], axis=1)
        number, share = points.shares(hits.faces[used], weights)
        numbers.append(number)
        shares.append(share / np.float32(len(samples)))
    # straight colors: what shines through is no part of the surface
    rgb = np.clip(observed[used, :3] / observed[used, 3:], 0.0, 1.0)
    return np.concatenate(numbers, axis=1), np.concatenate(shares, axis=1), rgb

"""Colours of a surface fitted to pictures of the scene, so that its own pictures differ from them least.

What a pixel shows is a mean of the colours at a few points of the surface, its vertices or the pixels of its
texture. So all pixels of all pictures make one sparse linear system, solved by least squares.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, Float64, Int, Int32, UInt8
from scipy.sparse import coo_matrix, csr_matrix, diags

from engine.render.cameras import RenderCamera
from engine.surface.mesh import TriangleMesh, directed_edges
from engine.surface.texture import TextureLayout
from engine.trace.meshes import TriangleScene

Progress = Callable[[int, int], None]
SMOOTHNESS = 0.3
"""How much neighbours may be corrected differently, against the error of one pixel."""
TRUST = 1e-3
"""How much a colour that pixels say little of stays as it was."""
ROUNDS = 15
MIN_ALPHA = 0.25
"""Pixels that the scene covers less than this say nothing of its colour."""
RAYS_AT_ONCE = 1 << 20


@runtime_checkable
class Palette(Protocol):
    """The points of a surface that have colours of their own."""

    @property
    def mesh(self) -> TriangleMesh:
        """The surface."""

    @property
    def neighbours(self) -> Int[np.ndarray, "e 2"]:
        """Numbers of points side by side, each pair once."""

    def shares(
        self, faces: Int32[np.ndarray, " r"], weights: Float32[np.ndarray, "r 3"]
    ) -> tuple[Int[np.ndarray, "r k"], Float32[np.ndarray, "r k"]]:
        """Numbers of the points whose colours are seen at places of triangles, and their shares."""


@dataclass(frozen=True)
class VertexPalette:
    """Every vertex of a mesh has a colour, and triangles go from one to the other."""

    mesh: TriangleMesh

    @property
    def neighbours(self) -> Int[np.ndarray, "e 2"]:
        """Both ends of each edge."""
        return np.unique(np.sort(directed_edges(self.mesh.faces), axis=1), axis=0)

    def shares(
        self, faces: Int32[np.ndarray, " r"], weights: Float32[np.ndarray, "r 3"]
    ) -> tuple[Int[np.ndarray, "r k"], Float32[np.ndarray, "r k"]]:
        """The triangles' corners."""
        return self.mesh.faces[faces], weights


@dataclass(frozen=True)
class TexturePalette:
    """Every pixel of a texture that shows surface has a colour; between them a viewer interpolates."""

    layout: TextureLayout

    @property
    def mesh(self) -> TriangleMesh:
        """The mesh cut open."""
        return self.layout.mesh

    @cached_property
    def _numbers(self) -> Int32[np.ndarray, "h w"]:
        layout = self.layout
        numbers = np.full((layout.side_px, layout.side_px), -1, np.int32)
        numbers[layout.rows, layout.columns] = np.arange(len(layout.rows), dtype=np.int32)
        return numbers

    @property
    def neighbours(self) -> Int[np.ndarray, "e 2"]:
        """Pixels side by side or one above the other."""
        numbers = self._numbers
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
        """The four pixels around each place, as far as they show surface."""
        mesh, side = self.mesh, self.layout.side_px
        assert mesh.uv is not None
        at = (weights[:, :, None] * mesh.uv[mesh.faces[faces]]).sum(axis=1) * side - 0.5
        low = np.floor(at)
        part = at - low
        numbers, shares = [], []
        for down in (0, 1):
            for across in (0, 1):
                column, row = np.clip(low + np.array([across, down]), 0, side - 1).astype(np.int64).T
                numbers.append(self._numbers[row, column])
                of_row = part[:, 1] if down else 1 - part[:, 1]
                shares.append(of_row * (part[:, 0] if across else 1 - part[:, 0]))
        number, share = np.stack(numbers, axis=1), np.stack(shares, axis=1)
        share[number < 0] = 0.0
        share /= np.maximum(share.sum(axis=1, keepdims=True), 1e-6)
        return np.maximum(number, 0), share.astype(np.float32)


@dataclass(frozen=True)
class Pictures:
    """What cameras see of a scene.

    Attributes:
        cameras: the cameras.
        rgba: for each, display values over black and the alpha, as bytes.
    """

    cameras: tuple[RenderCamera, ...]
    rgba: tuple[UInt8[np.ndarray, "_h _w 4"], ...]


def fitted(
    points: Palette,
    start_srgb: Float32[np.ndarray, "n 3"],
    pictures: Pictures,
    progress: Progress = lambda _done, _total: None,
) -> Float32[np.ndarray, "n 3"]:
    """Colours with which the surface looks as like the pictures as it can.

    Corrections of ``start_srgb`` are sought, by conjugate gradients on the normal equations with a few steps;
    a correction that differs from its neighbours' costs a little, so that what lies between the pixels
    keeps its detail and what no picture shows follows what is around it.

    Args:
        points: that have colours.
        start_srgb: display values to begin with.
        pictures: of the scene.
        progress: told (pictures done, pictures in all).
    """
    count = len(start_srgb)
    normal, wanted = _normal_equations(points, start_srgb, pictures, progress)
    pairs = points.neighbours.T
    beside = coo_matrix((np.ones(pairs.shape[1], np.float32), tuple(pairs)), (count, count)).tocsr()
    beside = beside + beside.T
    degree = np.asarray(beside.sum(axis=1)).reshape(-1)
    system = (normal + SMOOTHNESS * (diags(degree) - beside) + TRUST * diags(np.ones(count))).tocsr()
    correction = _conjugate_gradients(system.astype(np.float32), wanted)
    return np.clip(start_srgb + correction, 0.0, 1.0).astype(np.float32)


def _normal_equations(
    points: Palette, start_srgb: Float32[np.ndarray, "n 3"], pictures: Pictures, progress: Progress
) -> tuple[csr_matrix, Float32[np.ndarray, "n 3"]]:
    """Matrix and right side: summed squares of the shares, and what the pixels lack."""
    count = len(start_srgb)
    scene = TriangleScene(points.mesh.vertices_world, points.mesh.faces)
    normal = csr_matrix((count, count), dtype=np.float32)
    wanted = np.zeros((count, 3), np.float32)
    waiting: list[tuple[csr_matrix, np.ndarray]] = []
    total = len(pictures.cameras)
    progress(0, total)
    for done, (camera, rgba) in enumerate(zip(pictures.cameras, pictures.rgba, strict=True), 1):
        waiting.append(_equations(scene, points, camera, np.asarray(rgba)))
        if sum(len(values) for _, values in waiting) >= RAYS_AT_ONCE or done == total:
            rows = _stacked([matrix for matrix, _ in waiting], count)
            columns = rows.T.tocsr()
            normal = normal + columns @ rows
            lacking = np.concatenate([values for _, values in waiting]) - rows @ start_srgb
            wanted += columns @ lacking
            waiting.clear()
        progress(done, total)
    return normal, wanted


def _equations(
    scene: TriangleScene, points: Palette, camera: RenderCamera, rgba: UInt8[np.ndarray, "h w 4"]
) -> tuple[csr_matrix, Float32[np.ndarray, "r 3"]]:
    """The shares of the points in each pixel that shows surface and scene, and its colour."""
    seen = rgba.reshape(-1, 4).astype(np.float32) / 255
    hits = scene.closest(camera.rays().rays)
    used = np.flatnonzero(hits.hit & (seen[:, 3] >= MIN_ALPHA))
    others = hits.barycentrics[used]
    weights = np.concatenate([1 - others.sum(axis=1, keepdims=True), others], axis=1)
    numbers, shares = points.shares(hits.faces[used], weights)
    starts = np.arange(len(used) + 1, dtype=np.int32) * numbers.shape[1]
    count = int(numbers.max(initial=-1)) + 1
    matrix = csr_matrix((shares.reshape(-1), numbers.reshape(-1), starts), (len(used), count))
    return matrix, np.clip(seen[used, :3] / seen[used, 3:], 0.0, 1.0)


def _stacked(matrices: list[csr_matrix], columns: int) -> csr_matrix:
    """Matrices one above the other, with so many columns."""
    lengths = np.concatenate([np.diff(matrix.indptr) for matrix in matrices])
    return csr_matrix(
        (
            np.concatenate([matrix.data for matrix in matrices]),
            np.concatenate([matrix.indices for matrix in matrices]),
            np.concatenate([[0], np.cumsum(lengths)]),
        ),
        (len(lengths), columns),
    )


def _conjugate_gradients(
    system: csr_matrix, wanted: Float32[np.ndarray, "n c"]
) -> Float64[np.ndarray, "n c"] | Float32[np.ndarray, "n c"]:
    """An approximate solution of a positive definite system, for every column (Hestenes and Stiefel 1952)."""
    scale = (1.0 / system.diagonal())[:, None].astype(np.float32)
    solution, rest = np.zeros_like(wanted), wanted.copy()
    step = scale * rest
    before = (rest * step).sum(axis=0, dtype=np.float64)
    for _ in range(ROUNDS):
        moved = system @ step
        length = before / np.maximum((step * moved).sum(axis=0, dtype=np.float64), 1e-30)
        solution += (length * step).astype(np.float32)
        rest -= (length * moved).astype(np.float32)
        scaled = scale * rest
        after = (rest * scaled).sum(axis=0, dtype=np.float64)
        step = (scaled + after / np.maximum(before, 1e-30) * step).astype(np.float32)
        before = after
    return solution

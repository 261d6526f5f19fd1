"""Refinement of vertices along their normals, by photo-consistency of a surface's renders.

If a surface lies too near or too far, each picture paints it a little beside the others. What a pixel shows
changes, to the first order, with the colors around and with how far the surface moves, so both are solved
for together by Gauss and Newton's method: colors and one displacement a vertex, the neighbours' much alike.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float32, Int32, UInt8
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.sparse import csr_matrix

from octasplat.engine.core.compilation import run_ranges
from octasplat.engine.core.rays import ImageRays, RayBatch
from octasplat.engine.core.threads import threads_in_use
from octasplat.engine.geometry.triangle_mesh import TriangleMesh
from octasplat.engine.surface.color_fit import MIN_ALPHA, Picture, Progress, VertexPalette
from octasplat.engine.surface.kernels.vertex_refinement import (
    apply_jacobian,
    apply_jacobian_transpose,
    jacobian_diagonal,
    linearise,
)
from octasplat.engine.surface.least_squares import conjugate_gradients, difference_matrix
from octasplat.engine.trace.triangle_bvh import TriangleBvh

SIDE_PX = 260
"""Pictures are made about this large: displacements count that are about a pixel of theirs."""
MAX_IMAGES = 128
"""Of more, so many are taken, spread evenly: about 100 bytes per pixel are needed at once."""
REFINEMENT_STEPS = 2
CG_ITERATIONS = 15
COLOR_CG_ITERATIONS = 8
COLOR_SMOOTHNESS = 0.1
SMOOTHNESS = 0.001
PRIOR_WEIGHT = 1e-4
OUTLIER_THRESHOLD = 0.16
"""Errors of display values from which on a pixel counts less."""
EDGE_THRESHOLD = 1.06
"""Pixels beside a depth this much larger see a rim, which moves otherwise."""
MAX_DISPLACEMENT_PX = 2.0


@dataclass(frozen=True)
class _VisiblePixels:
    """Surface points that the pixels of all pictures see; one row for each such pixel."""

    faces: Int32[np.ndarray, " p"]
    weights: Float32[np.ndarray, "p 3"]
    directions_world: Float32[np.ndarray, "p 3"]
    size_world: Float32[np.ndarray, " p"]
    steady: Bool[np.ndarray, " p"]
    rgb_srgb: Float32[np.ndarray, "p 3"]


def refine_vertices(
    mesh: TriangleMesh, pictures: Sequence[Picture], progress: Progress = lambda _done, _total: None
) -> TriangleMesh:
    """Return the mesh with vertices where the pictures agree better; to be called before coloring.

    Args:
        mesh: near the right place.
        pictures: of the scene.
        progress: called with (steps done, total).
    """
    count = len(mesh.vertices_world)
    # each once, where there are fewer
    taken = np.unique(np.linspace(0, len(pictures) - 1, min(MAX_IMAGES, len(pictures))).astype(int))
    small = [_downsample(*pictures[number]()) for number in taken]
    rgb = np.full((count, 3), 0.5, np.float32)  # gray: the first solve finds the colors
    apart = difference_matrix(VertexPalette(mesh).neighbours, count)
    for step in range(REFINEMENT_STEPS):
        progress(step, REFINEMENT_STEPS)
        mesh, rgb = _step(mesh, rgb, small, apart)
    progress(REFINEMENT_STEPS, REFINEMENT_STEPS)
    return mesh


def _downsample(
    rays: ImageRays, rgba: UInt8[np.ndarray, "h w 4"]
) -> tuple[ImageRays, Float32[np.ndarray, "_h _w 4"]]:
    """Return means of blocks of pixels."""
    side = max(1, round(max(rgba.shape[:2]) / SIDE_PX))
    side = min(side, *rgba.shape[:2])
    height, width = rgba.shape[0] // side, rgba.shape[1] // side

    def blocks(values: np.ndarray) -> np.ndarray:
        cut = values[: height * side, : width * side].astype(np.float32)
        return np.asarray(cut.reshape(height, side, width, side, -1).mean(axis=(1, 3)))

    ways = blocks(rays.directions_world)
    ways /= np.linalg.norm(ways, axis=2, keepdims=True)  # means of unit vectors are shorter
    return ImageRays.from_directions(rays.origin_world, ways, float(rays.rays.t_min[0])), blocks(rgba) / 255


def _visible_pixels(mesh: TriangleMesh, pictures: Sequence[tuple[ImageRays, np.ndarray]]) -> _VisiblePixels:
    scene = TriangleBvh(mesh.vertices_world, mesh.faces)
    found = []
    for rays, rgba in pictures:
        batch: RayBatch = rays.rays
        hits = scene.closest(batch)
        # a miss beside a hit is a rim
        depth = np.where(hits.is_hit, hits.distances, np.float32(1e6)).reshape(rgba.shape[:2])
        rim = (maximum_filter(depth, 3) > EDGE_THRESHOLD * minimum_filter(depth, 3)).reshape(-1)
        used = np.flatnonzero(hits.is_hit & (rgba[..., 3].reshape(-1) >= MIN_ALPHA))
        others = hits.barycentrics[used]
        pixels = rgba.reshape(-1, 4)[used]
        ways = batch.directions_world.reshape(*rgba.shape[:2], 3)
        angle = float(np.median(np.linalg.norm(np.diff(ways, axis=1), axis=2))) if ways.shape[1] > 1 else 1.0
        found.append(
            _VisiblePixels(
                faces=hits.faces[used],
                weights=np.concatenate([1 - others.sum(axis=1, keepdims=True), others], axis=1),
                directions_world=batch.directions_world[used],
                size_world=(hits.distances[used] * angle).astype(np.float32),
                steady=~rim[used],  # rims move with the silhouette, not with the surface
                rgb_srgb=np.clip(pixels[:, :3] / pixels[:, 3:], 0.0, 1.0),
            )
        )
    return _VisiblePixels(
        *(
            np.concatenate([getattr(part, name) for part in found])
            for name in ("faces", "weights", "directions_world", "size_world", "steady", "rgb_srgb")
        )
    )


def _step(
    mesh: TriangleMesh,
    rgb: Float32[np.ndarray, "n 3"],
    pictures: Sequence[tuple[ImageRays, np.ndarray]],
    apart: csr_matrix,
) -> tuple[TriangleMesh, Float32[np.ndarray, "n 3"]]:
    """Take one step; displacements are in pixels of the pictures at each vertex's distance."""
    visible = _visible_pixels(mesh, pictures)
    count, corners = len(rgb), mesh.faces[visible.faces]
    size = _pixel_sizes(visible, corners, count)
    still = np.zeros_like(visible.weights)
    sure = np.ones(len(corners), np.float32)
    # --- colors alone, so that the slopes below are those of the present surface ---
    x = _solve_step(
        pixels=_PixelJacobian(corners, visible.weights, still, still),
        wanted_srgb=visible.rgb_srgb,
        sure=sure,
        rgb=rgb,
        apart=apart,
        rounds=COLOR_CG_ITERATIONS,
    )
    rgb = rgb + x[:, :3]
    normals = mesh.vertex_normals()
    change, lifts = np.empty_like(visible.weights), np.empty_like(visible.weights)
    run_ranges(
        linearise, threads_in_use(), len(corners),
        mesh.vertices_world, normals, size, rgb, corners, visible.weights,
        visible.directions_world, visible.steady, change, lifts,
    )  # fmt: skip
    pixels = _PixelJacobian(corners, visible.weights, lifts, change)
    lacking = visible.rgb_srgb - pixels.apply(_colors_and_displacements(rgb))
    # Cauchy weights: what disagrees counts little
    sure = (1 / (1 + (lacking**2).sum(axis=1) / OUTLIER_THRESHOLD**2)).astype(np.float32)
    x = _solve_step(
        pixels=pixels, wanted_srgb=visible.rgb_srgb, sure=sure, rgb=rgb, apart=apart, rounds=CG_ITERATIONS
    )
    # beyond a pixel or two the linearization says nothing
    moved = np.clip(x[:, 3:], -MAX_DISPLACEMENT_PX, MAX_DISPLACEMENT_PX) * size[:, None] * normals
    return replace(mesh, vertices_world=mesh.vertices_world + moved), rgb + x[:, :3]


@dataclass(frozen=True)
class _PixelJacobian:
    """The linear map from colors and displacements of vertices to colors of pixels."""

    corners: Int32[np.ndarray, "p 3"]
    weights: Float32[np.ndarray, "p 3"]
    lifts: Float32[np.ndarray, "p 3"]
    change: Float32[np.ndarray, "p 3"]

    def apply(self, values: Float32[np.ndarray, "n 4"]) -> Float32[np.ndarray, "p 3"]:
        pixels = np.empty_like(self.change)
        run_ranges(
            apply_jacobian, threads_in_use(), len(pixels),
            self.corners, self.weights, self.lifts, self.change, values, pixels,
        )  # fmt: skip
        return pixels

    def apply_transpose(self, pixels: Float32[np.ndarray, "p 3"], count: int) -> Float32[np.ndarray, "n 4"]:
        values = np.zeros((count, 4), np.float32)
        apply_jacobian_transpose(self.corners, self.weights, self.lifts, self.change, pixels, values)
        return values

    def diagonal(self, sure: Float32[np.ndarray, " p"], count: int) -> Float32[np.ndarray, "n 4"]:
        values = np.zeros((count, 4), np.float32)
        jacobian_diagonal(self.corners, self.weights, self.lifts, self.change, sure, values)
        return values


def _solve_step(
    pixels: _PixelJacobian,
    wanted_srgb: Float32[np.ndarray, "p 3"],
    sure: Float32[np.ndarray, " p"],
    rgb: Float32[np.ndarray, "n 3"],
    apart: csr_matrix,
    rounds: int,
) -> Float32[np.ndarray, "n 4"]:
    """Return corrections of colors and displacements that fit the pixels best."""
    count, now = len(rgb), _colors_and_displacements(rgb)
    smooth = np.array([COLOR_SMOOTHNESS] * 3 + [SMOOTHNESS], np.float32)

    def times(x: Float32[np.ndarray, "n 4"]) -> Float32[np.ndarray, "n 4"]:
        return (
            pixels.apply_transpose(sure[:, None] * pixels.apply(x), count)
            + smooth * (apart @ x)
            + PRIOR_WEIGHT * x
        )

    lacking = pixels.apply_transpose(sure[:, None] * (wanted_srgb - pixels.apply(now)), count) - smooth * (
        apart @ now
    )
    diagonal = pixels.diagonal(sure, count) + smooth * apart.diagonal()[:, None] + PRIOR_WEIGHT
    # colors and displacements depend on each other
    return conjugate_gradients(times, diagonal, lacking, rounds, coupled=True)


def _colors_and_displacements(rgb: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, "n 4"]:
    """Return start values: the colors, and zero displacements."""
    return np.concatenate([rgb, np.zeros_like(rgb[:, :1])], axis=1)


def _pixel_sizes(
    visible: _VisiblePixels, corners: Int32[np.ndarray, "p 3"], count: int
) -> Float32[np.ndarray, " n"]:
    """Return the width of a pixel at each vertex, world units; the median where no picture sees it."""
    sums = np.bincount(corners.reshape(-1), np.repeat(visible.size_world, 3), minlength=count)
    uses = np.bincount(corners.reshape(-1), minlength=count)
    middle = float(np.median(visible.size_world)) if len(corners) else 0.0
    return np.where(uses > 0, sums / np.maximum(uses, 1), middle).astype(np.float32)

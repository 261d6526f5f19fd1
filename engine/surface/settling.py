"""Vertices moved along their normals to where the pictures of a surface agree.

If a surface lies too near or too far, each picture paints it a little beside the others. What a pixel shows
changes, to the first order, with the colours around and with how far the surface moves, so both are solved
for together by Gauss and Newton's method: colours and one displacement a vertex, the neighbours' much alike.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32, Int32, UInt8
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.sparse import identity

from engine.rays import ImageRays, RayBatch
from engine.surface.fitting import MIN_ALPHA, Picture, Progress, VertexPalette
from engine.surface.least_squares import conjugate_gradients, differences, share_rows
from engine.surface.mesh import TriangleMesh
from engine.trace.meshes import TriangleScene

COARSENING = 4
"""Pictures are made this much smaller: displacements count that are about a pixel of theirs."""
STEPS = 2
ROUNDS = 15
COLOUR_ROUNDS = 8
COLOUR_SMOOTHNESS = 0.1
SMOOTHNESS = 0.003
TRUST = 1e-4
OUTLIER = 0.08
"""Errors of display values from which on a pixel counts less."""
JUMP = 1.06
"""Pixels beside a depth this much larger see a rim, which moves otherwise."""
MIN_COSINE = 0.15
MOST_PX = 2.0


@dataclass(frozen=True)
class _Sight:
    """What the pixels of all pictures see; one row for each that sees surface."""

    faces: Int32[np.ndarray, " p"]
    weights: Float32[np.ndarray, "p 3"]
    directions_world: Float32[np.ndarray, "p 3"]
    size_world: Float32[np.ndarray, " p"]
    steady: Float32[np.ndarray, " p"]
    rgb_srgb: Float32[np.ndarray, "p 3"]


def settled(
    mesh: TriangleMesh, pictures: Sequence[Picture], progress: Progress = lambda _done, _total: None
) -> TriangleMesh:
    """The mesh with its vertices where the pictures agree better; to be done before colours.

    Args:
        mesh: near the right place.
        pictures: of the scene.
        progress: told (steps done, steps in all).
    """
    small = [_smaller(*picture()) for picture in pictures]
    rgb = np.full((len(mesh.vertices_world), 3), 0.5, np.float32)
    for step in range(STEPS):
        progress(step, STEPS)
        mesh, rgb = _step(mesh, rgb, small)
    progress(STEPS, STEPS)
    return mesh


def _smaller(
    rays: ImageRays, rgba: UInt8[np.ndarray, "h w 4"]
) -> tuple[ImageRays, Float32[np.ndarray, "_h _w 4"]]:
    """Means of blocks of pixels."""
    side = min(COARSENING, *rgba.shape[:2])
    height, width = rgba.shape[0] // side, rgba.shape[1] // side

    def blocks(values: np.ndarray) -> np.ndarray:
        cut = values[: height * side, : width * side].astype(np.float32)
        return np.asarray(cut.reshape(height, side, width, side, -1).mean(axis=(1, 3)))

    ways = blocks(rays.directions_world)
    ways /= np.linalg.norm(ways, axis=2, keepdims=True)
    return ImageRays.of(rays.origin_world, ways, float(rays.rays.t_min[0])), blocks(rgba) / 255


def _seen(mesh: TriangleMesh, pictures: Sequence[tuple[ImageRays, np.ndarray]]) -> _Sight:
    scene = TriangleScene(mesh.vertices_world, mesh.faces)
    found = []
    for rays, rgba in pictures:
        batch: RayBatch = rays.rays
        hits = scene.closest(batch)
        depth = np.where(hits.hit, hits.distances, np.float32(1e6)).reshape(rgba.shape[:2])
        rim = (maximum_filter(depth, 3) > JUMP * minimum_filter(depth, 3)).reshape(-1)
        used = np.flatnonzero(hits.hit & (rgba[..., 3].reshape(-1) >= MIN_ALPHA))
        others = hits.barycentrics[used]
        pixels = rgba.reshape(-1, 4)[used]
        ways = batch.directions_world.reshape(*rgba.shape[:2], 3)
        angle = float(np.median(np.linalg.norm(np.diff(ways, axis=1), axis=2))) if ways.shape[1] > 1 else 1.0
        found.append(
            _Sight(
                hits.faces[used],
                np.concatenate([1 - others.sum(axis=1, keepdims=True), others], axis=1),
                batch.directions_world[used],
                (hits.distances[used] * angle).astype(np.float32),
                np.where(rim[used], 0.0, 1.0).astype(np.float32),
                np.clip(pixels[:, :3] / pixels[:, 3:], 0.0, 1.0),
            )
        )
    return _Sight(
        *(
            np.concatenate([getattr(sight, name) for sight in found])
            for name in ("faces", "weights", "directions_world", "size_world", "steady", "rgb_srgb")
        )
    )


def _step(
    mesh: TriangleMesh, rgb: Float32[np.ndarray, "n 3"], pictures: Sequence[tuple[ImageRays, np.ndarray]]
) -> tuple[TriangleMesh, Float32[np.ndarray, "n 3"]]:
    """One step; displacements are counted in pixels of the pictures, at each vertex's distance."""
    sight = _seen(mesh, pictures)
    count, corners = len(rgb), mesh.faces[sight.faces]
    shares = share_rows(sight.weights, corners, count)
    apart = differences(VertexPalette(mesh).neighbours, count)
    shares_t = shares.T.tocsr()
    colours = (shares_t @ shares + COLOUR_SMOOTHNESS * apart + TRUST * identity(count, np.float32)).tocsr()
    lacking = shares_t @ (sight.rgb_srgb - shares @ rgb)
    rgb = rgb + conjugate_gradients(
        lambda x: colours @ x, colours.diagonal()[:, None], lacking, COLOUR_ROUNDS
    )
    lacking = sight.rgb_srgb - shares @ rgb
    sure = (1 / (1 + (lacking**2).sum(axis=1) / OUTLIER**2)).astype(np.float32)[:, None]
    normals, size = mesh.vertex_normals(), _pixel_sizes(sight, corners, count)
    change, facing = _colour_change(mesh, rgb, sight)
    lift = (normals[corners] * facing[:, None]).sum(axis=2) * size[corners]
    lifts = share_rows((sight.weights * lift).astype(np.float32), corners, count)
    lifts_t = lifts.T.tocsr()

    def times(x: Float32[np.ndarray, "n 4"]) -> Float32[np.ndarray, "n 4"]:
        pixels = sure * (shares @ x[:, :3] + change * (lifts @ x[:, 3:]))
        smooth = apart @ x
        out = np.empty_like(x)
        out[:, :3] = shares_t @ pixels + COLOUR_SMOOTHNESS * smooth[:, :3] + TRUST * x[:, :3]
        moved = (change * pixels).sum(axis=1, keepdims=True)
        out[:, 3:] = lifts_t @ moved + SMOOTHNESS * smooth[:, 3:] + TRUST * x[:, 3:]
        return out

    wanted = np.empty((count, 4), np.float32)
    wanted[:, :3] = shares_t @ (sure * lacking) - COLOUR_SMOOTHNESS * (apart @ rgb)
    wanted[:, 3:] = lifts_t @ (change * sure * lacking).sum(axis=1, keepdims=True)
    degree = apart.diagonal()[:, None]
    scale = np.empty_like(wanted)
    scale[:, :3] = shares_t.power(2) @ sure + COLOUR_SMOOTHNESS * degree + TRUST
    strength = sure * (change**2).sum(axis=1, keepdims=True)
    scale[:, 3:] = lifts_t.power(2) @ strength + SMOOTHNESS * degree + TRUST
    x = conjugate_gradients(times, scale, wanted, ROUNDS, coupled=True)
    moved = np.clip(x[:, 3:], -MOST_PX, MOST_PX) * size[:, None] * normals
    return replace(mesh, vertices_world=mesh.vertices_world + moved), (rgb + x[:, :3]).astype(np.float32)


def _pixel_sizes(sight: _Sight, corners: Int32[np.ndarray, "p 3"], count: int) -> Float32[np.ndarray, " n"]:
    """Width of a pixel at each vertex, world units; where no picture sees one, the median."""
    sums = np.bincount(corners.reshape(-1), np.repeat(sight.size_world, 3), minlength=count)
    uses = np.bincount(corners.reshape(-1), minlength=count)
    middle = float(np.median(sight.size_world)) if len(corners) else 0.0
    return np.where(uses > 0, sums / np.maximum(uses, 1), middle).astype(np.float32)


def _colour_change(
    mesh: TriangleMesh, rgb: Float32[np.ndarray, "n 3"], sight: _Sight
) -> tuple[Float32[np.ndarray, "p 3"], Float32[np.ndarray, "p 3"]]:
    """How each pixel's colour changes when its triangle moves by one along its normal, and that normal.

    The point that the ray meets then moves along the ray by one over the cosine, and with it the colour.
    """
    corners = mesh.face_corners_world
    one, two = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    across = np.cross(one, two)
    area = np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-20)
    normals = across / area
    ways, faces = sight.directions_world.astype(np.float64), sight.faces
    along_one = (np.cross(two, normals) / area)[faces] * ways
    along_two = (np.cross(normals, one) / area)[faces] * ways
    colours = rgb[mesh.faces]
    change = (colours[:, 1] - colours[:, 0])[faces] * along_one.sum(axis=1, keepdims=True)
    change = change + (colours[:, 2] - colours[:, 0])[faces] * along_two.sum(axis=1, keepdims=True)
    cosine = (normals[faces] * ways).sum(axis=1)
    use = (sight.steady > 0) & (np.abs(cosine) > MIN_COSINE)
    share = np.where(use, 1.0 / np.where(use, cosine, 1.0), 0.0)
    return (change * share[:, None]).astype(np.float32), normals[faces].astype(np.float32)

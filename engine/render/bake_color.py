"""One color per Gaussian, for formats without view-dependent colors.

What a ray shows is linear in the colors of the Gaussians: W c, where W holds their weights along the rays.
So the colors that come nearest to the pictures of the whole scene, taken from given cameras, are a
least-squares problem, which conjugate gradients solve in a few steps; W is sparse, and comes from one trace
of the pictures' rays.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Float32, Float64
from scipy.sparse import csr_array

from octasplat.engine.core.rays import ImageRays, RayBatch
from octasplat.engine.gaussians.model import SH_C0, FlatGaussians
from octasplat.engine.gaussians.spherical_harmonics import sh_basis
from octasplat.engine.render.renderer import tile_order
from octasplat.engine.trace.protocol import Recording, Tracer, TraceSettings
from octasplat.engine.trace.ray_hits import blend_weights

CG_ITERATIONS = 4
"""More follow the given cameras closer, and others less."""
MIN_WEIGHT = 1 / 512
"""Weights below this, which no display shows, are left out: they are many and fill the memory."""
REGULARISATION = 0.02
"""Weight, in rays, that holds a Gaussian at its mean color; those that are hardly seen stay there."""


def with_constant_color(gaussians: FlatGaussians, rgb_srgb: Float32[np.ndarray, "n 3"]) -> FlatGaussians:
    """Return the Gaussians with these colors from every direction."""
    return replace(gaussians, sh=((rgb_srgb - np.float32(0.5)) / np.float32(SH_C0))[:, None])


def colors_along(
    gaussians: FlatGaussians, direction_world: Float64[np.ndarray, "3"]
) -> Float32[np.ndarray, "n 3"]:
    """Return the display colors seen by a distant camera that looks along a direction of any length."""
    length = np.linalg.norm(direction_world)
    return _evaluate_colors(gaussians, (direction_world / length)[None])


def fit_colors_to_cameras(
    gaussians: FlatGaussians,
    tracer: Tracer,
    images: Sequence[Callable[[], ImageRays]],
    *,
    steps: int = CG_ITERATIONS,
    on_pass: Callable[[int, int], None] = lambda _done, _total: None,
) -> Float32[np.ndarray, "n 3"]:
    """Return the constant colors that reproduce the cameras' images best, by least squares.

    Small images do.

    Args:
        gaussians: the scene.
        tracer: with settings as the scene was trained with; it is built anew.
        images: make the rays of each camera.
        steps: of the conjugate gradients; 0 gives the mean of what the cameras see of each Gaussian.
        on_pass: called with (passes done, total), one for each image and one for the steps; it may raise to
            stop.

    Returns:
        Display values in [0, 1]; those of the constant harmonic for Gaussians that no camera sees.
    """
    on_pass(0, len(images) + 1)
    tracer.build(gaussians)
    parts, targets = [], []
    sums, weights = np.zeros((len(gaussians), 3)), np.zeros(len(gaussians))
    for number, make in enumerate(images):
        rays = _rays_in_tile_order(make())
        traced = tracer.trace(rays, record=True)
        targets.append(traced.rgb_srgb)
        assert traced.recording is not None
        of_rays = _weight_matrix(gaussians, rays, traced.recording, tracer.settings)
        del traced  # its recording's memory serves the next one
        # what each Gaussian shows this camera, weighted by how much it is seen
        seen = np.asarray(of_rays.sum(axis=0), np.float64).ravel()
        ids = np.flatnonzero(seen)
        away = gaussians.means_world[ids] - rays.origins_world[0]
        away = away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12)
        sums[ids] += seen[ids, None] * _evaluate_colors(gaussians.select(ids), away)
        weights += seen
        parts.append(of_rays)
        on_pass(number + 1, len(images) + 1)
    means = np.where(
        weights[:, None] > 0, sums / np.maximum(weights, 1e-12)[:, None], gaussians.base_rgb_srgb
    )
    if steps == 0 or not parts:
        return np.clip(means, 0, 1).astype(np.float32)
    colors = _conjugate_gradients(
        blend=parts,
        targets=targets,
        start=means,
        weights=weights,
        steps=steps,
    )
    on_pass(len(images) + 1, len(images) + 1)
    return np.clip(colors, 0, 1).astype(np.float32)


def _weight_matrix(
    gaussians: FlatGaussians, rays: RayBatch, recording: Recording, settings: TraceSettings
) -> csr_array:
    """Return the weight of each Gaussian along each ray, of shape (rays, Gaussians), without tiny ones.

    The others are scaled up to the same sum, so that the colors do not have to make up for what is left out.
    """
    found = blend_weights(gaussians, rays, recording, settings)
    ray = np.repeat(np.arange(len(found.counts)), found.counts)
    is_kept = found.weights >= MIN_WEIGHT
    ray_kept, kept = ray[is_kept], found.weights[is_kept]
    rest = np.bincount(ray_kept, kept, minlength=len(found.counts))
    total = np.bincount(ray, found.weights, minlength=len(found.counts))
    scale = np.divide(total, rest, out=np.ones_like(rest), where=rest > 0)
    ends = np.concatenate([[0], np.cumsum(np.bincount(ray_kept, minlength=len(found.counts)))]).astype(
        np.int32
    )
    values = (kept * scale[ray_kept]).astype(np.float32)
    return csr_array((values, found.ids[is_kept], ends), (len(found.counts), len(gaussians)))


def _conjugate_gradients(
    blend: Sequence[csr_array],
    targets: Sequence[Float32[np.ndarray, "r 3"]],
    start: Float64[np.ndarray, "n 3"],
    weights: Float64[np.ndarray, " n"],
    steps: int,
) -> Float64[np.ndarray, "n 3"]:
    """Take steps towards the minimum of |W c - y|^2 + r |c - start|^2, each channel on its own.

    r is :data:`REGULARISATION`.
    """
    scale = (weights + REGULARISATION)[:, None]  # preconditioner: about the diagonal of W^T W
    colors, rest = start.copy(), np.zeros_like(start)
    for of_rays, target in zip(blend, targets, strict=True):
        rest += of_rays.T @ (target - of_rays @ colors)
    preconditioned = rest / scale
    direction = preconditioned.copy()
    product = (rest * preconditioned).sum(axis=0)
    for _ in range(steps):
        image = REGULARISATION * direction
        for of_rays in blend:
            image += of_rays.T @ (of_rays @ direction)
        curvature = (direction * image).sum(axis=0)
        length = np.divide(product, curvature, out=np.zeros(3), where=curvature > 0)
        colors += length * direction
        rest -= length * image
        preconditioned = rest / scale
        before, product = product, (rest * preconditioned).sum(axis=0)
        direction = preconditioned + np.divide(product, before, out=np.zeros(3), where=before > 0) * direction
    return colors


def _rays_in_tile_order(image: ImageRays) -> RayBatch:
    return image.rays[tile_order(image.height_px, image.width_px)]


def _evaluate_colors(
    gaussians: FlatGaussians, directions_world: Float[np.ndarray, "m 3"]
) -> Float32[np.ndarray, "n 3"]:
    # m is 1, a direction for all, or n.
    basis = sh_basis(np.asarray(directions_world, np.float64), gaussians.sh_degree)
    colors = 0.5 + np.einsum(
        "nk,nkc->nc", np.broadcast_to(basis, (len(gaussians), basis.shape[1])), gaussians.sh
    )
    return np.maximum(colors, 0.0).astype(np.float32)

"""One color per Gaussian, for formats without view-dependent colors.

What a ray shows is linear in the colors of the Gaussians: W c, where W holds their weights along the rays.
So the colors that come nearest to the pictures of the whole scene, taken from given cameras, are a
least-squares problem, which conjugate gradients solve in a few steps; W is the forward pass of the tracer
with colors as features, its transpose the backward pass.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Float32, Float64

from octasplat.engine.core.rays import ImageRays, RayBatch
from octasplat.engine.gaussians.channels import Channels
from octasplat.engine.gaussians.model import SH_C0, FlatGaussians
from octasplat.engine.gaussians.spherical_harmonics import sh_basis
from octasplat.engine.render.renderer import tile_order
from octasplat.engine.trace.protocol import TraceGradients, Tracer

CG_ITERATIONS = 4
"""More follow the given cameras closer, and others less."""
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

    Small images do: each needs one trace and one backward pass a step.

    Args:
        gaussians: the scene.
        tracer: with settings as the scene was trained with; it is built anew.
        images: make the rays of each camera.
        steps: of the conjugate gradients; 0 gives the mean of what the cameras see of each Gaussian.
        on_pass: called with (passes over the images done, total); it may raise to stop.

    Returns:
        Display values in [0, 1]; those of the constant harmonic for Gaussians that no camera sees.
    """
    batches = [_rays_in_tile_order(make()) for make in images]
    on_pass(0, steps + 2)
    tracer.build(gaussians)
    # --- what each Gaussian shows each camera, weighted by how much it is seen ---
    targets, sums, weights = [], np.zeros((len(gaussians), 3)), np.zeros(len(gaussians))
    for rays in batches:
        traced = tracer.trace(rays, record=True)
        targets.append(traced.rgb_srgb.astype(np.float64))
        assert traced.recording is not None
        # backward of zeros: only the sums of weights are wanted
        found = tracer.backward(traced.recording, TraceGradients(np.zeros_like(traced.rgb_srgb))).numpy()
        away = gaussians.means_world[found.ids] - rays.origins_world[0]
        away = away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12)
        sums[found.ids] += found.weight_sums[:, None] * _evaluate_colors(gaussians.select(found.ids), away)
        weights[found.ids] += found.weight_sums
        del traced  # its recording's memory serves the next one
    on_pass(1, steps + 2)
    means = np.where(
        weights[:, None] > 0, sums / np.maximum(weights, 1e-12)[:, None], gaussians.base_rgb_srgb
    )
    if steps == 0 or not batches:
        return np.clip(means, 0, 1).astype(np.float32)
    solve = _NormalEquations(replace(gaussians.with_base_color_only(), channels=Channels()), tracer, batches)
    colors = _conjugate_gradients(
        normal=solve, targets=targets, start=means, weights=weights, steps=steps, on_pass=on_pass
    )
    return np.clip(colors, 0, 1).astype(np.float32)


class _NormalEquations:
    """W^T (W c - y) over all images."""

    def __init__(self, gaussians: FlatGaussians, tracer: Tracer, batches: Sequence[RayBatch]) -> None:
        self._features = np.zeros((len(gaussians), 3), np.float32)
        self._tracer, self._batches = tracer, batches
        tracer.build(gaussians, self._features)

    def __call__(
        self, colors: Float64[np.ndarray, "n 3"], targets: Sequence[Float64[np.ndarray, "r 3"]] | None = None
    ) -> Float64[np.ndarray, "n 3"]:
        self._features[...] = colors
        self._tracer.refresh()
        out = np.zeros(colors.shape)
        for number, rays in enumerate(self._batches):
            traced = self._tracer.trace(rays, record=True)
            assert traced.recording is not None
            rest = traced.features if targets is None else traced.features - targets[number]
            gradients = TraceGradients(np.zeros_like(traced.rgb_srgb), features=rest.astype(np.float32))
            found = self._tracer.backward(traced.recording, gradients).numpy()
            out[found.ids] += found.features
            del traced  # its recording's memory serves the next one
        return out


def _conjugate_gradients(
    normal: _NormalEquations,
    targets: Sequence[Float64[np.ndarray, "r 3"]],
    start: Float64[np.ndarray, "n 3"],
    weights: Float64[np.ndarray, " n"],
    steps: int,
    on_pass: Callable[[int, int], None],
) -> Float64[np.ndarray, "n 3"]:
    """Take steps towards the minimum of |W c - y|^2 + r |c - start|^2, each channel on its own.

    r is :data:`REGULARISATION`.
    """
    scale = (weights + REGULARISATION)[:, None]  # preconditioner: about the diagonal of W^T W
    colors = start.copy()
    rest = -normal(colors, targets)
    on_pass(2, steps + 2)
    preconditioned = rest / scale
    direction = preconditioned.copy()
    product = (rest * preconditioned).sum(axis=0)
    for step in range(steps):
        image = normal(direction) + REGULARISATION * direction
        curvature = (direction * image).sum(axis=0)
        length = np.divide(product, curvature, out=np.zeros(3), where=curvature > 0)
        colors += length * direction
        rest -= length * image
        preconditioned = rest / scale
        before, product = product, (rest * preconditioned).sum(axis=0)
        direction = preconditioned + np.divide(product, before, out=np.zeros(3), where=before > 0) * direction
        on_pass(min(step + 3, steps + 2), steps + 2)
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

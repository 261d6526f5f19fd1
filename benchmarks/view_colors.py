"""A view with other colors of the Gaussians: those that the nearest training camera sees, or fitted ones."""

import numpy as np
from jaxtyping import Bool, Float32, Float64
from scipy.sparse import csr_array, vstack

from octasplat.engine.core.rays import ImageRays
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.spherical_harmonics import sh_basis
from octasplat.engine.render.bake_color import with_constant_color
from octasplat.engine.trace.protocol import Tracer
from octasplat.engine.trace.ray_hits import blend_weights

RAYS_AT_ONCE = 1 << 15
MIN_WEIGHT = 1 / 512
HELD = 1.0
"""Weight, in pixels, that holds each Gaussian at the color that it has."""
FIT_STEPS = 12


def nearest_directions(
    means_world: Float32[np.ndarray, "n 3"],
    viewer_world: Float64[np.ndarray, "3"],
    cameras_world: Float64[np.ndarray, "v 3"],
) -> Float64[np.ndarray, "n 3"]:
    """Return the unit direction to each mean from the camera whose direction is nearest to the viewer's."""
    means = means_world.astype(np.float64)
    wanted = _unit(means - viewer_world)
    best, found = np.full(len(means), -2.0), np.empty_like(wanted)
    for camera in cameras_world:
        direction = _unit(means - camera)
        cosine = (direction * wanted).sum(axis=1)
        closer = cosine > best
        best[closer], found[closer] = cosine[closer], direction[closer]
    return found


def with_frozen_colors(
    gaussians: FlatGaussians, directions_world: Float64[np.ndarray, "n 3"]
) -> FlatGaussians:
    """Return the Gaussians with the color that each shows in one direction, from all directions."""
    basis = sh_basis(directions_world, gaussians.sh_degree)
    colors = np.maximum(0.5 + np.einsum("nk,nkc->nc", basis, gaussians.sh), 0)
    return with_constant_color(gaussians, colors.astype(np.float32))


def fitted_colors_picture(
    tracer: Tracer,
    gaussians: FlatGaussians,
    image: ImageRays,
    render: Float32[np.ndarray, "h w 3"],
    reference: Float32[np.ndarray, "h w 3"],
    weight: Float32[np.ndarray, "h w"],
) -> tuple[Float32[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"]]:
    """Return the picture with colors fitted to every other pixel, and which pixels were left out.

    What is left on the pixels that were not fitted is what colors cannot repair: geometry, opacity, and
    detail finer than the Gaussians. The colors of all Gaussians change by least squares, held at what they
    are where few pixels say anything.

    Args:
        tracer: built around the Gaussians.
        gaussians: the scene.
        image: the view's rays.
        render: what the scene shows there.
        reference: the photograph.
        weight: of its pixels.
    """
    height, width = weight.shape
    y, x = np.indices((height, width))
    left_out = (y + x) % 2 == 1
    parts = []
    for start in range(0, height * width, RAYS_AT_ONCE):
        rays = image.rays[np.arange(start, min(start + RAYS_AT_ONCE, height * width))]
        traced = tracer.trace(rays, record=True)
        assert traced.recording is not None
        found = blend_weights(gaussians, rays, traced.recording, tracer.settings)
        keep = found.weights >= MIN_WEIGHT
        row = np.repeat(np.arange(len(rays)), found.counts)[keep]
        ends = np.concatenate([[0], np.cumsum(np.bincount(row, minlength=len(rays)))])
        parts.append(
            csr_array(
                (found.weights[keep].astype(np.float32), found.ids[keep], ends), (len(rays), len(gaussians))
            )
        )
    blend = vstack(parts, format="csr")
    counted = (weight > 0).reshape(-1)
    fitted = np.flatnonzero(counted & ~left_out.reshape(-1))
    rest = (reference - render).reshape(-1, 3)
    change = _least_squares(csr_array(blend[fitted]), rest[fitted])
    picture = render.reshape(-1, 3) + blend @ change
    return np.clip(picture, 0, 1).reshape(render.shape).astype(np.float32), left_out


def _least_squares(blend: csr_array, rest: Float32[np.ndarray, "r 3"]) -> Float32[np.ndarray, "n 3"]:
    """Return the changes that come nearest to ``rest`` by conjugate gradients, held at 0 (:data:`HELD`)."""
    transposed = csr_array(blend.T)
    change = np.zeros((blend.shape[1], 3), np.float32)
    downhill = transposed @ rest
    scale = (np.asarray(transposed.sum(axis=1)).reshape(-1, 1) + HELD).astype(np.float32)
    direction = downhill / scale
    product = (downhill * direction).sum(axis=0)
    for _ in range(FIT_STEPS):
        image = transposed @ (blend @ direction) + HELD * direction
        length = product / np.maximum((direction * image).sum(axis=0), 1e-30)
        change += length * direction
        downhill = downhill - length * image
        preconditioned = downhill / scale
        before, product = product, (downhill * preconditioned).sum(axis=0)
        direction = preconditioned + product / np.maximum(before, 1e-30) * direction
    return change


def _unit(vectors: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12))

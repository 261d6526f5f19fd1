"""Regularisers of normals, depths and materials, by their gradients alone.

Batches of training rays come in patches (:mod:`octasplat.engine.shading.ray_patches`): square grids of rays
with one random pixel of each cell. Neighbours in a patch are neighbours on the surface, so that they can be
compared.
"""

import numpy as np
from jaxtyping import Bool, Float64

from octasplat.engine.shading.gbuffer import GBuffer
from octasplat.engine.shading.material_settings import MaterialSettings
from octasplat.engine.shading.protocol import TracedRays

MIN_ALPHA = 0.9
"""Accumulated alpha from which on a ray shows a surface."""
MIN_VIEW_COSINE = 0.15
"""Neighbours that span a surface seen at a smaller cosine lie on two surfaces."""
MIN_NORMAL_COSINE = 0.9
"""Cosine from which on the normals of neighbours count as those of one smooth surface."""
_ALL, _FROM, _TO = slice(None), slice(1, None), slice(None, -1)
_NEIGHBOR_SLICES = (((_ALL, _ALL, _FROM), (_ALL, _ALL, _TO)), ((_ALL, _FROM), (_ALL, _TO)))
"""The two of each pair of neighbours in a grid of rays, across and down."""
HUBER_DELTA = 0.02
"""Difference of materials at which their smoothness turns from a square to a straight line."""
DARK_METAL_ALBEDO = (0.3, 0.7)
"""Largest channel of the albedo up to which metallic costs all of its weight, and from which on nothing.
Metals reflect about half of the light or more in some channel; the scale of albedos is only known roughly."""


def normal_spread_gradient(
    gbuffer: GBuffer,
    weight: float,
    grad_alpha: Float64[np.ndarray, " r"],
    grad_normal: Float64[np.ndarray, "r 3"],
) -> None:
    """Add the gradient of half the sum of w |n - N|^2 over a ray's Gaussians, N the blended unit normal.

    That is the accumulated alpha minus the length of the blended normal: it needs no neighbours.
    """
    grad_alpha[gbuffer.ray_ids] += weight
    grad_normal[gbuffer.ray_ids] -= weight * gbuffer.facing_normals.blended_world


def add_surface_gradients(
    traced: TracedRays,
    settings: MaterialSettings,
    grad_features: Float64[np.ndarray, "r f"],
    grad_alpha: Float64[np.ndarray, " r"],
    grad_normal: Float64[np.ndarray, "r 3"],
    grad_depth: Float64[np.ndarray, " r"],
) -> None:
    """Add the gradients of all terms of surfaces as rays see them: normals, depths, materials."""
    if settings.depth_normal_weight > 0:
        add_depth_normal_gradient(traced, settings.depth_normal_weight, grad_alpha, grad_normal, grad_depth)
    if settings.smooth_normal_weight > 0:
        add_normal_smoothness_gradient(traced, settings.smooth_normal_weight, grad_normal)
    if max(settings.smooth_weights) > 0:
        add_material_smoothness_gradient(
            traced, settings.smooth_weights, settings.smooth_metal, grad_features, grad_alpha
        )
    if settings.dark_metal_weight:
        add_dark_metal_gradient(traced, settings.dark_metal_weight, grad_features, grad_alpha)


def add_depth_normal_gradient(
    traced: TracedRays,
    weight: float,
    grad_alpha: Float64[np.ndarray, " r"],
    grad_normal: Float64[np.ndarray, "r 3"],
    grad_depth: Float64[np.ndarray, " r"],
) -> None:
    """Add the gradient of one minus the cosine between blended normals and those of neighbouring depths."""
    patches = traced.ray_patches
    if patches is None:
        return
    ray_ids = patches.rays
    result, rays = traced.result, traced.rays
    alpha = 1.0 - result.transmittance[ray_ids].astype(np.float64)
    safe_alpha = np.maximum(alpha, 1e-6)
    depth = result.depth_sum[ray_ids] / safe_alpha
    directions = rays.directions_world[ray_ids].astype(np.float64)
    origins = rays.origins_world if len(rays.origins_world) == 1 else rays.origins_world[ray_ids]
    points = patches.grid(origins + depth[:, None] * directions)
    middle, right, below = points[:, :-1, :-1], points[:, :-1, 1:], points[:, 1:, :-1]
    a, b = right - middle, below - middle
    cross = np.cross(a, b)
    length = np.maximum(np.linalg.norm(cross, axis=-1, keepdims=True), 1e-12)
    towards = -patches.grid(directions)[:, :-1, :-1]
    # turned to the viewer, as blended normals are
    sign = np.where((cross * towards).sum(axis=-1, keepdims=True) < 0, -1.0, 1.0)
    spanned = sign * cross / length
    sums = patches.grid(result.normal_world[ray_ids].astype(np.float64))[:, :-1, :-1]
    normal_length = np.maximum(np.linalg.norm(sums, axis=-1, keepdims=True), 1e-9)
    normal = sums / normal_length
    opaque = patches.grid(alpha) > MIN_ALPHA
    counted = opaque[:, :-1, :-1] & opaque[:, :-1, 1:] & opaque[:, 1:, :-1]
    counted &= (spanned * towards).sum(axis=-1) > MIN_VIEW_COSINE
    # a mean over all rays, counted or not
    share = np.where(counted, weight / len(result.transmittance), 0.0)[..., None]
    cosine = (spanned * normal).sum(axis=-1, keepdims=True)
    grad_sums = -share * (spanned - cosine * normal) / normal_length
    # d of a unit vector: perpendicular to it, over its length
    grad_cross = -share * sign * (normal - cosine * spanned) / length
    grad_a, grad_b = np.cross(b, grad_cross), np.cross(grad_cross, a)
    grad_points = np.zeros_like(points)
    grad_points[:, :-1, 1:] += grad_a
    grad_points[:, 1:, :-1] += grad_b
    grad_points[:, :-1, :-1] -= grad_a + grad_b
    grad_depth_sum = (patches.flatten(grad_points) * directions).sum(axis=1)
    grad_depth[ray_ids] += grad_depth_sum / safe_alpha
    grad_alpha[ray_ids] -= grad_depth_sum * depth / safe_alpha
    grad_grid_normals = np.zeros_like(points)
    grad_grid_normals[:, :-1, :-1] = grad_sums
    grad_normal[ray_ids] += patches.flatten(grad_grid_normals)


def add_normal_smoothness_gradient(
    traced: TracedRays, weight: float, grad_normal: Float64[np.ndarray, "r 3"]
) -> None:
    """Add the gradient of one minus the cosine between neighbouring rays' normals on one smooth surface.

    A surface that is bent evenly has no gradient from it.
    """
    patches = traced.ray_patches
    if patches is None:
        return
    ray_ids = patches.rays
    sums = patches.grid(traced.result.normal_world[ray_ids].astype(np.float64))
    length = np.maximum(np.linalg.norm(sums, axis=-1, keepdims=True), 1e-9)
    normal = sums / length
    opaque = patches.grid(traced.result.transmittance[ray_ids]) < 1 - MIN_ALPHA
    gradient = np.zeros_like(normal)
    for one, other in _NEIGHBOR_SLICES:
        cosine = (normal[one] * normal[other]).sum(axis=-1, keepdims=True)
        # across an edge normals may differ
        counted = (opaque[one] & opaque[other])[..., None] & (cosine > MIN_NORMAL_COSINE)
        share = np.where(counted, weight / len(traced.result.transmittance), 0.0)
        gradient[one] -= share * (normal[other] - cosine * normal[one])
        gradient[other] -= share * (normal[one] - cosine * normal[other])
    grad_normal[ray_ids] += patches.flatten(gradient / length)


def add_material_smoothness_gradient(
    traced: TracedRays,
    weights: tuple[float, ...],
    metal: float,
    grad_features: Float64[np.ndarray, "r f"],
    grad_alpha: Float64[np.ndarray, " r"],
) -> None:
    """Add the gradient of material differences between neighbouring rays: their size, rounded off near zero.

    Each of the five columns of materials has its weight. That of the albedo is 1 + ``metal`` times as large
    between two metals, in between by the square of the smaller metallic: what reflections do not explain yet
    would else be painted on. Metallic itself gets no gradient from that.
    """
    patches = traced.ray_patches
    if patches is None:
        return
    ray_ids = patches.rays
    alpha = 1.0 - traced.result.transmittance[ray_ids].astype(np.float64)
    safe_alpha = np.maximum(alpha, 1e-6)[:, None]
    flat = traced.result.features[ray_ids, :5] / safe_alpha
    material = patches.grid(flat)
    opaque = patches.grid(alpha) > MIN_ALPHA
    gradient = np.zeros_like(material)
    share = np.array(weights) / len(traced.result.transmittance)
    for one, other in _NEIGHBOR_SLICES:
        difference = material[one] - material[other]
        # sqrt(x^2 + delta^2), derived: Huber-like
        slope = difference / np.sqrt(difference**2 + HUBER_DELTA**2)
        slope = _zero_outside(opaque[one] & opaque[other], slope) * share
        both = np.clip(np.minimum(material[one][..., 3:4], material[other][..., 3:4]), 0, 1)
        slope[..., :3] *= 1 + metal * both**2
        gradient[one] += slope
        gradient[other] -= slope
    grad_flat = patches.flatten(gradient)
    grad_features[ray_ids, :5] += grad_flat / safe_alpha
    grad_alpha[ray_ids] -= (grad_flat * flat).sum(axis=1) / safe_alpha[:, 0]


def add_dark_metal_gradient(
    traced: TracedRays,
    weight: float,
    grad_features: Float64[np.ndarray, "r f"],
    grad_alpha: Float64[np.ndarray, " r"],
) -> None:
    """Add the gradient of the mean metallic of surfaces, as far as they are darker than metals are.

    Photographs hardly tell a rough metal from a matt thing of its color, so that metallic would stay where it
    began. The albedo gets no gradient from that, nor does the share of each Gaussian in what is blended.
    """
    alpha = 1.0 - traced.result.transmittance.astype(np.float64)
    counted = np.flatnonzero(alpha > MIN_ALPHA)
    material = traced.result.features[counted, :4] / alpha[counted, None]
    full, none = DARK_METAL_ALBEDO
    darkness = np.clip((none - material[:, :3].max(axis=1)) / (none - full), 0.0, 1.0)
    grad_metallic = weight / len(alpha) * darkness / alpha[counted]
    grad_features[counted, 3] += grad_metallic
    grad_alpha[counted] -= grad_metallic * material[:, 3]


def _zero_outside(
    mask: Bool[np.ndarray, "*shape"], values: Float64[np.ndarray, "*shape 5"]
) -> Float64[np.ndarray, "*shape 5"]:
    return np.where(mask[..., None], values, 0.0)

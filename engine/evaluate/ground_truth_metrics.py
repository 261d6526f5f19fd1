"""Errors of normals, depths, materials and light against ground truth; pure functions of arrays."""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64

from octasplat.engine.core.color import linear_to_srgb
from octasplat.engine.pathtracing.environment import EnvironmentMap

_OCTAVES = 8.0
"""Scales are looked for between 2 to the power of minus and plus this."""
MOST_FITTED = 200_000
"""Most pixels that a scale is fitted to; of more, every N-th is taken."""

Curve = Callable[[Float64[np.ndarray, "*shape"]], Float64[np.ndarray, "*shape"]]

GROUND_TRUTH_DEFINITIONS: dict[str, str] = {
    "normal_mae": "degrees; mean angle between the rendered normal, that of the surface in front (what lies "
    "behind half of the light does not count), and the true one over the true mask; where "
    "nothing is rendered it counts 90",
    "depth_mae": "world units; mean distance of the rendered expected depth (along the camera's axis) from "
    "the true one, over the pixels of the true mask of which at least half is covered",
    "mask_iou": "pixels with at least half coverage and true mask: what both have over what either has",
    "albedo_psnr": "dB; of display values (sRGB curve of the linear albedo) over the true mask, pooled over "
    "all views",
    "albedo_psnr_scaled": "the same after one factor a channel, which brings the linear albedo of all views "
    "together closest to the truth in display values",
    "roughness_mae": "mean absolute error over the true mask",
    "metallic_mae": "mean absolute error over the true mask",
    "environment_psnr": "dB; of x / (1 + x) of linear radiance, weighted by solid angle, at the pixels "
    "of the true map",
    "environment_psnr_scaled": "the same after one factor a channel",
    "relight_psnr": "dB; of whole pictures over black, mean over the views under each map",
    "relight_psnr_scaled": "the same after one factor a channel, fitted to the linear pictures of all views "
    "under all maps together, so that they come closest to the truth in display values inside the true mask",
}
"""What each key of the truth's part of ``metrics.json`` means."""


def normal_angles_degrees(
    normal_world: Float[np.ndarray, "*n 3"], true_world: Float[np.ndarray, "*n 3"]
) -> Float64[np.ndarray, "*n"]:
    """Return angles between unit vectors; 90 where the first is 0."""
    cosine = (normal_world.astype(np.float64) * true_world).sum(axis=-1)
    # The arctangent of both is exact where angles are small; an arccosine is not.
    sine = np.linalg.norm(np.cross(normal_world.astype(np.float64), true_world), axis=-1)
    angle = np.degrees(np.arctan2(sine, cosine))
    return np.where((normal_world == 0).all(axis=-1), 90.0, angle)


def intersection_over_union(one: Bool[np.ndarray, "h w"], other: Bool[np.ndarray, "h w"]) -> float:
    """Return the intersection over union (IoU) of two masks; 1 for two empty ones.

    >>> left, right = np.array([[True, True, False]]), np.array([[False, True, True]])
    >>> round(intersection_over_union(left, right), 3)
    0.333
    """
    either = int((one | other).sum())
    return float((one & other).sum()) / either if either else 1.0


def to_display(linear: Float64[np.ndarray, "*shape"]) -> Float64[np.ndarray, "*shape"]:
    """Convert linear values to display values, clipped to [0, 1]."""
    return linear_to_srgb(np.clip(linear, 0.0, 1.0))


def compress_radiance(linear: Float64[np.ndarray, "*shape"]) -> Float64[np.ndarray, "*shape"]:
    """Compress unbounded radiance below 1: x / (1 + x)."""
    return linear / (1.0 + linear)


def pooled_psnr(
    values: Float[np.ndarray, "n 3"],
    true: Float[np.ndarray, "n 3"],
    weights: Float[np.ndarray, " n"] | None = None,
) -> float:
    """Return the PSNR in dB for a peak of 1 over all rows; infinite where nothing differs."""
    squared = np.square(values.astype(np.float64) - true).mean(axis=1)
    error = float(np.average(squared, weights=weights))
    return float("inf") if error == 0 else float(-10.0 * np.log10(error))


def fit_channel_scales(
    linear: Float[np.ndarray, "n 3"],
    true_linear: Float[np.ndarray, "n 3"],
    curve: Curve,
    weights: Float[np.ndarray, " n"] | None = None,
) -> Float64[np.ndarray, "3"]:
    """Return the factor per channel that brings ``curve(factor * linear)`` closest to ``curve(true_linear)``.

    Least squares, between 1/256 and 256; 1 where a channel is black.
    """
    from scipy.optimize import minimize_scalar

    step = -(-len(linear) // MOST_FITTED)  # rounded up
    scales = np.ones(3)
    weight = 1.0 if weights is None else weights[::step].astype(np.float64)
    for channel in range(3):
        x = linear[::step, channel].astype(np.float64)
        target = curve(true_linear[::step, channel].astype(np.float64))
        if not (x > 0).any():
            continue

        # Defaults hold the values of this channel; names alone would be looked up when called.
        def error(octaves: float, x: np.ndarray = x, target: np.ndarray = target) -> float:
            return float((weight * np.square(curve(2.0**octaves * x) - target)).sum())

        # Coarse steps first, as the error need not have a single valley.
        grid = np.linspace(-_OCTAVES, _OCTAVES, 65)
        near = grid[int(np.argmin([error(octaves) for octaves in grid]))]
        bounds = max(near - 0.25, -_OCTAVES), min(near + 0.25, _OCTAVES)
        found = minimize_scalar(error, bounds=bounds, method="bounded", options={"xatol": 1e-6})
        scales[channel] = 2.0 ** float(found.x)
    return scales


def environment_errors(
    ours: EnvironmentMap, true: EnvironmentMap
) -> tuple[float, float, Float64[np.ndarray, "3"]]:
    """Return the PSNR of a map against the true one, raw and with one factor per channel, and the factors.

    Ours is looked up at the pixels of the true map, bilinearly.
    """
    height, width = true.radiance_linear.shape[:2]
    # Angles from the map's up axis, and around it from its forward axis
    polar = (np.arange(height) + 0.5) / height * np.pi
    around = ((np.arange(width) + 0.5) / width - 0.5) * 2 * np.pi
    sine, cosine = np.sin(polar)[:, None], np.cos(polar)[:, None]
    local = np.stack(
        [sine * np.sin(around), np.broadcast_to(cosine, (height, width)), sine * np.cos(around)], axis=-1
    )
    directions = (local @ true.frame).reshape(-1, 3)  # frame: right, up, forward as rows
    from octasplat.engine.pathtracing.lights import build_light_arrays, eval_environment_map

    lights = build_light_arrays((), ours.frame[1], ours)
    found, _ = eval_environment_map(lights, directions)
    true_radiance = true.radiance_linear.reshape(-1, 3).astype(np.float64)
    # The solid angle of a pixel shrinks with the sine towards the poles.
    weights = np.repeat(np.sin(polar), width)
    scales = fit_channel_scales(found, true_radiance, compress_radiance, weights)
    return (
        pooled_psnr(compress_radiance(found), compress_radiance(true_radiance), weights),
        pooled_psnr(compress_radiance(found * scales), compress_radiance(true_radiance), weights),
        scales,
    )


def finite_mean(values: Sequence[float]) -> float | None:
    """Return the mean of the numbers that are finite; None where none is."""
    finite = [value for value in values if np.isfinite(value)]
    return float(np.mean(finite)) if finite else None


def z_depth(
    depth: Float32[np.ndarray, "h w"],
    directions_world: Float32[np.ndarray, "h w 3"],
    axis_world: Float64[np.ndarray, "3"],
) -> Float64[np.ndarray, "h w"]:
    """Convert distances along rays to distances along the camera's axis."""
    return depth.astype(np.float64) * (directions_world.astype(np.float64) @ axis_world)

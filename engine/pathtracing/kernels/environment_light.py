"""Compiled functions of the environment as a light: its radiance, a direction to it, and its density."""

import math

import numpy as np
from jaxtyping import Float64

from octasplat.engine.core.compilation import kernel
from octasplat.engine.pathtracing.kernels.kernel_args import LightArrays
from octasplat.engine.trace.kernels.native import njit_no_refcount


@njit_no_refcount(forceinline=True)
def _environment_uv(lights: LightArrays, d_x: float, d_y: float, d_z: float) -> tuple[float, float, float]:
    """Return where a direction lies in the map, (u, v) from 0 to 1, and the sine of its angle to up."""
    frame = lights.environment_frame
    right = frame[0, 0] * d_x + frame[0, 1] * d_y + frame[0, 2] * d_z
    up = frame[1, 0] * d_x + frame[1, 1] * d_y + frame[1, 2] * d_z
    forward = frame[2, 0] * d_x + frame[2, 1] * d_y + frame[2, 2] * d_z
    sine = math.sqrt(right * right + forward * forward)
    return 0.5 + math.atan2(right, forward) / (2.0 * math.pi), math.atan2(sine, up) / math.pi, sine


@njit_no_refcount(forceinline=True)
def eval_environment(lights: LightArrays, d_x: float, d_y: float, d_z: float) -> tuple[float, float, float]:
    """Return linear radiance from a direction: bilinear between the map's pixels, round at its sides."""
    radiance = lights.environment_linear
    height, width, _ = radiance.shape
    u, v, _ = _environment_uv(lights, d_x, d_y, d_z)
    x, y = u * width - 0.5, min(max(v * height - 0.5, 0.0), height - 1.0)  # no wrap over the poles
    i, j = math.floor(x), min(int(y), max(height - 2, 0))
    x, y = x - i, y - j
    left, right = int(i) % width, (int(i) + 1) % width
    low = min(j + 1, height - 1)
    a, b, c, d = (1.0 - x) * (1.0 - y), x * (1.0 - y), (1.0 - x) * y, x * y
    red = (
        a * radiance[j, left, 0]
        + b * radiance[j, right, 0]
        + c * radiance[low, left, 0]
        + d * radiance[low, right, 0]
    )
    green = (
        a * radiance[j, left, 1]
        + b * radiance[j, right, 1]
        + c * radiance[low, left, 1]
        + d * radiance[low, right, 1]
    )
    blue = (
        a * radiance[j, left, 2]
        + b * radiance[j, right, 2]
        + c * radiance[low, left, 2]
        + d * radiance[low, right, 2]
    )
    return red, green, blue


@njit_no_refcount(forceinline=True)
def environment_pdf(lights: LightArrays, d_x: float, d_y: float, d_z: float) -> float:
    """Return density over solid angle with which :func:`sample_environment` gives a direction."""
    shares = lights.environment_probabilities
    height, width = shares.shape
    u, v, sine = _environment_uv(lights, d_x, d_y, d_z)
    i, j = min(int(u * width), width - 1), min(int(v * height), height - 1)
    # share of the texel over its solid angle: 2 pi / width by pi / height by the sine
    return shares[j, i] * width * height / (2.0 * math.pi * math.pi * max(sine, 1e-9))


@njit_no_refcount(forceinline=True)
def sample_cdf(cdf: Float64[np.ndarray, " c"], u: float) -> tuple[int, float]:
    """Return the step of a cumulative sum from 0 to 1 in which u lies, and how far in."""
    low, high = 0, len(cdf) - 1
    while high - low > 1:
        middle = (low + high) // 2
        if cdf[middle] <= u:
            low = middle
        else:
            high = middle
    span = cdf[low + 1] - cdf[low]
    # below 1, so that the position stays inside its texel
    return low, min(max((u - cdf[low]) / span, 0.0), 1.0 - 1e-9) if span > 0.0 else 0.5


@njit_no_refcount(forceinline=True)
def sample_environment(lights: LightArrays, u: float, v: float) -> tuple[float, float, float, float]:
    """Return a direction, likelier where the map is brighter, and its density over solid angle."""
    height, width = lights.environment_probabilities.shape
    j, down = sample_cdf(lights.environment_row_cdf, v)
    i, across = sample_cdf(lights.environment_column_cdf[j], u)
    polar = (j + down) / height * math.pi
    around = ((i + across) / width - 0.5) * 2.0 * math.pi
    sine = math.sin(polar)
    right, up, forward = sine * math.sin(around), math.cos(polar), sine * math.cos(around)
    frame = lights.environment_frame
    d_x = right * frame[0, 0] + up * frame[1, 0] + forward * frame[2, 0]
    d_y = right * frame[0, 1] + up * frame[1, 1] + forward * frame[2, 1]
    d_z = right * frame[0, 2] + up * frame[1, 2] + forward * frame[2, 2]
    pdf = (
        lights.environment_probabilities[j, i] * width * height / (2.0 * math.pi * math.pi * max(sine, 1e-9))
    )
    return d_x, d_y, d_z, pdf


@kernel(error_model="numpy")
def eval_environment_array(
    lights: LightArrays,
    directions: Float64[np.ndarray, "n 3"],
    radiance: Float64[np.ndarray, "n 3"],
    pdf: Float64[np.ndarray, " n"],
) -> None:
    """Write radiance and density of rows of directions."""
    for n in range(len(directions)):
        d = directions[n]
        radiance[n, 0], radiance[n, 1], radiance[n, 2] = eval_environment(lights, d[0], d[1], d[2])
        pdf[n] = environment_pdf(lights, d[0], d[1], d[2])

"""Environment maps: equirectangular linear radiance, rotated, and sampled by luminance."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64

from octasplat.engine.shading.environment_frame import environment_frame as environment_frame

_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


@dataclass(frozen=True)
class EnvironmentMap:
    """Distant light from all directions.

    Attributes:
        radiance_linear: rows from up to down; the middle column is forward, to its right lies right.
        frame: rows are right, up and forward as unit vectors in the world.
    """

    radiance_linear: Float32[np.ndarray, "h w 3"]
    frame: Float64[np.ndarray, "3 3"]


@dataclass(frozen=True)
class EnvironmentSampler:
    """Cumulative distribution over a map's texels, by luminance times solid angle.

    Attributes:
        row_cdf: cumulative share of the rows, from 0 to 1.
        column_cdf: cumulative share of the pixels within each row.
        probabilities: share of each pixel; they add up to 1.
    """

    row_cdf: Float64[np.ndarray, " h1"]
    column_cdf: Float64[np.ndarray, "h w1"]
    probabilities: Float64[np.ndarray, "h w"]


def build_environment_sampler(radiance_linear: Float32[np.ndarray, "h w 3"]) -> EnvironmentSampler:
    """Return the cumulative sums of a map's luminance times solid angle, filtered over neighbours.

    The neighbours count since radiance is bilinear between pixels: none with light may have the share 0.
    """
    height, width = radiance_linear.shape[:2]
    light = radiance_linear.astype(np.float64) @ _LUMINANCE
    light = (np.roll(light, 1, axis=1) + 2 * light + np.roll(light, -1, axis=1)) / 4
    rows = np.pad(light, ((1, 1), (0, 0)), mode="edge")  # rows do not wrap over the poles
    light = (rows[:-2] + 2 * rows[1:-1] + rows[2:]) / 4
    # a row's solid angle shrinks towards the poles
    light *= np.sin((np.arange(height) + 0.5) / height * np.pi)[:, None]
    total = light.sum()
    # a black map is sampled evenly
    shares = light / total if total > 0 else np.full((height, width), 1.0 / (height * width))
    of_rows = shares.sum(axis=1)
    within = np.cumsum(shares, axis=1) / np.where(of_rows > 0, of_rows, 1.0)[:, None]
    columns = np.concatenate([np.zeros((height, 1)), within], axis=1)
    cumulative = np.concatenate([[0.0], np.cumsum(of_rows)])
    return EnvironmentSampler(cumulative / cumulative[-1], columns, shares)


def mean_irradiance(radiance_linear: Float32[np.ndarray, "h w 3"]) -> Float64[np.ndarray, "3"]:
    """Return pi times the mean radiance: about the irradiance of a surface that faces the light."""
    height = len(radiance_linear)
    # solid angles of rows: differences of the cosine of the polar angle
    edges = np.cos(np.arange(height + 1) / height * np.pi)
    bands = (edges[:-1] - edges[1:]) / 2
    return np.asarray(np.pi * (bands[:, None] * radiance_linear.mean(axis=1, dtype=np.float64)).sum(axis=0))

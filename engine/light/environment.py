"""Environment maps: equirectangular images of linear radiance, turned, and sampled by their brightness."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64

from engine.errors import ConfigError, DatasetError
from engine.render.images import read_image, write_exr, write_rgbe
from engine.shading.environment_frame import environment_frame as environment_frame

MAX_PIXELS = 1 << 27
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


@dataclass(frozen=True)
class EnvironmentMap:
    """Light from all around.

    Attributes:
        radiance_linear: rows from up to down; the middle column is forward, to its right lies right.
        frame: rows are right, up and forward as unit vectors in the world.
    """

    radiance_linear: Float32[np.ndarray, "h w 3"]
    frame: Float64[np.ndarray, "3 3"]


@dataclass(frozen=True)
class EnvironmentSampler:
    """Cumulative sums over a map, to draw its pixels by how much light they bring.

    Attributes:
        rows: cumulative share of the rows, from 0 to 1.
        columns: cumulative share of the pixels within each row.
        shares: share of each pixel; they add up to 1.
    """

    rows: Float64[np.ndarray, " h1"]
    columns: Float64[np.ndarray, "h w1"]
    shares: Float64[np.ndarray, "h w"]


def read_environment(path: Path) -> Float32[np.ndarray, "h w 3"]:
    """The linear radiance of an HDR or EXR image; a single channel stands for all three.

    Raises:
        ConfigError: the file is no such image, or holds values that are negative or not finite.
    """
    if path.suffix.lower() not in (".hdr", ".exr", ".pic"):
        raise ConfigError(f"{path}: an environment is an HDR or EXR image; an 8-bit one holds no light.")
    try:
        image = read_image(path)
    except DatasetError as error:
        raise ConfigError(f"{path}: the environment cannot be read: {error}") from None
    if image.shape[0] * image.shape[1] > MAX_PIXELS:
        raise ConfigError(f"{path}: has more than {MAX_PIXELS >> 20} million pixels; make it smaller.")
    rgb = image[..., :3] if image.shape[2] >= 3 else np.repeat(image[..., :1], 3, axis=2)
    if not np.isfinite(rgb).all() or (rgb < 0).any():
        raise ConfigError(f"{path}: holds values that are negative or not finite; mend the image.")
    return np.ascontiguousarray(rgb)


def write_environment(path: Path, radiance_linear: Float32[np.ndarray, "h w 3"]) -> None:
    """Write a map as RGBE (``.hdr``, values to within 1 %) or as EXR (``.exr``, exactly), atomically.

    Raises:
        ConfigError: the name ends otherwise.
        OutputError: the file cannot be written.
    """
    suffix = path.suffix.lower()
    if suffix == ".hdr":
        write_rgbe(path, radiance_linear)
    elif suffix == ".exr":
        write_exr(path, {name: radiance_linear[..., k] for k, name in enumerate("RGB")})
    else:
        raise ConfigError(f"{path}: an environment is written as .hdr or .exr.")


def environment_sampler(radiance_linear: Float32[np.ndarray, "h w 3"]) -> EnvironmentSampler:
    """Sums over the luminance of each pixel and its neighbours, times its solid angle.

    The neighbours count since radiance is bilinear between pixels: none with light may have the share 0.
    """
    height, width = radiance_linear.shape[:2]
    light = radiance_linear.astype(np.float64) @ _LUMINANCE
    light = (np.roll(light, 1, axis=1) + 2 * light + np.roll(light, -1, axis=1)) / 4
    rows = np.pad(light, ((1, 1), (0, 0)), mode="edge")
    light = (rows[:-2] + 2 * rows[1:-1] + rows[2:]) / 4
    light *= np.sin((np.arange(height) + 0.5) / height * np.pi)[:, None]
    total = light.sum()
    shares = light / total if total > 0 else np.full((height, width), 1.0 / (height * width))
    of_rows = shares.sum(axis=1)
    within = np.cumsum(shares, axis=1) / np.where(of_rows > 0, of_rows, 1.0)[:, None]
    columns = np.concatenate([np.zeros((height, 1)), within], axis=1)
    cumulative = np.concatenate([[0.0], np.cumsum(of_rows)])
    return EnvironmentSampler(cumulative / cumulative[-1], columns, shares)


def irradiance_mean(radiance_linear: Float32[np.ndarray, "h w 3"]) -> Float64[np.ndarray, "3"]:
    """Pi times the mean radiance over all directions: about the irradiance on a surface that faces it."""
    height = len(radiance_linear)
    edges = np.cos(np.arange(height + 1) / height * np.pi)
    bands = (edges[:-1] - edges[1:]) / 2
    return np.asarray(np.pi * (bands[:, None] * radiance_linear.mean(axis=1, dtype=np.float64)).sum(axis=0))

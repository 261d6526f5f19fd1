"""Environment maps in files: equirectangular images of linear radiance, HDR or EXR.

A learnt background, whose values are display values, is such a file too, so that other programs can use it.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from octasplat.engine.core.color import linear_to_srgb, srgb_to_linear
from octasplat.engine.core.errors import ConfigError, DatasetError
from octasplat.engine.render.image_files import read_image, stated_exposure, write_exr, write_rgbe

MAX_PIXELS = 1 << 27


def read_environment(path: Path, warn: Callable[[str], None] | None = None) -> Float32[np.ndarray, "h w 3"]:
    """Return the linear radiance of an HDR or EXR image; a single channel stands for all three.

    Args:
        path: the image.
        warn: called with a sentence where values that no light has are replaced, and where the image is
            black, has not the shape of such a map, or states an exposure. None refuses such values and says
            nothing of the rest.

    Raises:
        ConfigError: the file is no such image, or holds values that are negative or not finite and nobody
            is told.
    """
    if path.suffix.lower() not in (".hdr", ".exr", ".pic"):
        raise ConfigError(f"{path}: an environment is an HDR or EXR image; an 8-bit one holds no light.")
    try:
        image, exposure = read_image(path, as_shown=True), stated_exposure(path)
    except DatasetError as error:
        raise ConfigError(f"{path}: the environment cannot be read: {error}") from None
    if image.shape[0] * image.shape[1] > MAX_PIXELS:
        raise ConfigError(f"{path}: has more than {MAX_PIXELS >> 20} million pixels; make it smaller.")
    rgb = image[..., :3] if image.shape[2] >= 3 else np.repeat(image[..., :1], 3, axis=2)
    invalid = ~(np.isfinite(rgb) & (rgb >= 0)).all(axis=2)
    if invalid.any():
        if warn is None:
            raise ConfigError(f"{path}: holds values that are negative or not finite; mend the image.")
        if invalid.all():
            raise ConfigError(f"{path}: all of its pixels are negative or not finite; choose another image.")
        warn(
            f"{path}: {invalid.sum():,} of {invalid.size:,} pixels hold values that are negative or not "
            "finite; negative ones count as 0, infinite ones as the brightest pixel, others as 0."
        )
        brightest = rgb[np.isfinite(rgb)].max()  # an infinite value is a lamp beyond the format's range
        rgb = np.maximum(np.nan_to_num(rgb, nan=0.0, posinf=brightest, neginf=0.0), 0.0)
    if warn is not None:
        height, width = rgb.shape[:2]
        if width != 2 * height:
            warn(
                f"{path}: is {width} x {height} pixels; an equirectangular map is twice as wide as high, so "
                "this one is stretched around."
            )
        if exposure != 1.0:
            warn(
                f"{path}: says that its values were multiplied by {exposure:g} (EXPOSURE); they are taken as "
                "they are."
            )
        if not rgb.any():
            warn(f"{path}: is black, so that it lights nothing.")
    return np.ascontiguousarray(rgb)


def write_environment(path: Path, radiance_linear: Float32[np.ndarray, "h w 3"]) -> None:
    """Write a map as RGBE (``.hdr``, to within 1/256 of the brightest channel) or EXR (exactly), atomically.

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


def write_background_map(path: Path, rgb_srgb: Float32[np.ndarray, "h w 3"]) -> None:
    """Write a learnt background, sRGB-encoded, as an equirectangular map of linear radiance.

    Raises:
        OutputError: the file cannot be written.
    """
    write_environment(path, srgb_to_linear(rgb_srgb).astype(np.float32))


def read_background_map(path: Path) -> Float32[np.ndarray, "h w 3"]:
    """Return the sRGB-encoded values of a learnt background.

    Raises:
        ConfigError: the file is no such map.
    """
    rgb = read_environment(path)
    height, width = rgb.shape[:2]
    if width != 2 * height:
        raise ConfigError(
            f"{path}: is {width} x {height} pixels; the background of a run is twice as wide as high."
        )
    return linear_to_srgb(rgb).astype(np.float32)

"""Image files: 8-bit PNG and WebP for display, OpenEXR and RGBE for further processing.

Colors in memory are display values (sRGB-encoded) in [0, 1]. A PNG keeps them as they are. An EXR holds, as
its readers expect, linear light: ``exr_layers`` converts.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import OpenImageIO as oiio
from jaxtyping import Float32
from PIL import Image

from octasplat.engine.core.color import srgb_to_linear, to_bytes
from octasplat.engine.core.errors import DatasetError, OutputError
from octasplat.engine.core.image_messages import image_message
from octasplat.engine.core.portable_names import is_text
from octasplat.engine.core.writing import atomic_replace

_RAW_CONFIG = "oiio:UnassociatedAlpha"
"""Keeps OpenImageIO from multiplying or dividing colors by alpha on its own."""
MAX_WINDOW_PIXELS = 1 << 27
_PNG_LEVEL = 4
"""A third of the time of zlib's level 6, and files larger by 6 %."""
_FIXED_TIMESTAMP = "1970:01:01 00:00:00"
"""Else OpenImageIO notes the time in an EXR, and the same picture would have other bytes each time."""


class _Axes(NamedTuple):
    """How rows and columns of stored pixels become those of an image: swapped first, then maybe reversed."""

    transposed: bool
    down: int
    right: int


_RADIANCE_AXES = {
    1: _Axes(False, 1, 1), 2: _Axes(False, 1, -1), 3: _Axes(False, -1, -1), 4: _Axes(False, -1, 1),
    5: _Axes(True, 1, 1), 6: _Axes(True, -1, 1), 7: _Axes(True, -1, -1), 8: _Axes(True, 1, -1),
}  # fmt: skip
"""By OpenImageIO's number for the line of a Radiance picture that names its axes: -Y +X, -Y -X, +Y -X, +Y +X,
+X -Y, +X +Y, -X +Y, -X -Y. Exif means other turns by 6 and 8."""


def exr_layers(
    rgb_srgb: Float32[np.ndarray, "h w 3"],
    *,
    alpha: Float32[np.ndarray, "h w"] | None = None,
    depth: Float32[np.ndarray, "h w"] | None = None,
    normals_world: Float32[np.ndarray, "h w 3"] | None = None,
    transparent: bool = False,
) -> dict[str, Float32[np.ndarray, "h w"]]:
    """Return a render as named EXR channels.

    Args:
        rgb_srgb: The render, composited on display values; it becomes linear R, G, B as displayed, that is,
            with its background and not divided by alpha.
        transparent: The render is over black, which stands for nothing: R, G, B become linear colors
            multiplied by alpha, as EXR has them, so that other programs can lay them over anything.
        alpha: Becomes A.
        depth: Distance in scene units; becomes Z.
        normals_world: Becomes N.x, N.y, N.z.

    Returns:
        The channels by name, ready for ``write_exr``.
    """
    if transparent and alpha is not None:
        # Multiplied in linear light, not before it: decoding what was multiplied darkens every edge.
        linear = alpha[..., None] * srgb_to_linear(rgb_srgb / np.maximum(alpha, 1e-6)[..., None])
    else:
        linear = srgb_to_linear(rgb_srgb)
    layers = {name: linear[..., k] for k, name in enumerate("RGB")}
    if alpha is not None:
        layers["A"] = alpha
    if depth is not None:
        layers["Z"] = depth
    if normals_world is not None:
        layers |= {f"N.{axis}": normals_world[..., k] for k, axis in enumerate("xyz")}
    return layers


def write_png(
    path: Path, rgb_srgb: Float32[np.ndarray, "h w 3"], alpha: Float32[np.ndarray, "h w"] | None = None
) -> None:
    """Write display values as an 8-bit PNG, atomically.

    Args:
        path: Where to.
        rgb_srgb: Straight colors, as PNG defines them: not multiplied by alpha. A render over black is
            multiplied; divide it by its alpha first if both are to be written.
        alpha: Coverage in [0, 1]; ``None`` writes an opaque image.

    Raises:
        OutputError: The file cannot be written.
    """
    image = rgb_srgb if alpha is None else np.concatenate([rgb_srgb, alpha[..., None]], axis=-1)
    height, width, channels = image.shape
    spec = oiio.ImageSpec(width, height, channels, oiio.UINT8)
    spec.attribute("oiio:ColorSpace", "sRGB")
    spec.attribute("png:compressionLevel", _PNG_LEVEL)
    _write(path, spec, to_bytes(image))


def write_webp(path: Path, rgb_srgb: Float32[np.ndarray, "h w 3"], *, quality: int = 90) -> None:
    """Write display values as a lossy WebP, atomically; ``quality`` runs from 0 to 100.

    Raises:
        OutputError: The file cannot be written.
    """
    height, width, channels = rgb_srgb.shape
    spec = oiio.ImageSpec(width, height, channels, oiio.UINT8)
    spec.attribute("Compression", f"webp:{quality}")
    _write(path, spec, to_bytes(rgb_srgb))


def write_exr(path: Path, channels: Mapping[str, Float32[np.ndarray, "h w"]], *, half: bool = False) -> None:
    """Write named channels as one OpenEXR image with ZIP compression, atomically.

    Args:
        path: Where to.
        channels: Values by channel name, written as they are; see ``exr_layers`` for the names in use.
        half: Store 16-bit floats, except Z, whose range a half does not hold.

    Raises:
        OutputError: The file cannot be written.
    """
    names = tuple(channels)
    stacked = np.stack([channels[name] for name in names], axis=-1).astype(np.float32, copy=False)
    height, width, count = stacked.shape
    spec = oiio.ImageSpec(width, height, count, oiio.FLOAT)
    spec.channelnames = names
    if half:
        spec.channelformats = tuple(oiio.TypeDesc(oiio.FLOAT if name == "Z" else oiio.HALF) for name in names)
    spec.attribute("compression", "zip")
    spec.attribute("DateTime", _FIXED_TIMESTAMP)
    if "Z" in names:
        spec.z_channel = names.index("Z")
    if "A" in names:
        spec.alpha_channel = names.index("A")
    _write(path, spec, stacked)


def write_rgbe(path: Path, rgb_linear: Float32[np.ndarray, "h w 3"]) -> None:
    """Write linear light as a Radiance picture, three bytes and a shared exponent a pixel, atomically.

    Raises:
        OutputError: The file cannot be written.
    """
    height, width, channels = rgb_linear.shape
    # The format has 256 steps up to the power of two above the brightest channel; OpenImageIO cuts to them.
    brightest = rgb_linear.max(axis=2, keepdims=True)
    _, exponent = np.frexp(brightest + np.ldexp(np.float32(0.5), np.frexp(brightest)[1] - 8))
    half_step = np.ldexp(np.float32(0.5), exponent - 8)
    rounded = np.where(rgb_linear > 0, rgb_linear + half_step, 0).astype(np.float32)
    _write(path, oiio.ImageSpec(width, height, channels, oiio.FLOAT), rounded)


def read_image(path: Path, *, as_shown: bool = False) -> Float32[np.ndarray, "h w c"]:
    """Return an image with all its channels, as stored: 8- and 16-bit values scaled to [0, 1], floats as is.

    Alpha is neither multiplied in nor divided out.

    Args:
        path: The file.
        as_shown: Turn a Radiance picture as its head says, and return the display window of an EXR, black
            where that has no pixels.

    Raises:
        DatasetError: The file is missing, damaged or of no known format.
    """
    if not path.is_file():
        raise DatasetError(f"There is no image {path}.")
    config = oiio.ImageSpec()
    config.attribute(_RAW_CONFIG, 1)
    source = oiio.ImageInput.open(str(path), config)
    if source is None:
        raise DatasetError(f"Cannot read {path} as an image: {image_message(oiio)}.")
    try:
        spec = source.spec()
        pixels = source.read_image(0, 0, 0, spec.nchannels, oiio.FLOAT)
        if pixels is None:
            raise DatasetError(f"The image {path} is damaged: {image_message(source)}.")
        shape = (spec.height, spec.width, spec.nchannels)
        stored = np.asarray(pixels, dtype=np.float32).reshape(shape)
        return _as_shown(stored, spec, source.format_name()) if as_shown else stored
    finally:
        source.close()


def stated_exposure(path: Path) -> float:
    """Return the factor by which the values of a Radiance picture were multiplied, as its head says, else 1.

    Raises:
        DatasetError: The file is missing, damaged or of no known format.
    """
    source = oiio.ImageInput.open(str(path))
    if source is None:
        raise DatasetError(f"Cannot read {path} as an image: {image_message(oiio)}.")
    try:
        return float(source.spec().get_float_attribute("hdr:exposure", 1.0))
    finally:
        source.close()


def _as_shown(pixels: Float32[np.ndarray, "h w c"], spec: Any, kind: str) -> Float32[np.ndarray, "a b c"]:
    """Return the pixels of a Radiance picture turned upright, or those in the display window of an EXR."""
    if kind == "hdr":
        axes = _RADIANCE_AXES[spec.get_int_attribute("Orientation", 1)]
        turned = pixels.swapaxes(0, 1) if axes.transposed else pixels
        return np.ascontiguousarray(turned[:: axes.down, :: axes.right])
    window = (spec.full_height, spec.full_width)
    top, left = spec.y - spec.full_y, spec.x - spec.full_x
    if (top, left) == (0, 0) and pixels.shape[:2] == window:
        return pixels
    if window[0] * window[1] > MAX_WINDOW_PIXELS:
        raise DatasetError(f"its display window has more than {MAX_WINDOW_PIXELS >> 20} million pixels.")
    shown = np.zeros((*window, pixels.shape[2]), np.float32)
    rows = slice(max(top, 0), min(top + spec.height, window[0]))
    columns = slice(max(left, 0), min(left + spec.width, window[1]))
    if rows.start < rows.stop and columns.start < columns.stop:
        shown[rows, columns] = pixels[
            rows.start - top : rows.stop - top, columns.start - left : columns.stop - left
        ]
    return shown


def shrink_to(image: Float32[np.ndarray, "h w c"], max_side_px: int) -> Float32[np.ndarray, "a b c"]:
    """Return the image, shrunk with antialiasing to at most ``max_side_px``; never enlarged."""
    height, width, channels = image.shape
    scale = max_side_px / max(height, width)
    if scale >= 1:
        return image
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    shrunk = np.empty((size[1], size[0], channels), np.float32)
    for channel in range(channels):
        plane = Image.fromarray(np.ascontiguousarray(image[..., channel]))
        # one axis after the other: a tenth of the time of OpenImageIO, which has the same filter
        shrunk[..., channel] = plane.resize(size, Image.Resampling.LANCZOS)
    return shrunk


def _write(path: Path, spec: Any, pixels: np.ndarray) -> None:
    if not is_text(path):
        raise OutputError(f"Cannot write {path}: its path is no text; choose another.")
    # Not called by its type, an ImageSpec: the tests' type checker would keep that beyond OpenImageIO's end.
    spec.attribute(_RAW_CONFIG, 1)
    try:
        with atomic_replace(path) as temporary:
            output = oiio.ImageOutput.create(str(temporary))
            if output is None:
                raise OutputError(f"Cannot write {path}: {image_message(oiio) or 'unknown image format'}.")
            # close() is the last step that can fail: some formats write only then.
            done = output.open(str(temporary), spec) and output.write_image(np.ascontiguousarray(pixels))
            if not (output.close() and done):
                raise OutputError(f"Cannot write {path}: {image_message(output) or 'the disk may be full'}.")
    except OSError as error:
        raise OutputError(f"Cannot write {path}: {error.strerror or error}.") from error

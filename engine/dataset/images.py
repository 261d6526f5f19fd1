"""Reader of photographs and masks of any format, as display values at a working size."""

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from jaxtyping import Float32, UInt8
from PIL.TiffImagePlugin import ImageFileDirectory_v2

from octasplat.engine.core.color import linear_to_srgb
from octasplat.engine.core.errors import DamagedImageError, DatasetError
from octasplat.engine.core.image_messages import image_message
from octasplat.engine.core.portable_names import is_text
from octasplat.engine.core.threads import limit_torch_threads
from octasplat.engine.dataset.image_info import ImageInfo, Storage

Pixels = np.ndarray[Any, np.dtype[Any]]
_FLOATS = (oiio.HALF, oiio.FLOAT, oiio.DOUBLE)
_EXTRA_SAMPLES = 338
"""The TIFF tag that says what channels beyond the colors are."""


@dataclass(frozen=True)
class ValueScale:
    """The meaning of the stored values of photographs of one storage.

    Attributes:
        full: the stored value of full brightness.
        is_display: whether values are display values, not linear light.
    """

    full: float
    is_display: bool


def read_image_info(path: Path) -> ImageInfo:
    """Read the header of an image.

    Raises:
        DatasetError: the file is missing or not an image.
    """
    source, spec = open_image(path)
    source.close()
    return ImageInfo(
        width_px=spec.width,
        height_px=spec.height,
        bits=8 if spec.format.basetype in (oiio.UINT8, oiio.INT8) else 16,
        has_alpha=alpha_channel_of(spec, path) is not None,
        orientation=spec.get_int_attribute("Orientation", 1),
        storage=_storage_kind(spec, path),
    )


def read_stored_colors(path: Path) -> Float32[np.ndarray, "h w 3"]:
    """Read the colors of an image in the file's own units, e.g. 0 to 65535 for 16 bits.

    Raises:
        DatasetError: the file cannot be read to its end.
    """
    source, spec = open_image(path)
    kind = "float" if spec.format.basetype in _FLOATS else "uint16"
    pixels = read_pixels(source, path, kind)
    return _color_channels(pixels, spec, alpha_channel_of(spec, path)).astype(np.float32)


def read_photo(
    path: Path, width_px: int, height_px: int, bits: int, scale: ValueScale | None = None
) -> tuple[Pixels, UInt8[np.ndarray, "h w"] | None]:
    """Read a photograph as straight (not premultiplied) display colors.

    Floating-point formats hold linear light: they are clipped to [0, 1] and sRGB-encoded. A file that is
    larger than the working size is reduced with an antialiased bicubic filter, on premultiplied colors
    where it has an alpha channel.

    Args:
        path: the image file.
        width_px: working width, not more than that of the file.
        height_px: working height, not more than that of the file.
        bits: 8 or 16, the depth of the answer.
        scale: what the stored values mean, where that is not as the format says.

    Returns:
        Colors (height, width, 3) as uint8 or uint16 over their full range, and alpha or None.

    Raises:
        DatasetError: the file cannot be read to its end.
    """
    source, spec = open_image(path)
    is_float = spec.format.basetype in _FLOATS
    is_8_bit = spec.format.basetype in (oiio.UINT8, oiio.INT8)
    straight = spec.get_int_attribute("oiio:UnassociatedAlpha", 0) == 1
    pixels = read_pixels(source, path, "float" if is_float else "uint8" if is_8_bit else "uint16")
    alpha_channel = alpha_channel_of(spec, path)
    rgb = _color_channels(pixels, spec, alpha_channel)
    alpha = None if alpha_channel is None else pixels[..., alpha_channel]
    if scale is not None:
        rgb = np.clip(rgb.astype(np.float32) / np.float32(scale.full), 0.0, None)
        if not is_float:
            rgb = _as_bits(rgb, 16)
    resized = (width_px, height_px) != (spec.width, spec.height)

    if alpha is None and not is_float:
        if resized and is_8_bit:
            rgb = resize(rgb, width_px, height_px)
        elif resized:
            rgb = resize(_as_float(rgb), width_px, height_px)
        return _as_bits(rgb, bits), None

    colors = _as_float(rgb)
    coverage = None if alpha is None else np.clip(_as_float(alpha), 0.0, 1.0)
    if coverage is not None and not straight:
        colors = _unpremultiply_alpha(colors, coverage)
    if is_float:
        colors = np.clip(np.nan_to_num(colors, nan=0.0, posinf=1.0, neginf=0.0), 0.0, 1.0)
        if scale is None or not scale.is_display:
            colors = linear_to_srgb(colors)
    if resized and coverage is None:
        colors = resize(colors, width_px, height_px)
    elif resized and coverage is not None:
        planes = np.concatenate([colors * coverage[..., None], coverage[..., None]], axis=2)
        planes = resize(planes, width_px, height_px)
        # Colors are divided before the filter's overshoot is clipped off alpha, as both overshoot alike.
        colors = _unpremultiply_alpha(planes[..., :3], planes[..., 3])
        coverage = np.clip(planes[..., 3], 0.0, 1.0)
    elif not is_float and straight:
        # Nothing was computed, so the stored values pass through exactly.
        assert alpha is not None
        return _as_bits(rgb, bits), _as_bits(alpha, 8)
    return _as_bits(colors, bits), None if coverage is None else _as_bits(coverage, 8)


def resize(pixels: Pixels, width_px: int, height_px: int, mode: str = "bicubic") -> Pixels:
    """Reduce an image (height, width, channels) of uint8 or float32 with an antialiased filter.

    The filter (Keys' bicubic, or a triangle for ``bilinear``) is as wide as the reduction asks for. Torch's
    implementation takes 0.01 s to 0.3 s for 12 MP where OpenImageIO's Lanczos filter takes 2 s to 5 s.
    """
    import torch  # here, so that reading a model alone does not wait for it

    planes = torch.from_numpy(np.ascontiguousarray(pixels)).permute(2, 0, 1)[None]
    with torch.no_grad(), limit_torch_threads():
        small = torch.nn.functional.interpolate(planes, (height_px, width_px), mode=mode, antialias=True)
    return np.ascontiguousarray(small[0].permute(1, 2, 0).numpy())


def open_image(path: Path) -> tuple[Any, Any]:
    """Open an image; return what reads it and its header.

    Raises:
        DamagedImageError: the file is missing or not an image.
        DatasetError: its path is no text.
    """
    if not is_text(path):
        raise DatasetError(f"{path} cannot be read as an image: its path is no text; rename it.")
    # By default OpenImageIO multiplies alpha into the colors of formats that store them straight.
    wish = oiio.ImageSpec()
    wish.attribute("oiio:UnassociatedAlpha", 1)
    source = oiio.ImageInput.open(str(path), wish)
    if source is None:
        reason = _single_line_message(image_message(oiio), path)
        raise DamagedImageError(f"{path} cannot be read as an image{reason}; replace the file.", path)
    return source, source.spec()


def read_pixels(source: Any, path: Path, kind: str) -> Pixels:
    """Read all channels (height, width, channels) of an opened image, converted to ``kind``.

    Raises:
        DamagedImageError: the file is damaged or cut short.
    """
    pixels = source.read_image(kind)
    message = image_message(source)
    source.close()
    # A JPEG that ends early is filled up with gray and only this message tells.
    if pixels is None or "premature end" in message.lower():
        raise DamagedImageError(
            f"{path} is damaged or cut short{_single_line_message(message, path)}; replace the file.", path
        )
    return np.asarray(pixels).reshape(pixels.shape[0], pixels.shape[1], -1)


def _single_line_message(message: str, path: Path) -> str:
    line = " ".join(message.replace(f'("{path}")', "").replace(f'"{path}"', "it").split())
    return f" ({line.rstrip('.')})" if line else ""


def alpha_channel_of(spec: Any, path: Path) -> int | None:
    """Return the index of the alpha channel; None where the file does not say that there is one."""
    found = int(spec.alpha_channel)
    if found >= spec.nchannels:  # OpenImageIO's header of a GIF counts one too far
        found = list(spec.channelnames).index("A") if "A" in spec.channelnames else -1
    if found < 0 or (_is_tiff(spec) and not _has_extra_samples(path)):
        return None
    return found


def _is_tiff(spec: Any) -> bool:
    return spec.get_int_attribute("tiff:PhotometricInterpretation", -1) >= 0


def _has_extra_samples(path: Path) -> bool:
    """Return whether a TIFF declares its extra channels; OpenImageIO takes a fourth one as alpha anyway."""
    try:
        with path.open("rb") as file:
            head = file.read(8)
            # The header of a BigTIFF (version 43) has 16 bytes, that of a TIFF 8.
            head += file.read(8) if head[2:4] in (b"\x2b\0", b"\0\x2b") else b""
            tags = ImageFileDirectory_v2(head)
            file.seek(tags.next)
            tags.load(file)
            return _EXTRA_SAMPLES in tags
    except (OSError, SyntaxError, ValueError, struct.error):
        return True  # where Pillow cannot tell, OpenImageIO's answer stands


def _storage_kind(spec: Any, path: Path) -> Storage:
    if spec.format.basetype in _FLOATS:
        return "radiance" if path.suffix.lower() in (".exr", ".hdr", ".rgbe", ".pic") else "float"
    return "8-bit" if spec.format.basetype in (oiio.UINT8, oiio.INT8) else "16-bit"


def _color_channels(pixels: Pixels, spec: Any, alpha_channel: int | None) -> Pixels:
    names = [name.rsplit(".", 1)[-1].upper() for name in spec.channelnames]
    if all(letter in names for letter in "RGB"):
        picked = [names.index(letter) for letter in "RGB"]
    else:
        others = [i for i in range(len(names)) if i != alpha_channel]
        picked = others[:3] if len(others) >= 3 and "Y" not in names else [others[0] if others else 0] * 3
    if picked == [0, 1, 2] and pixels.shape[2] == 3:
        return pixels
    return np.ascontiguousarray(pixels[..., picked])


def _as_float(values: Pixels) -> Float32[np.ndarray, "*shape"]:
    if values.dtype == np.float32:
        return values
    return values.astype(np.float32) / np.float32(np.iinfo(values.dtype).max)


def _as_bits(values: Pixels, bits: int) -> Pixels:
    target = np.uint8 if bits == 8 else np.uint16
    if values.dtype == target:
        return values
    if values.dtype == np.uint8:
        # 255 * 257 = 65535: full brightness stays full brightness.
        return values.astype(np.uint16) * np.uint16(257)
    full = np.float32(np.iinfo(target).max)
    return (np.clip(_as_float(values), 0.0, 1.0) * full + np.float32(0.5)).astype(target)


def _unpremultiply_alpha(
    colors: Float32[np.ndarray, "h w 3"], alpha: Float32[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w 3"]:
    divisor = np.where(alpha > 0, alpha, np.float32(1.0))
    return np.where(alpha[..., None] > 0, colors / divisor[..., None], np.float32(0.0)).astype(np.float32)

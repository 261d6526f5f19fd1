"""Reading photographs and masks, whatever their format, as display values at a working size."""

from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from jaxtyping import Float32, UInt8

from octasplat.engine.colour import linear_to_srgb
from octasplat.engine.dataset.image_info import ImageInfo
from octasplat.engine.errors import DatasetError
from octasplat.engine.threads import one_torch_thread

Pixels = np.ndarray[Any, np.dtype[Any]]


def read_image_info(path: Path) -> ImageInfo:
    """Read the header of an image.

    Raises:
        DatasetError: the file is missing or not an image.
    """
    source, spec = _open_image(path)
    source.close()
    return ImageInfo(
        width_px=spec.width,
        height_px=spec.height,
        bits=8 if spec.format.basetype in (oiio.UINT8, oiio.INT8) else 16,
        has_alpha=spec.alpha_channel >= 0,
        orientation=spec.get_int_attribute("Orientation", 1),
    )


def read_photo(
    path: Path, width_px: int, height_px: int, bits: int
) -> tuple[Pixels, UInt8[np.ndarray, "h w"] | None]:
    """Read a photograph as straight (not premultiplied) display colours.

    Floating-point formats hold linear light: they are clipped to [0, 1] and sRGB-encoded. A file that is
    larger than the working size is reduced with an antialiased bicubic filter, on premultiplied colours
    where it has an alpha channel.

    Args:
        path: the image file.
        width_px: working width, not more than that of the file.
        height_px: working height, not more than that of the file.
        bits: 8 or 16, the depth of the answer.

    Returns:
        Colours (height, width, 3) as uint8 or uint16 over their full range, and alpha or None.

    Raises:
        DatasetError: the file cannot be read to its end.
    """
    source, spec = _open_image(path)
    is_float = spec.format.basetype in (oiio.HALF, oiio.FLOAT, oiio.DOUBLE)
    is_8_bit = spec.format.basetype in (oiio.UINT8, oiio.INT8)
    straight = spec.get_int_attribute("oiio:UnassociatedAlpha", 0) == 1
    pixels = _read_pixels(source, path, "float" if is_float else "uint8" if is_8_bit else "uint16")
    rgb = _colour_channels(pixels, spec)
    alpha = pixels[..., spec.alpha_channel] if spec.alpha_channel >= 0 else None
    resized = (width_px, height_px) != (spec.width, spec.height)

    if alpha is None and not is_float:
        if resized and is_8_bit:
            rgb = resize(rgb, width_px, height_px)
        elif resized:
            rgb = resize(_as_float(rgb), width_px, height_px)
        return _as_bits(rgb, bits), None

    colours = _as_float(rgb)
    coverage = None if alpha is None else np.clip(_as_float(alpha), 0.0, 1.0)
    if coverage is not None and not straight:
        colours = _unpremultiplied(colours, coverage)
    if is_float:
        colours = linear_to_srgb(np.clip(np.nan_to_num(colours, nan=0.0, posinf=1.0, neginf=0.0), 0.0, 1.0))
    if resized and coverage is None:
        colours = resize(colours, width_px, height_px)
    elif resized and coverage is not None:
        planes = np.concatenate([colours * coverage[..., None], coverage[..., None]], axis=2)
        planes = resize(planes, width_px, height_px)
        # Colours are divided before the filter's overshoot is clipped off alpha, as both overshoot alike.
        colours = _unpremultiplied(planes[..., :3], planes[..., 3])
        coverage = np.clip(planes[..., 3], 0.0, 1.0)
    elif not is_float and straight:
        # Nothing was computed, so the stored values pass through exactly.
        assert alpha is not None
        return _as_bits(rgb, bits), _as_bits(alpha, 8)
    return _as_bits(colours, bits), None if coverage is None else _as_bits(coverage, 8)


def read_mask(
    path: Path, image_size_px: tuple[int, int], width_px: int, height_px: int
) -> UInt8[np.ndarray, "h w"]:
    """Read a mask, 255 where the photograph is valid.

    Args:
        path: the mask file; its first channel counts.
        image_size_px: width and height of the photograph as stored, which the mask must share.
        width_px: working width.
        height_px: working height.

    Raises:
        DatasetError: the file is not a whole image, has another size than its photograph, or holds no
            value above 1, i.e. uses 1 for white.
    """
    source, spec = _open_image(path)
    if (spec.width, spec.height) != image_size_px:
        source.close()
        raise DatasetError(
            f"{path} is {spec.width}x{spec.height} but its photograph is "
            f"{image_size_px[0]}x{image_size_px[1]}; make the mask as large as the photograph."
        )
    mask = np.ascontiguousarray(_read_pixels(source, path, "uint8")[..., 0])
    if mask.max() == 1:
        raise DatasetError(f"{path} uses the value 1 for valid pixels; store them as white (255).")
    if (width_px, height_px) != image_size_px:
        mask = resize(mask[..., None], width_px, height_px, mode="bilinear")[..., 0]
    return mask


def resize(pixels: Pixels, width_px: int, height_px: int, mode: str = "bicubic") -> Pixels:
    """Reduce an image (height, width, channels) of uint8 or float32 with an antialiased filter.

    The filter (Keys' bicubic, or a triangle for ``bilinear``) is as wide as the reduction asks for. Torch's
    implementation takes 0.01 s to 0.3 s for 12 MP where OpenImageIO's Lanczos filter takes 2 s to 5 s.
    """
    import torch  # here, so that reading a model alone does not wait for it

    planes = torch.from_numpy(np.ascontiguousarray(pixels)).permute(2, 0, 1)[None]
    with torch.no_grad(), one_torch_thread():
        small = torch.nn.functional.interpolate(planes, (height_px, width_px), mode=mode, antialias=True)
    return np.ascontiguousarray(small[0].permute(1, 2, 0).numpy())


def _open_image(path: Path) -> tuple[Any, Any]:
    # By default OpenImageIO multiplies alpha into the colours of formats that store them straight.
    wish = oiio.ImageSpec()
    wish.attribute("oiio:UnassociatedAlpha", 1)
    source = oiio.ImageInput.open(str(path), wish)
    if source is None:
        reason = _single_line_message(oiio.geterror(), path)
        raise DatasetError(f"{path} cannot be read as an image{reason}; replace the file.")
    return source, source.spec()


def _read_pixels(source: Any, path: Path, kind: str) -> Pixels:
    pixels = source.read_image(kind)
    message = source.geterror()
    source.close()
    # A JPEG that ends early is filled up with gray and only this message tells.
    if pixels is None or "premature end" in message.lower():
        raise DatasetError(
            f"{path} is damaged or cut short{_single_line_message(message, path)}; replace the file."
        )
    return np.asarray(pixels).reshape(pixels.shape[0], pixels.shape[1], -1)


def _single_line_message(message: str, path: Path) -> str:
    line = " ".join(message.replace(f'("{path}")', "").replace(f'"{path}"', "it").split())
    return f" ({line.rstrip('.')})" if line else ""


def _colour_channels(pixels: Pixels, spec: Any) -> Pixels:
    names = [name.rsplit(".", 1)[-1].upper() for name in spec.channelnames]
    if all(letter in names for letter in "RGB"):
        picked = [names.index(letter) for letter in "RGB"]
    else:
        others = [i for i in range(len(names)) if i != spec.alpha_channel]
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
        return values.astype(np.uint16) * np.uint16(257)
    full = np.float32(np.iinfo(target).max)
    return (np.clip(_as_float(values), 0.0, 1.0) * full + np.float32(0.5)).astype(target)


def _unpremultiplied(
    colours: Float32[np.ndarray, "h w 3"], alpha: Float32[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w 3"]:
    divisor = np.where(alpha > 0, alpha, np.float32(1.0))
    return np.where(alpha[..., None] > 0, colours / divisor[..., None], np.float32(0.0)).astype(np.float32)

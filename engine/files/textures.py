"""Textures as PNG in memory: the one that carries the Gaussian fall-off, and those of surfaces."""

import struct
import tempfile
import zlib
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from octasplat.engine.core.color import to_bytes

RAMP_SIZE_PX = 256


def radial_alpha(size: int, q: float) -> Float64[np.ndarray, "s s"]:
    """Return exp(-rho^2 / 2) at texel centres of a square over [-sqrt(Q), sqrt(Q)] standard deviations."""
    squares = (2.0 * (np.arange(size) + 0.5) / size - 1.0) ** 2
    result: np.ndarray = np.exp(-0.5 * q * (squares[:, None] + squares))
    return result


def white_with_alpha_png(size: int, q: float) -> bytes:
    """Return the fall-off as alpha of a white RGBA image, as glTF wants it."""
    pixels = np.full((size, size, 4), 255, dtype=np.uint8)
    pixels[..., 3] = to_bytes(radial_alpha(size, q))
    return _encode_png(pixels, color_type=6)


def grey_png(size: int, q: float) -> bytes:
    """Return the fall-off as a grey image, as MTL's ``map_d`` wants it (it takes the luminance)."""
    return _encode_png(to_bytes(radial_alpha(size, q))[..., None], color_type=0)


def material_ramp_png() -> bytes:
    """Return a PNG with metallic in blue along u, roughness in green along v, one pixel a step; red is 1."""
    steps = np.arange(RAMP_SIZE_PX, dtype=np.uint8)
    pixels = np.full((RAMP_SIZE_PX, RAMP_SIZE_PX, 3), 255, np.uint8)
    pixels[..., 1], pixels[..., 2] = steps[:, None], steps
    return _encode_png(pixels, color_type=2)


def material_ramp_uv(
    metallic: Float32[np.ndarray, "n 1"], roughness: Float32[np.ndarray, "n 1"]
) -> Float32[np.ndarray, "n 2"]:
    """Return the texture coordinates at which the ramp has these values, interpolated between its pixels."""
    both = np.clip(np.concatenate([metallic, roughness], axis=1), 0.0, 1.0)
    # 0 and 1 are the centers of the first and the last pixel.
    return ((both * (RAMP_SIZE_PX - 1) + 0.5) / RAMP_SIZE_PX).astype(np.float32)


def png_bytes(rgb_srgb: UInt8[np.ndarray, "h w 3"]) -> bytes:
    """Return an image as it stands in a PNG file."""
    from octasplat.engine.render.image_files import (
        write_png,  # loads the image library, which the front end has not
    )

    with tempfile.TemporaryDirectory(prefix="octasplat-") as folder:
        path = Path(folder) / "texture.png"
        write_png(path, rgb_srgb.astype(np.float32) / np.float32(255))
        return path.read_bytes()


def _encode_png(pixels: UInt8[np.ndarray, "h w c"], color_type: int) -> bytes:
    """Return an 8-bit PNG in memory: the image library here writes to named files only."""
    height, width, channels = pixels.shape
    rows = np.zeros((height, 1 + width * channels), dtype=np.uint8)  # each row begins with filter 0: none
    rows[:, 1:] = pixels.reshape(height, -1)
    header = struct.pack(">IIBBBBB", width, height, 8, color_type, 0, 0, 0)
    chunks = [(b"IHDR", header), (b"IDAT", zlib.compress(rows.tobytes(), 9)), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in chunks
    )

"""Channels of image files by name, as the tests read renders back."""

from pathlib import Path

import numpy as np
import OpenImageIO as oiio
from jaxtyping import Float32

from octasplat.engine.render.image_files import read_image


def read_channels(path: Path) -> dict[str, Float32[np.ndarray, "h w"]]:
    """Return the channels of an image by name (``R``, ``A``, ``Z``, ``N.x``, ...), as stored."""
    pixels = read_image(path)
    file = oiio.ImageInput.open(str(path))
    names = tuple(file.spec().channelnames)
    file.close()
    return {name: np.ascontiguousarray(pixels[..., k]) for k, name in enumerate(names)}

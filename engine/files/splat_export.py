"""Export as .splat: 32 bytes a Gaussian, colour and opacity as bytes, no harmonics beyond the constant."""

from pathlib import Path

import numpy as np

from engine.errors import SceneFileError
from engine.files.encodings import bytes_from, unit_quats
from engine.files.options import ExportOptions
from engine.files.registry import Exporter, register
from engine.files.selection import blocks, check_scales, selected
from engine.files.splat import SPLAT
from engine.gaussians.model import FLAT_SCALE, FlatGaussians
from engine.writing import replacing


def write(gaussians: FlatGaussians, path: Path, options: ExportOptions) -> tuple[Path, ...]:
    """Write the Gaussians in their order; the flat axis is the first, with a standard deviation of 1e-5.

    Raises:
        SceneFileError: nothing to write, values that are not finite, or the file cannot be written.
    """
    gaussians = selected(gaussians, path, options)
    check_scales(gaussians, path)
    try:
        with replacing(path) as temporary, temporary.open("wb") as handle:
            for block in blocks(gaussians):
                handle.write(_rows(block).data)
    except OSError as error:
        raise SceneFileError(f"{path}: cannot be written ({error.strerror or error}).") from error
    return (path,)


def _rows(some: FlatGaussians) -> np.ndarray:
    rows = np.empty(len(some), dtype=SPLAT)
    rows["mean"] = some.means_world
    rows["scale"][:, 0] = FLAT_SCALE
    rows["scale"][:, 1:] = some.scales
    rows["rgba"][:, :3] = bytes_from(some.base_rgb_srgb.astype(np.float64) * 255.0)
    rows["rgba"][:, 3] = bytes_from(some.opacities.astype(np.float64) * 255.0)
    unit = unit_quats(some.quats_wxyz)
    # A byte reaches from -1 to 127/128, so a component near 1 is written as its negative.
    largest = np.take_along_axis(unit, np.argmax(np.abs(unit), axis=1)[:, None], axis=1)
    rows["quat_wxyz"] = bytes_from(np.where(largest > 0, -unit, unit) * 128.0 + 128.0)
    return rows


register(Exporter("splat", ("*.splat",), "32 bytes a Gaussian for web viewers (antimatter15)", write))

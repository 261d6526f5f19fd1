"""Scale of photographs whose values do not fill the range of their file format.

Files of 16 bits may hold 12, floating-point files integers, and radiance may be of any exposure. All
photographs of one storage share one scale, so that they stay comparable.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from octasplat.engine.core.errors import DatasetError
from octasplat.engine.dataset.image_info import ImageInfo, Storage
from octasplat.engine.dataset.images import ValueScale, read_stored_colors

_FULL_16_BIT = 65535.0
_INTEGER_RANGES = (255.0, 1023.0, 4095.0, 16383.0, _FULL_16_BIT)
"""Full brightness of 8, 10, 12, 14 and 16 bits."""
_MAX_BURNT_OUT = 0.5
"""Share of the positive values above 1 from which a floating-point file does not hold light up to 1."""
_MIN_BRIGHTEST = 1 / 16
"""A brightest value below this share of full brightness makes a nearly black picture."""
_WHITE_PERCENTILE = 99.0
"""What becomes full brightness where radiance has no exposure: the rest are highlights."""


@dataclass(frozen=True)
class _Values:
    brightest: float
    white: float
    burnt_out: float


def find_value_scales(
    photographs: Sequence[tuple[Path, ImageInfo]],
    map_files: Callable[[Callable[[Path], _Values], Iterable[Path]], Iterable[_Values]] = map,
) -> tuple[dict[Storage, ValueScale], tuple[str, ...]]:
    """Return the scale of each storage whose values are not as the format says, and a warning for each.

    Photographs of 8 bits are not read.

    Args:
        photographs: files and their headers.
        map_files: applies a function to files, e.g. the method of a pool of threads.

    Raises:
        DatasetError: a file cannot be read, or holds values that make no picture.
    """
    scales: dict[Storage, ValueScale] = {}
    warnings: list[str] = []
    for storage in ("16-bit", "float", "radiance"):
        paths = [path for path, info in photographs if info.storage == storage]
        if not paths:
            continue
        values = list(map_files(_read_values, paths))
        brightest = max(each.brightest for each in values)
        scale = _scale_of(storage, values, brightest, paths[0])
        if scale is not None:
            scales[storage] = scale
            kind = "display values" if scale.is_display else "linear light"
            warnings.append(
                f"{len(paths)} photographs ({paths[0].name}, ...) hold values up to {brightest:.5g}, which "
                f"is not white in their format; they are read as {kind} with {scale.full:.5g} for white."
            )
    return scales, tuple(warnings)


def _read_values(path: Path) -> _Values:
    colors = read_stored_colors(path)
    finite = colors[np.isfinite(colors)]
    positive = finite[finite > 0]
    if len(positive) == 0:
        return _Values(0.0, 0.0, 0.0)
    return _Values(
        float(positive.max()), float(np.percentile(positive, _WHITE_PERCENTILE)), float((positive > 1).mean())
    )


def _scale_of(
    storage: Storage, values: Sequence[_Values], brightest: float, example: Path
) -> ValueScale | None:
    lit = [each for each in values if each.brightest > 0]
    if not lit:
        return None
    if storage == "16-bit":
        full = next(full for full in _INTEGER_RANGES if brightest <= full)
        return None if full == _FULL_16_BIT else ValueScale(full, is_display=True)
    is_burnt_out = float(np.median([each.burnt_out for each in lit])) > _MAX_BURNT_OUT
    if not is_burnt_out and brightest >= _MIN_BRIGHTEST:
        return None
    if storage == "float" and is_burnt_out:
        if brightest > _FULL_16_BIT:
            raise DatasetError(
                f"{example} and others hold floating-point values up to {brightest:.5g}, which are neither "
                "light from 0 to 1 nor integers of 8 to 16 bits; export them as 8 or 16 bits."
            )
        return ValueScale(next(full for full in _INTEGER_RANGES if brightest <= full), is_display=True)
    return ValueScale(float(np.median([each.white for each in lit])), is_display=False)

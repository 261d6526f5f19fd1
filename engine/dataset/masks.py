"""Masks of photographs: which file belongs to which photograph, and which pixels are valid."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import UInt8

from octasplat.engine.core.errors import DatasetError
from octasplat.engine.core.scene_layout import MASK_ENDING
from octasplat.engine.dataset.images import alpha_channel_of, open_image, read_pixels, resize

_VALID = 128
"""The least value of a valid pixel."""
_WHITE = 250
"""A mask that reaches this value has white in it, whatever else it has."""
_MAX_LABELS = 32
"""A picture of fewer values than this, none of them white, holds labels rather than shades."""
_COLORED = 16
"""Channels that differ by more than this are no rounding of a grey one."""


@dataclass(frozen=True)
class MaskSummary:
    """Value statistics of a mask, from which unusable masks are recognised.

    Attributes:
        path: the file.
        brightest: its largest value, 255 for white.
        values: all its values where they are few, else None.
    """

    path: Path
    brightest: int
    values: tuple[int, ...] | None

    @property
    def is_all_invalid(self) -> bool:
        """Return whether no pixel is valid."""
        return self.brightest < _VALID


def mask_for(name: str, masks: Mapping[str, Path], beside: Mapping[str, Path]) -> Path | None:
    """Return the mask of a photograph; None if it has none.

    Args:
        name: of the photograph.
        masks: files of the folder of masks, by their paths below it and by these casefolded.
        beside: masks that lie beside the photographs, by the names of these.
    """
    stem = str(PurePosixPath(name).with_suffix(""))
    for candidate in (f"{name}.png", f"{stem}.png", f"{stem}{MASK_ENDING}.png", name, f"{name}.jpg"):
        found = masks.get(candidate) or masks.get(candidate.casefold())
        if found is not None:
            return found
    return beside.get(name)


def read_mask(
    path: Path, image_size_px: tuple[int, int], width_px: int, height_px: int
) -> tuple[UInt8[np.ndarray, "h w"], MaskSummary]:
    """Read a mask, 255 where the photograph is valid, and its summary.

    Args:
        path: the mask file; its first channel counts.
        image_size_px: width and height of the photograph as stored, which the mask must share.
        width_px: working width.
        height_px: working height.

    Raises:
        DatasetError: the file is not a whole image, has another size than its photograph, holds no value
            above 1, i.e. uses 1 for white, or says what is valid by colors or by its alpha channel.
    """
    mask = _read_first_channel(path, image_size_px)
    summary = _summarise_mask(path, mask)
    if (width_px, height_px) != image_size_px:
        mask = resize(mask[..., None], width_px, height_px, mode="bilinear")[..., 0]
    return mask, summary


def check_masks(masks: Sequence[MaskSummary], photograph_count: int) -> tuple[str, ...]:
    """Return warnings for masks that leave no valid pixel.

    Args:
        masks: of a scene.
        photograph_count: how many photographs the scene has.

    Raises:
        DatasetError: no mask has a white pixel, so that they are labels or nothing would be left.
    """
    if not masks:
        return ()
    brightest = max(mask.brightest for mask in masks)
    labelled = [mask for mask in masks if mask.values is not None and len(mask.values) > 2]
    if 1 < brightest < _VALID or (brightest < _WHITE and labelled):
        one = labelled[0] if labelled else max(masks, key=lambda mask: mask.brightest)
        values = ", ".join(map(str, one.values)) if one.values is not None else f"0 to {one.brightest}"
        raise DatasetError(
            f"{one.path} and the other masks hold the values {values[:60]} and no white: these are labels, "
            "or the mask is too dark; store valid pixels as white (255) and the others as black."
        )
    black = [mask.path for mask in masks if mask.is_all_invalid]
    if len(black) == photograph_count:
        raise DatasetError(
            f"All {len(black)} masks are black, e.g. {black[0]}: nothing of the photographs would be left; "
            "white (255) is what counts, so invert them or take them away."
        )
    return (f"{len(black)} masks hold no valid (white) pixel, e.g. {black[0].name}.",) if black else ()


def _summarise_mask(path: Path, mask: UInt8[np.ndarray, "h w"]) -> MaskSummary:
    present = np.flatnonzero(np.bincount(mask.ravel(), minlength=256))
    values = tuple(present.tolist()) if len(present) <= _MAX_LABELS else None
    return MaskSummary(path, int(present[-1]), values)


def _read_first_channel(path: Path, image_size_px: tuple[int, int]) -> UInt8[np.ndarray, "h w"]:
    source, spec = open_image(path)
    if (spec.width, spec.height) != image_size_px:
        source.close()
        raise DatasetError(
            f"{path} is {spec.width}x{spec.height} but its photograph is "
            f"{image_size_px[0]}x{image_size_px[1]}; make the mask as large as the photograph."
        )
    alpha_channel = alpha_channel_of(spec, path)
    pixels = read_pixels(source, path, "uint8")
    mask = np.ascontiguousarray(pixels[..., 0])
    if mask.max() == 1:
        raise DatasetError(f"{path} uses the value 1 for valid pixels; store them as white (255).")
    if alpha_channel is not None and alpha_channel > 0:
        alpha = pixels[..., alpha_channel]
        if alpha.min() < 255 and ((alpha >= _VALID) != (mask >= _VALID)).any():
            raise DatasetError(
                f"{path} has its mask in the alpha channel; save that channel as a black and white image."
            )
    colors = pixels[..., [i for i in range(min(pixels.shape[2], 4)) if i != alpha_channel]]
    if np.ptp(colors, axis=2).max() > _COLORED:
        shades = np.unique(colors.reshape(-1, colors.shape[2]), axis=0)
        if mask.max() < _VALID or 2 < len(shades) <= _MAX_LABELS:
            raise DatasetError(
                f"{path} is colored, as labels are; store valid pixels as white (255) and the others as "
                "black."
            )
    return mask

"""Dialects of Gaussian PLY files: the additions of 3DGS programs, and how each is recognised."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from octasplat.engine.core.errors import SceneFileError

_MAX_NAMES = 8
UNUSED_SCALE_MESSAGE = (
    "Its third scales were never trained, as those of gsplat's 2DGS; it was read so, with the third axis as "
    "the normal."
)
_MIN_TRAINED_FRACTION = 0.95
"""Trained scales are almost all different; numbers of few bits are not."""
_MAX_UNTRAINED_FRACTION = 0.7
"""Scales that nothing trains are copied from Gaussian to Gaussian as these are split and cloned."""
_MIN_JUDGED = 500


def has_unused_third_scale(log_scales: Float32[np.ndarray, "n 3"]) -> bool:
    """Return whether two scales were trained and the third one, which no constant is, was only copied.

    gsplat's 2DGS keeps three scales of which it renders two, and its files are otherwise those of 3DGS.
    """
    count = len(log_scales)
    if count < _MIN_JUDGED:
        return False
    first, second, third = (len(np.unique(log_scales[:, axis])) / count for axis in range(3))
    is_copied = 2 / count < third < _MAX_UNTRAINED_FRACTION
    return bool(min(first, second) > _MIN_TRAINED_FRACTION and is_copied)


def ignored_properties_message(names: Sequence[str]) -> str:
    """Return what to tell of properties that say nothing known here, most of them by their beginnings."""
    groups = list(dict.fromkeys(re.sub(r"_?\d+$", "", name) or name for name in names))
    more = len(groups) - _MAX_NAMES
    listed = ", ".join(groups[:_MAX_NAMES]) + (f" and {more} more" if more > 0 else "")
    return (
        f"Its properties {listed} mean nothing here and were left out; if its program shows Gaussians by "
        "them, they will look different (octasplat import --channels all keeps them as channels)."
    )


def refuse_anchors(path: Path, names: set[str]) -> None:
    """Refuse the files of Scaffold-GS and its successors, which hold no Gaussians.

    Raises:
        SceneFileError: the file is one.
    """
    if any(name.startswith(("f_anchor_feat", "f_offset")) for name in names):
        raise SceneFileError(
            f"{path}: holds anchors of Scaffold-GS, from which its networks make Gaussians for each view; "
            "export the Gaussians of one view with its program, or train with another one."
        )

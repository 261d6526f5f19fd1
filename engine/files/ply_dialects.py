"""Dialects of Gaussian PLY files: the additions of 3DGS programs, and how each is recognised."""

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.core.ply_container import columns
from octasplat.engine.gaussians.flattening import GaussianCloud, row_slices

MIP_FILTER = "filter_3D"
"""Standard deviation (world units) of the smoothing that Mip-Splatting and Gaussian Opacity Fields apply to
each Gaussian before they show it."""
_MAX_NAMES = 8
FLAT_DIALECT_MESSAGE = (
    "Its Gaussians have two scales; they were read as 2DGS writes them, with the third axis as the normal. "
    "If GaMeS or REdiSplats wrote the file, import it with --format games."
)
UNUSED_SCALE_MESSAGE = (
    "Its third scales were never trained, as those of gsplat's 2DGS; it was read so, with the third axis as "
    "the normal."
)
_MIN_TRAINED_FRACTION = 0.95
"""Trained scales are almost all different; numbers of few bits are not."""
_MAX_UNTRAINED_FRACTION = 0.7
"""Scales that nothing trains are copied from Gaussian to Gaussian as these are split and cloned."""
_MIN_JUDGED = 500


def has_unused_third_scale(table: np.ndarray, names: Sequence[str]) -> bool:
    """Return whether two scales were trained and the third one, which no constant is, was only copied.

    gsplat's 2DGS keeps three scales of which it renders two, and its files are otherwise those of 3DGS.

    Args:
        table: of all Gaussians.
        names: of its columns with the three scales.
    """
    count = len(table)
    if count < _MIN_JUDGED or not all(_may_be_trained(table, name) for name in names[:2]):
        return False
    first, second, third = (_distinct_count(table, name) / count for name in names)
    is_copied = 2 / count < third < _MAX_UNTRAINED_FRACTION
    return bool(min(first, second) > _MIN_TRAINED_FRACTION and is_copied)


def _may_be_trained(table: np.ndarray, name: str) -> bool:
    """Return False where blocks of a column alone have too many numbers twice, as where it is constant."""
    most = (1.0 - _MIN_TRAINED_FRACTION) * len(table)
    repeated = 0
    for rows in row_slices(len(table)):
        values = columns(table[rows], [name])
        repeated += len(values) - len(np.unique(values))
        if repeated >= most:
            return False
    return True


def _distinct_count(table: np.ndarray, name: str) -> int:
    """Return how many different numbers a column has, those that are not numbers once."""
    values = columns(table, [name])[:, 0]
    values.sort()
    # a block at a time, with the number before it
    pairs = [values[max(rows.start - 1, 0) : rows.stop] for rows in row_slices(len(values))]
    changes = sum(int(((part[1:] != part[:-1]) & ~np.isnan(part[:-1])).sum()) for part in pairs)
    return 1 + changes


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


def with_mip_filter(cloud: GaussianCloud, deviations: Float32[np.ndarray, " n"]) -> GaussianCloud:
    """Return the Gaussians as they are shown by programs that smooth each one.

    Each is convolved with a Gaussian of the given standard deviation, and its opacity is lowered so that
    the integral stays the same (Mip-Splatting, Eq. 9).
    """
    scales = cloud.log_scales.astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        # ln sqrt(s^2 + f^2) for the deviations s of the Gaussian and f of the filter
        wider = 0.5 * np.logaddexp(2.0 * scales, 2.0 * np.log(np.abs(deviations.astype(np.float64)))[:, None])
        # ln of the ratio of the volumes, without axes that are infinitely thin
        lost = np.where(np.isfinite(scales), scales - wider, 0.0).sum(axis=1)
        # ln(ratio) + ln(sigmoid)
        log_opacity = lost - np.logaddexp(0.0, -cloud.opacity_logits.astype(np.float64))
        logits = log_opacity - np.log(-np.expm1(log_opacity))  # ln a - ln(1 - a)
    return replace(
        cloud,
        log_scales=wider.astype(np.float32),
        # Where the filter changes nothing, logits keep every bit.
        opacity_logits=np.where(lost == 0.0, cloud.opacity_logits, logits).astype(np.float32),
        notes=(*cloud.notes, f"Its smoothing filter ({MIP_FILTER}) was folded into scales and opacities."),
    )

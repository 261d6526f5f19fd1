"""What would help a finished run, by its measurements: sentences for the report."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64
from scipy.ndimage import gaussian_filter, laplace

from octasplat.engine.core.name_lists import name_list
from octasplat.engine.evaluate.view_metrics import ViewMetrics
from octasplat.engine.evaluate.view_support import (
    FEW_VIEWS,
    GROUP_NAMES,
    Support,
    gain_if_covered,
    group_errors,
)

MIN_COVERAGE_GAIN_DB = 0.5
"""What more photographs of badly covered places would have to gain to be asked for."""
MOSTLY_UNCOVERED = 0.8
"""Share of badly covered pixels above which the rest is too little to compare with."""
MIN_EXPOSURE_GAIN_DB = 1.0
"""Gain of a single view by a correction of its colors, beyond that of most, from which on it is named."""
MIN_EXPOSURE_VIEWS = 3
MAX_FALSE_POSE_STRUCTURE = 0.4
"""Share of the structure that most photographs have in common with their renders, below which one shows
something else. In a street, bonsai and gerrard_hall it is 0.59 and more where poses are right, 0.50 in other
colors (half or twice as bright, gamma 2, tinted), and 0.37 and less in the place of another view."""
STRUCTURE_SIDE_PX = 256
"""Size to which pictures are shrunk for it: blur and noise are smaller."""
_STRUCTURE_SIGMA_PX = 4.0
"""Exposure and shade are larger."""
MAX_SHARPNESS = 0.5
"""A photograph is blurred that has less than this share of the fine detail of its render, and of others."""
WELL_FITTED_DB = 1.0
"""Training views that are shown no better than this beyond held-out ones are not fitted to their end."""
OVERFITTED_DB = 3.0
"""From this difference on a longer training gains little on new views."""
GOOD_PSNR = 33.0
"""Training views from which on more fit is not asked for."""
_FEW_NAMES = GROUP_NAMES[:FEW_VIEWS]


@dataclass(frozen=True)
class ViewFacts:
    """What advice goes by beside the metrics of a held-out view.

    Attributes:
        photograph_detail: of the photograph, see :func:`fine_detail`.
        render_detail: of its render.
        support: training views that see its places; None where that was not asked.
        structure: that both have in common, see :func:`common_structure`.
    """

    photograph_detail: float
    render_detail: float
    support: Support | None = None
    structure: float = math.nan


def fine_detail(picture: Float32[np.ndarray, "h w 3"], weight: Float32[np.ndarray, "h w"]) -> float:
    """Return the mean power of the Laplacian of a picture's gray values, over the pixels that count."""
    valid = weight > 0
    return float((laplace(picture.mean(axis=2))[valid] ** 2).mean()) if valid.any() else 0.0


def common_structure(
    render: Float32[np.ndarray, "h w 3"],
    photograph: Float32[np.ndarray, "h w 3"],
    weight: Float32[np.ndarray, "h w"],
) -> float:
    """Return the correlation between what two pictures show, whatever gain and offset their values have.

    That is 1 for the same structure and about 0 for other places; NaN where one has none. Compared is what a
    Gaussian blur takes away from gray values, at a small size.
    """
    step = max(1, round(max(weight.shape) / STRUCTURE_SIDE_PX))
    valid = weight > 0
    if not valid.any():
        return math.nan
    grays = [picture.mean(axis=2, dtype=np.float64) for picture in (render, photograph)]
    # no structure where nothing counts
    small = [_shrink(np.where(valid, gray, gray[valid].mean()), step) for gray in grays]
    counts = _shrink(valid.astype(np.float64), step) == 1
    x, y = ((gray - gaussian_filter(gray, _STRUCTURE_SIGMA_PX))[counts] for gray in small)
    if len(x) == 0 or x.std() == 0 or y.std() == 0:
        return math.nan
    return float(np.corrcoef(x, y)[0, 1])


def _shrink(picture: Float64[np.ndarray, "h w"], step: int) -> Float64[np.ndarray, "m n"]:
    """Return the means of squares of ``step`` pixels a side; a rest at the ends is left out."""
    height, width = (side // step for side in picture.shape)
    whole = picture[: height * step, : width * step]
    return np.asarray(whole.reshape(height, step, width, step).mean(axis=(1, 3)))


def advise(
    views: Sequence[ViewMetrics],
    facts: Mapping[str, ViewFacts],
    *,
    training_psnr: float | None,
    learns_exposure: bool,
    are_held_out: bool = True,
) -> tuple[str, ...]:
    """Return what would help most, in sentences; none where nothing stands out.

    Args:
        views: metrics of the measured views.
        facts: of the same views by name.
        training_psnr: mean PSNR of the training views in dB, where it is known.
        learns_exposure: whether the exposures of the photographs were learnt.
        are_held_out: whether the training has seen none of the views. Where it may have, they say nothing
            of how well the scene generalizes.
    """
    photographs = "held-out photographs" if are_held_out else "photographs"
    sentences = []
    coverage = _about_coverage(facts)
    if coverage is not None:
        sentences.append(coverage)
    changed = _of_other_colors(views)
    misplaced = _of_other_things([view.name for view in changed], facts)
    if misplaced:
        sentences.append(
            f"{len(misplaced)} {photographs} show other things than the scene does from where they stand, "
            f"not only other colors ({name_list(misplaced)}): their poses are more likely wrong, or no other "
            "photograph shows these places. Look at their renders, and leave out those in a wrong place."
        )
    changed = [view for view in changed if view.name not in misplaced]
    if changed:
        names = name_list([view.name for view in changed])
        ways = "Lock exposure and white balance of the camera" + (
            "." if learns_exposure else ", or let the training learn them (--set exposure=true)."
        )
        sentences.append(f"{len(changed)} {photographs} have other colors than the rest ({names}). {ways}")
    usual = float(np.median([known.photograph_detail for known in facts.values()])) if facts else 0.0
    blurred = [
        name
        for name, known in facts.items()
        if known.photograph_detail < MAX_SHARPNESS * min(known.render_detail, usual)
    ]
    if blurred:
        sentences.append(
            f"{len(blurred)} {photographs} are less sharp than their renders ({name_list(blurred)}). "
            "Leave blurred photographs out."
        )
    finite = [view.psnr for view in views if np.isfinite(view.psnr)]
    if training_psnr is not None and finite and are_held_out:
        sentences += _about_fit(training_psnr, float(np.mean(finite)), is_covered=coverage is None)
    return tuple(sentences)


def _of_other_colors(views: Sequence[ViewMetrics]) -> list[ViewMetrics]:
    """Return the views that a correction of colors makes better than it does the others."""
    gains_db = np.array([view.psnr_colour_corrected - view.psnr for view in views])
    finite = gains_db[np.isfinite(gains_db)]
    if len(finite) < MIN_EXPOSURE_VIEWS:
        return []
    least_db = max(0.0, float(np.median(finite))) + MIN_EXPOSURE_GAIN_DB
    return [view for view, gain_db in zip(views, gains_db, strict=True) if gain_db >= least_db]


def _of_other_things(names: Sequence[str], facts: Mapping[str, ViewFacts]) -> list[str]:
    """Return those of some views whose photographs and renders have far less in common than most have."""
    known = [each.structure for each in facts.values() if not math.isnan(each.structure)]
    if not known:
        return []
    least = MAX_FALSE_POSE_STRUCTURE * float(np.median(known))
    return [name for name in names if name in facts and facts[name].structure < least]


def support_groups(facts: Mapping[str, ViewFacts]) -> dict[str, dict[str, float]]:
    """Return the groups of :func:`octasplat.engine.evaluate.view_support.group_errors`; empty if unknown."""
    parts = [known.support for known in facts.values() if known.support is not None]
    return group_errors(parts) if parts else {}


def _about_coverage(facts: Mapping[str, ViewFacts]) -> str | None:
    groups = support_groups(facts)
    pixels, error = (
        sum(groups[name][key] for name in _FEW_NAMES if name in groups) for key in ("pixels", "error")
    )
    # Where next to nothing is covered, nothing shows how good that would be.
    gain_db = gain_if_covered(groups) if pixels <= MOSTLY_UNCOVERED else None
    if pixels <= MOSTLY_UNCOVERED and (gain_db is None or gain_db < MIN_COVERAGE_GAIN_DB):
        return None
    gain = "" if gain_db is None else f" Covered as the others are, PSNR would be {gain_db:.1f} dB higher."
    known = {name: each.support for name, each in facts.items() if each.support is not None}
    worst = sorted(known, key=lambda name: -known[name].few_fraction)
    return (
        f"More photographs would help: {100 * pixels:.0f} % of the held-out pixels show places that at most "
        f"two training photographs see from within 15 degrees, and {100 * error:.0f} % of the error lies "
        f"there.{gain} Take more around these views: {name_list(worst)}"
    )


def _about_fit(training_psnr: float, held_out_psnr: float, *, is_covered: bool) -> list[str]:
    difference_db = training_psnr - held_out_psnr
    if difference_db < WELL_FITTED_DB and training_psnr < GOOD_PSNR:
        return [
            f"Training views are shown hardly better than held-out ones ({difference_db:+.1f} dB): a longer "
            "training or more Gaussians would help (--preset standard or high, --max-gaussians)."
        ]
    if difference_db > OVERFITTED_DB and is_covered:
        return [
            f"Training views are shown {difference_db:.1f} dB better than held-out ones: more photographs "
            "help, a longer training hardly."
        ]
    return []

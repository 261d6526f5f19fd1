"""Losses of formats with few bits: sizes, positions and colors that are out of range.

Each format says in a function of its own what it loses; this module counts and words it, one sentence a loss.
"""

import math
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from octasplat.engine.files.splat_rows import iterate_blocks
from octasplat.engine.gaussians.flattening import row_slices
from octasplat.engine.gaussians.model import FLAT_SCALE, FlatGaussians

MIN_REPORTED_FRACTION = 1e-3
"""Losses of fewer Gaussians than this fraction are not told; those that are too large always are."""
MAX_THICKNESS, WANTED_THICKNESS = 0.25, 0.01
"""Of the larger standard deviation: from which on a thickness shows, and what hides it."""
MIN_SMALL_FRACTION = 0.1
"""Where fewer Gaussians are as small as that, the scene is not."""


def find_size_losses(
    format_name: str, scene: FlatGaussians, min_log_scale: float, max_log_scale: float
) -> tuple[str, ...]:
    """Return what becomes of Gaussians whose standard deviations a format clips.

    Args:
        format_name: of the format.
        scene: what is written.
        min_log_scale: ln of the least deviation that it holds.
        max_log_scale: ln of the largest.
    """
    large = small = 0
    for block in iterate_blocks(scene):
        log_scales = block.log_scales.astype(np.float64)
        large += int((log_scales > max_log_scale).any(axis=1).sum())
        small += int((log_scales < min_log_scale).any(axis=1).sum())
    if not large and small < MIN_REPORTED_FRACTION * len(scene):
        return ()
    low, high = float(scene.log_scales.min()), float(scene.log_scales.max())
    advice = ""
    if high - low < max_log_scale - min_log_scale:
        # A power of ten where one fits, so that units stay easy to tell.
        least, most = (min_log_scale - low) / math.log(10), (max_log_scale - high) / math.log(10)
        power = math.floor(most) if large else math.ceil(least)
        exponent = float(power) if least <= power <= most else (least + most) / 2
        advice = f"; octasplat transform --scale {10.0**exponent:.3g} makes all of them fit"
    return (
        f"The format {format_name} holds sizes from {math.exp(min_log_scale):.2g} to "
        f"{math.exp(max_log_scale):.3g} units; {large + small:,} of {len(scene):,} Gaussians do not fit and "
        f"will be clipped{advice}.",
    )


def find_thickness_losses(format_name: str, scene: FlatGaussians) -> tuple[str, ...]:
    """Return what becomes of a scene in units so large that the thickness of flat Gaussians shows.

    Other programs show them as thick as the file has them.

    Args:
        format_name: of the format.
        scene: what is written.
    """
    if len(scene) == 0:
        return ()
    sizes = np.concatenate([block.log_scales.max(axis=1) for block in iterate_blocks(scene)])
    small = int((sizes < math.log(FLAT_SCALE / MAX_THICKNESS)).sum())
    if small < MIN_SMALL_FRACTION * len(scene):
        return ()
    needed = math.log(FLAT_SCALE / WANTED_THICKNESS) - float(np.median(sizes))
    power = max(math.ceil(needed / math.log(10)), 1)
    return (
        f"The format {format_name} has Gaussians {FLAT_SCALE:g} units thick, which is much for the size of "
        f"{small:,} of {len(scene):,} here: programs that show Gaussians with a thickness blur them; "
        f"octasplat transform --scale {10.0**power:.3g} makes it little.",
    )


def find_position_losses(
    format_name: str,
    scene: FlatGaussians,
    steps_world: Callable[[slice], Float[np.ndarray, " n"] | float],
) -> tuple[str, ...]:
    """Return what becomes of Gaussians that are smaller than the steps in which a format holds positions.

    Args:
        format_name: of the format.
        scene: what is written.
        steps_world: returns the step of each position of some rows, or one step for all, world units.
    """
    coarse = 0
    for rows in row_slices(len(scene)):
        sizes = np.exp(scene.log_scales[rows].astype(np.float64)).max(axis=1)
        coarse += int((steps_world(rows) > sizes).sum())
    if coarse < max(1.0, MIN_REPORTED_FRACTION * len(scene)):
        return ()
    step_world = np.concatenate([np.atleast_1d(steps_world(rows)) for rows in row_slices(len(scene))])
    return (
        f"The format {format_name} holds positions in steps of {float(np.median(step_world)):.2g} "
        f"units here, which is more than the size of {coarse:,} of {len(scene):,} Gaussians; "
        "crop what lies far away (octasplat crop), or move the scene to the origin "
        "(octasplat transform --translate).",
    )


def find_harmonic_losses(format_name: str, scene: FlatGaussians, limit: float) -> tuple[str, ...]:
    """Return what becomes of view-dependent colors beyond the coefficients that a format holds.

    Args:
        format_name: of the format.
        scene: what is written.
        limit: the largest absolute value of a coefficient of degree 1 and above.
    """
    clipped = 0
    for block in iterate_blocks(scene):
        clipped += int((np.abs(block.sh[:, 1:]) > limit).any(axis=(1, 2)).sum())
    if clipped < max(1.0, MIN_REPORTED_FRACTION * len(scene)):
        return ()
    return (
        f"The format {format_name} holds coefficients of view-dependent colors up to {limit:g}; those of "
        f"{clipped:,} of {len(scene):,} Gaussians are larger and will be clipped.",
    )

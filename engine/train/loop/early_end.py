"""When a training is over before its time: the probe of training rays hardly gains any more."""

from collections.abc import Sequence

EARLY_STOPPING_FROM = 0.4
"""Share of the planned iterations before which a training never ends early: much is still being added."""
EARLY_STOPPING_WINDOW = 0.2
"""Share of them over which the gain counts."""
EARLY_STOPPING_TAIL = 0.2
"""Share of them that the training still takes: rates fall to their ends, and the last states are averaged."""


def has_converged(probes: Sequence[tuple[int, float]], planned: int, min_gain_db: float) -> bool:
    """Whether the best of the last probes is less than ``min_gain_db`` above the best of those before.

    Args:
        probes: iterations and PSNR in dB, in order of the iterations; the last one is now.
        planned: iterations of the whole training.
        min_gain_db: 0 lets nothing end early.
    """
    if min_gain_db <= 0 or not probes or probes[-1][0] < EARLY_STOPPING_FROM * planned:
        return False
    since = probes[-1][0] - EARLY_STOPPING_WINDOW * planned
    before = [psnr for iteration, psnr in probes if iteration <= since]
    lately = [psnr for iteration, psnr in probes if iteration > since]
    return bool(before) and max(lately) - max(before) < min_gain_db


def early_stop_iteration(decided: int, planned: int) -> int:
    """Where a training ends for which it was decided after ``decided`` iterations; at most ``planned``."""
    return min(planned, decided + max(1, round(EARLY_STOPPING_TAIL * planned)))

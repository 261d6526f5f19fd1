"""When a training is over before its time: the probe of training rays hardly gains any more."""

from collections.abc import Sequence

LOOKS_FROM = 0.4
"""Share of the planned iterations before which a training never ends early: much is still being added."""
LOOKS_BACK = 0.2
"""Share of them over which the gain counts."""
LAST_PHASE = 0.2
"""Share of them that the training still takes: rates fall to their ends, and the last states are averaged."""


def gains_no_more(probed: Sequence[tuple[int, float]], planned: int, least_db: float) -> bool:
    """Whether the best of the last probes is less than ``least_db`` above the best of those before.

    Args:
        probed: iterations and PSNR in dB, in order of the iterations; the last one is now.
        planned: iterations of the whole training.
        least_db: 0 lets nothing end early.
    """
    if least_db <= 0 or not probed or probed[-1][0] < LOOKS_FROM * planned:
        return False
    since = probed[-1][0] - LOOKS_BACK * planned
    before = [psnr for iteration, psnr in probed if iteration <= since]
    lately = [psnr for iteration, psnr in probed if iteration > since]
    return bool(before) and max(lately) - max(before) < least_db


def last_iteration(decided: int, planned: int) -> int:
    """Where a training ends for which it was decided after ``decided`` iterations; at most ``planned``."""
    return min(planned, decided + max(1, round(LAST_PHASE * planned)))

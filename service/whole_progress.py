"""How far a job is as a whole, and how long it still takes, from the stage that it is in."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from octasplat.workers.db.rows import Job

MAX_PACE = 2.0
"""So much slower or faster than estimated stages to come may be; estimates are right within that factor."""
_UNEVEN_STAGES = ("matches",)
"""Stages of which most steps take no time, as those of pairs that are not alike: their share says nothing."""
_BEFORE_TRAINING = ("check", "read", "features", "matches", "placing", "lenses")
"""Stages of poses and lenses in doubt, which nobody expects: all that precedes the training is done then."""

OPTIONAL_STAGE = "residual"
"""Follows the training where its settings say so, which blocks or trials may overrule."""


@dataclass(frozen=True)
class WholeProgress:
    """Progress of a job.

    Attributes:
        share: what is done of all stages, 0 to 1; None where nobody knows.
        seconds_left: of all stages; None where nobody knows.
    """

    share: float | None = None
    seconds_left: float | None = None


def whole_progress(job: Job, stages: Sequence[str]) -> WholeProgress:
    """Return how far a job is, with the estimated time of each stage as its weight.

    Without such an estimate all stages count alike, and the time left is known in the last one only. Stages
    to come are taken to be as much slower or faster than estimated as the present one, within ``MAX_PACE``.

    Args:
        job: the job.
        stages: the names of its stages, in order.
    """
    if job.state == "succeeded":
        return WholeProgress(1.0, 0.0)
    if job.is_over or not stages:
        return WholeProgress()
    estimated = _stage_seconds(job.estimate, stages)
    weights = estimated or dict.fromkeys(stages, 1.0)
    if job.stage == OPTIONAL_STAGE and job.stage not in stages and "train" in stages:
        trained = stages.index("train") + 1
        return WholeProgress(
            round(sum(weights[name] for name in stages[:trained]) / sum(weights.values()), 4)
        )
    if job.stage is None or job.stage not in stages:
        before = stages.index("train") if job.stage in _BEFORE_TRAINING and "train" in stages else 0
        return WholeProgress(round(sum(weights[name] for name in stages[:before]) / sum(weights.values()), 4))
    place = stages.index(job.stage)
    share = min(1.0, (job.step or 0) / job.total_steps) if job.total_steps else 0.0
    done = sum(weights[name] for name in stages[:place]) + share * weights[job.stage]
    later = sum(weights[name] for name in stages[place + 1 :])
    seconds = job.seconds_left
    if seconds is not None and later:
        left_here = (1 - share) * weights[job.stage]
        if not estimated or left_here <= 0:
            seconds = None
        else:
            pace = 1.0 if job.stage in _UNEVEN_STAGES else seconds / left_here
            seconds += later * min(max(pace, 1 / MAX_PACE), MAX_PACE)
    return WholeProgress(
        round(done / sum(weights.values()), 4), None if seconds is None else round(seconds, 1)
    )


def _stage_seconds(estimate: Mapping[str, Any] | None, stages: Sequence[str]) -> dict[str, float] | None:
    """Return the estimated seconds of all stages, or None where one is not known or all are 0."""
    known = (estimate or {}).get("stage_seconds") or {}
    if "train" in known:  # former estimates have both in one
        known = {OPTIONAL_STAGE: 0.0, **known}
    found = {name: float(known[name]) for name in stages if name in known}
    return found if len(found) == len(stages) and any(found.values()) else None

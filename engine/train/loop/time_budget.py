"""Iterations and Gaussians for a training that is to end within a time, from the pace of this machine.

A few iterations are trained and thrown away to see how long one takes; then the numbers are chosen and
written down, so that a run that goes on later, at whatever pace, trains what it began.
"""

import time
from collections.abc import Callable
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.core.writing import write_text
from octasplat.engine.dataset import Dataset
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.train.config import (
    MAX_PLANNED_ITERATIONS,
    TrainConfig,
    max_gaussian_count,
    residual_cost_share,
    uses_shared_sort,
)
from octasplat.engine.train.loop.trial_training import seconds_per_iteration
from octasplat.engine.train.sampling.pixel_sampler import valid_pixel_fraction

USED_FRACTION = 0.8
"""Of the time; the rest is for checkpoints, probes, and a machine that becomes slower."""
COST_POWER = 0.8
"""Power of the number of Gaussians by which an iteration takes longer, see ``docs/notes/training.md``,
"So many minutes"."""
ITERATIONS_PER_GAUSSIAN = 1 / 20
"""About as in ``standard``: 10,000 iterations for 185,000 Gaussians, 20,000 for 400,000."""
RAY_SORT_SLOWDOWN = 1.7
"""Times as long as in one order takes an iteration whose rays have an order of their own each, see there."""
MIN_ITERATIONS, MIN_GAUSSIANS = 100, 2_000


class TimeBudgetPlan(BaseModel):
    """Plan that fits a time, and the measurements it was made from.

    Attributes:
        iterations: of the training.
        max_gaussians: of the training.
        seconds_an_iteration: as measured, and reckoned for the part that takes longer.
        gaussians: so many there were then.
        seconds: that the iterations were given.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    iterations: int = Field(ge=1)
    max_gaussians: int = Field(ge=1)
    seconds_an_iteration: float = Field(gt=0)
    gaussians: int = Field(ge=1)
    seconds: float

    def apply_to(self, config: TrainConfig) -> TrainConfig:
        """Return the settings with the numbers of the plan."""
        return config.model_copy(update={"iterations": self.iterations, "max_gaussians": self.max_gaussians})


def choose_plan(
    seconds: float,
    seconds_an_iteration: float,
    gaussians: int,
    max_gaussians: int,
    *,
    min_gaussians: int = MIN_GAUSSIANS,
) -> TimeBudgetPlan:
    """Return as many Gaussians as there is time to train well, and the iterations that the time allows.

    Args:
        seconds: for the iterations.
        seconds_an_iteration: measured with ``gaussians`` Gaussians.
        gaussians: see there.
        max_gaussians: no more Gaussians than this, as the photographs hold no more down.
        min_gaussians: no fewer than this, however short the time, but for ``max_gaussians``.
    """
    # An iteration takes seconds_unit * count ** COST_POWER.
    seconds_unit = seconds_an_iteration / gaussians**COST_POWER
    gaussian_count = (  # seconds = unit count^p iterations, with iterations in proportion to count
        (seconds / (seconds_unit * ITERATIONS_PER_GAUSSIAN)) ** (1 / (1 + COST_POWER)) if seconds > 0 else 0.0
    )
    count = min(max_gaussians, max(min_gaussians, round(gaussian_count)))
    iterations = round(seconds / (seconds_unit * count**COST_POWER))
    return TimeBudgetPlan(
        iterations=min(MAX_PLANNED_ITERATIONS, max(MIN_ITERATIONS, iterations)),
        max_gaussians=count,
        seconds_an_iteration=seconds_an_iteration,
        gaussians=gaussians,
        seconds=seconds,
    )


def make_plan(
    dataset: Dataset,
    config: TrainConfig,
    first: FlatGaussians,
    *,
    seconds: float,
    threads: int,
    keeps_first: bool = False,
    should_stop: Callable[[], bool] = lambda: False,
) -> TimeBudgetPlan:
    """Measure the pace and choose.

    Args:
        dataset: the photographs.
        config: the settings but for what is chosen.
        first: Gaussians to begin from; they stay as they are.
        seconds: that the training may take from now on, this included.
        threads: of the training.
        keeps_first: the training begins with all of ``first``, not with as many as the plan has room for.
        should_stop: asked between iterations.

    Raises:
        CancelledError: stopped as asked.
    """
    began = time.perf_counter()
    pace_s = seconds_per_iteration(dataset, config, first, threads=threads, should_stop=should_stop)
    if uses_shared_sort(config):  # as the trial was, and the first part of the training is
        pace_s *= config.shared_sort_until + RAY_SORT_SLOWDOWN * (1 - config.shared_sort_until)
    pace_s *= 1 + residual_cost_share(config)  # residual colors are fitted within the time, too
    left_s = USED_FRACTION * (seconds - (time.perf_counter() - began))
    max_gaussians = max_gaussian_count(config, dataset.train_pixel_count, valid_pixel_fraction(dataset))
    least = max(MIN_GAUSSIANS, len(first)) if keeps_first else MIN_GAUSSIANS
    return choose_plan(left_s, pace_s, len(first), max_gaussians, min_gaussians=least)


def write_plan(path: Path, plan: TimeBudgetPlan) -> None:
    """Write a plan, atomically."""
    write_text(path, plan.model_dump_json(indent=1) + "\n")


def read_plan(path: Path) -> TimeBudgetPlan:
    """Read a plan.

    Raises:
        ConfigError: the file is damaged.
    """
    try:
        return TimeBudgetPlan.model_validate_json(path.read_bytes())
    except (OSError, ValidationError) as error:
        raise ConfigError(
            f"{path} cannot be read ({type(error).__name__}); train again in another folder."
        ) from None

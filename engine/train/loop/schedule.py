"""When what happens in a training, and how long it has taken: no state but the clock's."""

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

from octasplat.engine.core.compiling import compilation_seconds
from octasplat.engine.train.config import (
    OUTLIER_VIEWS_FROM,
    TrainConfig,
    rebuild_interval,
    uses_shared_sort,
)
from octasplat.engine.train.optimization.weight_averaging import AVERAGING_INTERVAL

EVENT_INTERVAL = 10
POSE_REFINEMENT_FROM, POSE_REFINEMENT_UNTIL, POSE_REFINEMENTS = 0.3, 0.8, 12
"""Shares of the iterations between which poses are refined, and about how often."""

EARLY_STOPPING_FROM = 0.4
"""Share of the planned iterations before which a training never ends early: much is still being added."""
EARLY_STOPPING_WINDOW = 0.2
"""Share of them over which the gain counts."""
EARLY_STOPPING_TAIL = 0.2
"""Share of them that the training still takes: rates fall to their ends, and the last states are averaged."""


@dataclass(frozen=True)
class Schedule:
    """Work that is due before and after each iteration; iterations are counted from 1, 0 is the start.

    A run may stop, and goes on, only where its hierarchy is built anew in any case: so a resumed run traces
    the same boxes as one that was never stopped.

    Attributes:
        iterations: of the whole training.
        rebuild_every: iterations between rebuilds of a hierarchy of up to 500,000 Gaussians.
        checkpoint_every: iterations between checkpoints, at least.
        densify_from_iter: iterations of fitting the first Gaussians.
        max_sh_degree: degree of the harmonics in the end.
        sh_degree_interval: iterations between raising it by one.
        weight_averaging_start: share of the iterations after which states are averaged.
        shared_sort_until: share of the training in which the rays of a patch share one order; 0: in none.
        refines_poses: whether poses of training views are refined.
        orients_normals: whether Gaussians are turned so that their normals point outwards.
        early_stop_at: where it was decided to end early, None where it was not.
        planned_iterations: iterations that there were to be before that.
    """

    iterations: int
    rebuild_every: int
    checkpoint_every: int
    densify_from_iter: int
    max_sh_degree: int
    sh_degree_interval: int
    weight_averaging_start: float
    shared_sort_until: float
    refines_poses: bool
    orients_normals: bool
    early_stop_at: int | None = None
    planned_iterations: int = 0

    @classmethod
    def from_config(cls, config: TrainConfig, iterations: int) -> "Schedule":
        """Return the schedule that a configuration asks for, for a training of ``iterations`` iterations."""
        return cls(
            iterations=iterations,
            rebuild_every=config.rebuild_every,
            checkpoint_every=config.checkpoint_every,
            densify_from_iter=config.densify_from_iter,
            max_sh_degree=config.sh_degree,
            sh_degree_interval=config.sh_degree_interval,
            weight_averaging_start=config.weight_averaging_start,
            shared_sort_until=config.shared_sort_until if uses_shared_sort(config) else 0.0,
            refines_poses=config.refine_poses,
            orients_normals=config.trace.flip_normal_cos > 0 and config.materials.learn,
        )

    def stop_early(self, done: int) -> "Schedule":
        """Return the schedule of a training for which it is decided after ``done`` iterations to end early.

        Nothing is added any more, and what depends on the progress goes on from where it is, only faster.
        """
        last_iteration = early_stop_iteration(done, self.iterations)
        return replace(
            self, iterations=last_iteration, early_stop_at=done, planned_iterations=self.iterations
        )

    def is_finished(self, done: int) -> bool:
        """Return whether all iterations are done."""
        return done == self.iterations

    def is_validation_due(self, done: int) -> bool:
        """Return whether the state after ``done`` iterations is measured and saved as a checkpoint."""
        every = self.rebuild_every
        every *= -(-self.checkpoint_every // every)  # rounded up to whole rebuilds, where a run may stop
        return done % every == 0 or self.is_finished(done)

    def is_outlier_check_due(self, done: int) -> bool:
        """Return whether views that do not fit are looked for after ``done`` iterations."""
        first = OUTLIER_VIEWS_FROM * self.iterations
        return self.is_validation_due(done) and first <= done < self.iterations

    def is_pose_refinement_due(self, done: int) -> bool:
        """Return whether the poses of training views are refined after ``done`` iterations."""
        if (
            not self.refines_poses
            or not POSE_REFINEMENT_FROM <= done / self.iterations <= POSE_REFINEMENT_UNTIL
        ):
            return False
        every = self.rebuild_every
        rebuilds = self.iterations * (POSE_REFINEMENT_UNTIL - POSE_REFINEMENT_FROM) / POSE_REFINEMENTS / every
        return done % (every * max(1, round(rebuilds))) == 0

    def is_averaging_due(self, done: int) -> bool:
        """Return whether the state after ``done`` iterations counts in the mean that is exported."""
        return self.is_averaging(done) and (done % AVERAGING_INTERVAL == 0 or self.is_finished(done))

    def is_averaging(self, done: int) -> bool:
        """Return whether states are averaged after ``done`` iterations."""
        return max(self.weight_averaging_start * self.iterations, self.early_stop_at or 0) < done

    def uses_shared_sort(self, done: int) -> bool:
        """Return whether the rays of a patch composite in one order in the next iteration."""
        return self.training_progress(done) < self.shared_sort_until

    def is_orientation_due(self, done: int) -> bool:
        """Return whether Gaussians whose normal points inwards are flipped: until states are averaged."""
        early = done <= self.weight_averaging_start * self.iterations
        return self.orients_normals and early and self.is_validation_due(done)

    def is_rebuild_due(self, done: int, gaussians: int) -> bool:
        """Return whether the hierarchy of so many Gaussians is rebuilt, which is where a run may stop."""
        due = done % rebuild_interval(self.rebuild_every, gaussians) == 0
        return due or self.is_validation_due(done) or self.is_pose_refinement_due(done)

    def is_event_due(self, done: int) -> bool:
        """Return whether the progress is reported."""
        return done % EVENT_INTERVAL == 0 or self.is_finished(done)

    def sh_degree(self, done: int) -> int:
        """Return the degree of the harmonics, raised step by step."""
        return min(self.max_sh_degree, done // self.sh_degree_interval)

    def may_densify(self, done: int) -> bool:
        """Return whether the first Gaussians are fitted, and the last phase of a short training not begun."""
        return done >= self.densify_from_iter and self.early_stop_at is None

    def training_progress(self, done: int) -> float:
        """Return the share of the training that is done: that of the iterations unless it ends early."""
        if self.early_stop_at is None:
            # after the decision progress runs faster, so that it still ends at 1
            return done / self.iterations
        before = self.early_stop_at / self.planned_iterations
        return before + (1 - before) * (done - self.early_stop_at) / (self.iterations - self.early_stop_at)


def has_converged(probes: Sequence[tuple[int, float]], planned: int, min_gain_db: float) -> bool:
    """Return whether the best of the last probes is less than ``min_gain_db`` above the best before.

    Args:
        probes: iterations and PSNR in dB, in order of the iterations; the last one is now.
        planned: iterations of the whole training.
        min_gain_db: 0 lets nothing end early.
    """
    if min_gain_db <= 0 or not probes or probes[-1][0] < EARLY_STOPPING_FROM * planned:
        return False
    recent_from = probes[-1][0] - EARLY_STOPPING_WINDOW * planned
    before = [psnr for iteration, psnr in probes if iteration <= recent_from]
    recent = [psnr for iteration, psnr in probes if iteration > recent_from]
    return bool(before) and max(recent) - max(before) < min_gain_db


def early_stop_iteration(decided: int, planned: int) -> int:
    """Return the last iteration of a training that was stopped early after ``decided`` iterations."""
    return min(planned, decided + max(1, round(EARLY_STOPPING_TAIL * planned)))


class Stopwatch:
    """Training time, that of earlier processes included; stands still while a state is measured and kept.

    Args:
        before_s: what earlier processes took.
    """

    def __init__(self, before_s: float) -> None:
        self._before_s = before_s
        self._kept_s = before_s
        self._since = time.perf_counter()
        self._left_out_s = compilation_seconds()

    @property
    def seconds(self) -> float:
        """Return the seconds so far."""
        return self._kept_s + time.perf_counter() - self._since

    @property
    def pace_seconds(self) -> float:
        """Return the seconds in this process without those of compiling kernels, to estimate a pace from."""
        return self.seconds - self._before_s - (compilation_seconds() - self._left_out_s)

    @contextmanager
    def paused(self) -> Iterator[float]:
        """Let the watch stand still, and give the time it shows."""
        self._kept_s, compiled_s = self.seconds, compilation_seconds()
        yield self._kept_s
        self._left_out_s += compilation_seconds() - compiled_s
        self._since = time.perf_counter()  # time in between is not counted

"""The training loop: iterations, and between them rebuilds, probes, checkpoints and densification."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32

from octasplat.engine.core.errors import Cancelled, ConfigError, TrainingFailure
from octasplat.engine.core.events import CheckpointWritten, Listener, TrainingProgress, Warned
from octasplat.engine.dataset.camera_clearance import CameraClearance
from octasplat.engine.dataset.view_frusta import ViewFrusta
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.morton import morton_order
from octasplat.engine.shading.protocol import ShadingModel
from octasplat.engine.trace.factory import make_tracer
from octasplat.engine.trace.protocol import Tracer
from octasplat.engine.train.config import TrainConfig, most_gaussians
from octasplat.engine.train.densify import make_densifier
from octasplat.engine.train.densify.normal_propagation import Propagating
from octasplat.engine.train.loop.checkpoint import save_checkpoint
from octasplat.engine.train.loop.early_end import gains_no_more
from octasplat.engine.train.loop.floors import ScaleFloor
from octasplat.engine.train.loop.iteration import Differentiated, Machinery, iterate
from octasplat.engine.train.loop.schedule import Schedule, Stopwatch
from octasplat.engine.train.loop.state import TrainState
from octasplat.engine.train.loop.validation_probe import Judge, decibels
from octasplat.engine.train.sampling.batches import BatchSource, DrawnAhead, still_background
from octasplat.engine.train.sampling.pixel_sampler import TrainingData
from octasplat.engine.train.sampling.shown import shown_share
from octasplat.engine.train.shading_factory import make_shading
from octasplat.engine.train.views.corrected_views import PosedPhotographs
from octasplat.engine.train.views.normal_orientation import turn_outwards
from octasplat.engine.train.views.outlier_views import TrainingViews, ViewJudge
from octasplat.engine.train.views.pose_refinement import PoseRefiner, RefinedPoses
from octasplat.engine.train.views.view_grids import guess_exposures

GONE_LOGIT = np.float32(-12.0)
"""Opacity of what is taken away until its place is used for something else: no ray takes note of it."""
AT_THE_END = 1.5
"""So many times as large are the zones around cameras then, as what may not stand in them gathers around."""


class Trainer:
    """Trains flat Gaussians on a dataset.

    Args:
        dataset: the photographs.
        config: all knobs.
        state: where to begin, fresh or from a checkpoint.
        folder: checkpoints go here.
        fingerprint: what the checkpoints belong to.
        listener: hears the progress.
        threads: for everything; 0 means all cores.
        should_stop: asked wherever a run may stop, see :class:`octasplat.engine.train.loop.schedule.Schedule`.
        scale_floor: what no scale falls below.
        near_zones: where no Gaussian stays, whatever the strategy does.
        seen_space: outside of which none stays.
        tracer: anything that follows the protocol; None takes the one that the configuration names.
        shading: likewise.
        onlooker: shown the iterations done and the tracer as it is then, after each; it may trace without
            recording and must change nothing.

    Attributes:
        state: where the training stands.
        schedule: when what happens; another one from where it is decided to end early.
        shading: the shading model.
        views: how well the exported Gaussians show the training views, once they are there.
        poses: those of the training views then, where they are refined.

    Raises:
        ConfigError: the settings do not suit the photographs.
    """

    def __init__(
        self,
        dataset: TrainingData,
        config: TrainConfig,
        state: TrainState,
        *,
        folder: Path,
        fingerprint: str,
        listener: Listener,
        threads: int = 0,
        should_stop: Callable[[], bool] = lambda: False,
        scale_floor: ScaleFloor | None = None,
        near_zones: CameraClearance | None = None,
        seen_space: ViewFrusta | None = None,
        tracer: Tracer | None = None,
        shading: ShadingModel | None = None,
        onlooker: Callable[[int, Tracer], None] | None = None,
    ) -> None:
        self.state = state
        self._onlooker = onlooker
        self._scale_floor = scale_floor
        self._near_zones = near_zones
        self._seen_space = seen_space
        self._config = config
        self._folder = folder
        self._fingerprint = fingerprint
        self._tell = listener
        self._should_stop = should_stop
        self._extent = dataset.extent
        self._threads = threads
        self._background_srgb = still_background(config.background)
        self._refiner = _refiner(dataset, self._background_srgb) if config.refine_poses else None
        if self._refiner is not None:
            dataset = self._refiner.dataset
            if len(state.pose_corrections):
                self._refiner.dataset.put(state.pose_corrections)
            else:
                state.pose_corrections = np.zeros((len(dataset.views), 6))
        self._dataset = dataset
        self._batches = BatchSource(dataset, config)
        pixels, shown = self._batches.sampler.pixel_count, shown_share(dataset)
        self.schedule = Schedule.of(config, pixels, shown)
        rates = config.lr.calmed(self.schedule.iterations)
        self._config = config = config.model_copy(update={"lr": rates})
        densifier = make_densifier(
            config.densify,
            iterations=self.schedule.iterations,
            max_gaussians=most_gaussians(config, pixels, shown),
        )
        if config.materials.learn and config.materials.normal_propagation:
            densifier = Propagating(densifier, config.materials.recipe, iterations=self.schedule.iterations)
        if state.hastened_after is not None:
            self.schedule = self.schedule.hastened(state.hastened_after)
        self.shading = shading or make_shading(config, len(dataset.views), dataset.extent)
        if state.densifier:
            densifier.restore(state.densifier)
        if state.shading:
            self.shading.restore(state.shading)
        self._given_tracer = tracer
        self._machinery = Machinery(tracer or self._make_tracer(), self.shading, densifier)
        self._judge = Judge(
            dataset,
            folder,
            listener,
            rays=config.probe_rays,
            background_srgb=self._background_srgb,
            step_back_db=config.best_checkpoint_margin_db,
            seed=config.seed,
        )
        self._names = [view.name for view in dataset.views]
        self._view_judge = ViewJudge(dataset, self._background_srgb)
        self.views: TrainingViews | None = None
        self.poses: RefinedPoses | None = None
        if len(state.left_out):
            self._batches.leave_out(state.left_out)

    def run(self) -> FlatGaussians:
        """Train to the end and return the Gaussians to export: the last ones, or the best if those collapsed.

        Raises:
            TrainingFailure: parameters became not-a-number, or nothing is left to see.
            Cancelled: stopped as asked; a checkpoint is on disk.
        """
        with DrawnAhead(self._batches) as batches:
            return self._run(batches)

    def _run(self, batches: DrawnAhead) -> FlatGaussians:
        state = self.state
        watch, began_at = Stopwatch(state.seconds), state.iteration
        stale = True  # whether the hierarchy is of other Gaussians
        while True:
            schedule = self.schedule
            if schedule.ends(state.iteration) and state.average.gaussians is not None:
                state.gaussians = state.average.gaussians
                state.average.clear()
            if schedule.rebuilds(state.iteration, len(state.gaussians)):
                state.raise_degree(schedule.sh_degree(state.iteration))
                if self._scale_floor is not None:
                    self._scale_floor.hold(state.gaussians)
                self._build()
                self._pause(watch, resumed=0 < state.iteration == began_at)
                schedule = self.schedule
            elif stale:
                self._build()
            if schedule.ends(state.iteration):
                return self._conclude()
            machinery = self._machinery
            batch = batches.draw(state.rng, state.iteration)
            if self._threads != 1 and not self._draws_or_stops(state.iteration + 1):
                batches.begin(state.rng, state.iteration + 1)
            progress = schedule.progress(state.iteration)
            found = iterate(state, batch, machinery, self._config, progress=progress, extent=self._extent)
            stale = schedule.may_densify(state.iteration) and self._change()
            if stale:
                state.average.clear()
            elif schedule.averages(state.iteration):
                state.average.add(state.gaussians)
            if schedule.tells(state.iteration):
                self._report(found, watch, state.iteration - began_at)
            if self._onlooker is not None and not stale:
                with watch.held():
                    self._onlooker(state.iteration, machinery.tracer)

    def _conclude(self) -> FlatGaussians:
        """The Gaussians to export, seen once more from all views."""
        state, machinery = self.state, self._machinery
        chosen = self._judge.choose(state, machinery.tracer, machinery.shading)
        near, gone = self._where_nothing_stays(chosen, AT_THE_END)
        if gone.any():
            state.taken_near += int((near & (chosen.opacity_logits > GONE_LOGIT)).sum())
            chosen = chosen.select(np.flatnonzero(~gone))
        if chosen is not state.gaussians:
            if self._refiner is not None:
                self._refiner.dataset.put(state.pose_corrections)
            machinery.tracer.build(chosen, machinery.shading.features(chosen))
        guess_exposures(self._dataset, self._background_srgb, machinery.tracer, machinery.shading)
        self.views = self._view_judge.conclude(machinery.tracer, machinery.shading, state.left_out)
        if (complaint := self.views.complaint()) is not None:
            self._tell(Warned(complaint))
        if self._refiner is not None:
            self.poses = self._refiner.conclude(
                state.pose_corrections, machinery.tracer, machinery.shading, state.left_out
            )
            self._tell(Warned(self.poses.sentence()))
        return chosen

    def _draws_or_stops(self, done: int) -> bool:
        """Whether, that far, anything but a batch draws from the generator or keeps its state."""
        schedule = self.schedule
        densifies = schedule.may_densify(done) and self._machinery.densifier.due(done)
        return densifies or schedule.ends(done) or schedule.rebuilds(done, len(self.state.gaussians))

    def _make_tracer(self) -> Tracer:
        """A tracer for the next iteration; boxes leave room for what moves between rebuilds."""
        order = "packet" if self.schedule.in_one_order(self.state.iteration) else "ray"
        settings = self._config.trace.model_copy(update={"sort": order})
        return make_tracer(settings, threads=self._threads, box_padding=self._config.box_padding)

    def _build(self) -> None:
        one_order = self._machinery.tracer.settings.sort == "packet"
        if self._given_tracer is None and one_order != self.schedule.in_one_order(self.state.iteration):
            self._machinery = replace(self._machinery, tracer=self._make_tracer())
        gaussians, machinery = self.state.gaussians, self._machinery
        machinery.tracer.build(gaussians, machinery.shading.features(gaussians))
        self._settle_sides()
        progress = self.schedule.progress(self.state.iteration)
        machinery.shading.settle(gaussians, machinery.tracer, progress=progress)

    def _settle_sides(self) -> None:
        """Turn Gaussians with their outer sides out, where that is due; done twice, it changes nothing."""
        state, tracer = self.state, self._machinery.tracer
        if self.schedule.settles_sides(state.iteration):
            turned = turn_outwards(state.gaussians, self._dataset, self._dataset.train_indices, tracer)
            state.adam.reset(turned)
            tracer.refresh(turned)

    def _pause(self, watch: Stopwatch, *, resumed: bool) -> None:
        """Measure and keep the state where that is due, and stop if asked to.

        A state that has just been read from its checkpoint was measured by the run that wrote it, if an
        unstopped run measures it at all: so the best one is the same with and without a stop.
        """
        state, schedule = self.state, self.schedule
        stopping = self._should_stop() and not schedule.ends(state.iteration)
        measuring = schedule.measures(state.iteration)
        if not resumed:  # else done before the checkpoint was written
            self._refine_poses()
        if (stopping or measuring) and not resumed:
            with watch.held() as seconds:
                state.seconds = seconds
                if measuring:
                    self._judge.inspect(state, self._machinery.tracer, self._machinery.shading)
                    self._leave_out()
                    self._hasten()
                self._save()
        if stopping:
            raise Cancelled(
                f"Stopped after iteration {state.iteration} of {self.schedule.iterations}; "
                "the same command with --resume goes on."
            )

    def _refine_poses(self) -> None:
        """Align the training views with what the Gaussians show, where that is due."""
        state, machinery = self.state, self._machinery
        if self._refiner is not None and self.schedule.refines_poses(state.iteration):
            state.pose_corrections = self._refiner.refine(
                state.pose_corrections, machinery.tracer, machinery.shading, state.left_out
            )

    def _leave_out(self) -> None:
        """Find views that do not fit, and train without them from here on."""
        state, done = self.state, self.state.iteration
        if not (self._config.exclude_outlier_views and self.schedule.judges_views(done)):
            return
        found = self._view_judge.misfits(self._machinery.tracer, self._machinery.shading, state.left_out)
        if len(found):
            state.left_out = np.sort(np.concatenate([state.left_out, found]))
            self._batches.leave_out(state.left_out)
            names = ", ".join(self._names[i] for i in found.tolist())
            self._tell(
                Warned(
                    f"From iteration {done} on these photographs are left out of the training, "
                    f"since they do not fit the others: {names}."
                )
            )

    def _hasten(self) -> None:
        """Bring the end forward where the training hardly gains any more."""
        state, schedule, least_db = self.state, self.schedule, self._config.early_stopping_db
        if schedule.hastened_after is not None or not gains_no_more(
            state.probed, schedule.iterations, least_db
        ):
            return
        sooner = schedule.hastened(state.iteration)
        if sooner.iterations < schedule.iterations:
            state.hastened_after, self.schedule = state.iteration, sooner
            self._tell(
                Warned(
                    f"The training rays gained less than {least_db:g} dB in a fifth of all iterations, so "
                    f"that the training ends after {sooner.iterations} of {schedule.iterations}; "
                    "early_stopping_db=0 lets it go on."
                )
            )

    def _save(self) -> None:
        state = self.state
        state.densifier = self._machinery.densifier.state()
        state.shading = self._machinery.shading.state()
        path = save_checkpoint(state, self._folder, self._fingerprint)
        self._tell(CheckpointWritten(state.iteration, str(path)))

    def _change(self) -> bool:
        """Change the set of Gaussians where that is due; whether it was."""
        cleared = self._clear()  # first, so that the strategy can use those elsewhere
        return self._densify() or cleared

    def _clear(self) -> bool:
        """Make what is where nothing stays invisible, and so dead to the strategy; whether any was.

        Not while states are averaged, which would have to begin anew: at the end it is all taken away.
        """
        state, schedule = self.state, self.schedule
        if state.iteration % self._config.densify.interval or schedule.is_late(state.iteration):
            return False
        near, gone = self._where_nothing_stays(state.gaussians)
        gone &= state.gaussians.opacity_logits > GONE_LOGIT
        state.taken_near += int((near & gone).sum())
        rows = np.flatnonzero(gone)
        state.gaussians.opacity_logits[rows] = GONE_LOGIT
        state.adam.reset(rows)
        return len(rows) > 0

    def _where_nothing_stays(
        self, gaussians: FlatGaussians, grown: float = 1.0
    ) -> tuple[Bool[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
        """Which Gaussians are in the grown zone around a camera, and which are that or in no view."""
        near = np.zeros(len(gaussians), np.bool_)
        if self._near_zones is not None:
            near = self._near_zones.scaled(grown).contains(gaussians.means_world)
        if self._seen_space is None:
            return near, near.copy()
        return near, near | ~self._seen_space.contains(gaussians.means_world)

    def _densify(self) -> bool:
        """Let the strategy change the set of Gaussians if it is time; whether it was."""
        state, densifier = self.state, self._machinery.densifier
        if not densifier.due(state.iteration):
            return False
        gaussians, adam = densifier.apply(state.gaussians, state.adam, state.rng, extent=self._extent)
        if len(gaussians) == 0:
            raise TrainingFailure(
                f"Densification removed every Gaussian at iteration {state.iteration}; "
                "nothing is exported. Lower the pruning thresholds (--set densify.prune_opacity=...)."
            )
        # Neighbours in space become neighbours in memory, which the tracer's caches like.
        order = morton_order(gaussians.means_world)
        densifier.reorder(order)
        state.gaussians, state.adam = gaussians.select(order), adam.select(order)
        return True

    def _report(self, found: Differentiated, watch: Stopwatch, iterations_here: int) -> None:
        state, total = self.state, self.schedule.iterations
        pace_s = watch.seconds_here / iterations_here
        self._tell(
            TrainingProgress(
                iteration=state.iteration,
                total_iterations=total,
                loss=found.loss.value,
                psnr=decibels(state.running_mse),
                gaussians=len(state.gaussians),
                rays_per_second=self._config.rays_per_batch / pace_s,
                hits_per_ray=found.hits_per_ray,
                seconds=watch.seconds,
                seconds_left=pace_s * (total - state.iteration),
            )
        )


def _refiner(dataset: TrainingData, background_srgb: Float32[np.ndarray, "3"]) -> PoseRefiner:
    if not isinstance(dataset, PosedPhotographs):
        raise ConfigError("refine_poses projects into the photographs, but these come without cameras.")
    return PoseRefiner(dataset, background_srgb)

"""The training loop: iterations, and between them rebuilds, probes, checkpoints and densification."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32

from octasplat.engine.core.errors import CancelledError, ConfigError, TrainingError
from octasplat.engine.core.events import CheckpointWritten, EventListener, TrainingProgress, Warned
from octasplat.engine.dataset.camera_clearance import CameraClearance
from octasplat.engine.dataset.view_frusta import ViewFrusta
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.morton import morton_order
from octasplat.engine.shading.protocol import ShadingModel
from octasplat.engine.shading.recipes import material_shading
from octasplat.engine.trace.factory import make_tracer
from octasplat.engine.trace.protocol import Tracer
from octasplat.engine.train.config import TrainConfig, iteration_count, max_gaussian_count
from octasplat.engine.train.densify import make_densifier
from octasplat.engine.train.densify.normal_propagation import NormalPropagation
from octasplat.engine.train.loop.checkpoint import save_checkpoint
from octasplat.engine.train.loop.early_end import has_converged
from octasplat.engine.train.loop.floors import MinScale
from octasplat.engine.train.loop.iteration import LossGradients, TrainComponents, train_step
from octasplat.engine.train.loop.schedule import Schedule, Stopwatch
from octasplat.engine.train.loop.state import TrainState
from octasplat.engine.train.loop.validation_probe import ValidationProbe, psnr_from_mse
from octasplat.engine.train.sampling.batches import (
    BatchOptions,
    BatchSource,
    PrefetchedBatches,
    evaluation_background,
)
from octasplat.engine.train.sampling.pixel_sampler import TrainingData
from octasplat.engine.train.sampling.shown import valid_pixel_fraction
from octasplat.engine.train.shading_factory import ShadingOptions, make_shading
from octasplat.engine.train.views.corrected_views import PosedTrainingData
from octasplat.engine.train.views.normal_orientation import orient_normals
from octasplat.engine.train.views.outlier_views import OutlierDetector, TrainingViewReport
from octasplat.engine.train.views.pose_refinement import PoseRefiner, RefinedPoses
from octasplat.engine.train.views.view_grids import estimate_untrained_exposures

PRUNED_LOGIT = np.float32(-12.0)
"""Opacity of what is taken away until its place is used for something else: no ray takes note of it."""
FINAL_CLEARANCE_SCALE = 1.5
"""So many times as large are the zones around cameras then, as what may not stand in them gathers around."""


class Trainer:
    """Trains flat Gaussians on a dataset.

    Args:
        dataset: the photographs.
        config: all knobs.
        state: where to begin, fresh or from a checkpoint.
        folder: checkpoints go here.
        fingerprint: what the checkpoints belong to.
        progress: hears the progress.
        threads: for everything; 0 means all cores.
        should_stop: asked wherever a run may stop, see
            :class:`octasplat.engine.train.loop.schedule.Schedule`.
        scale_floor: what no scale falls below.
        camera_clearance: where no Gaussian stays, whatever the strategy does.
        view_frusta: outside of which none stays.
        tracer: anything that follows the protocol; None takes the one that the configuration names.
        shading: likewise.
        on_step: shown the iterations done and the tracer as it is then, after each; it may trace without
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
        progress: EventListener,
        threads: int = 0,
        should_stop: Callable[[], bool] = lambda: False,
        scale_floor: MinScale | None = None,
        camera_clearance: CameraClearance | None = None,
        view_frusta: ViewFrusta | None = None,
        tracer: Tracer | None = None,
        shading: ShadingModel | None = None,
        on_step: Callable[[int, Tracer], None] | None = None,
    ) -> None:
        self.state = state
        self._on_step = on_step
        self._scale_floor = scale_floor
        self._camera_clearance = camera_clearance
        self._view_frusta = view_frusta
        self._config = config
        self._folder = folder
        self._fingerprint = fingerprint
        self._progress = progress
        self._should_stop = should_stop
        self._extent = dataset.extent
        self._threads = threads
        self._background_srgb = evaluation_background(config.background)
        self._pose_refiner = (
            _make_pose_refiner(dataset, self._background_srgb) if config.refine_poses else None
        )
        if self._pose_refiner is not None:
            dataset = self._pose_refiner.dataset
            if len(state.pose_corrections):
                self._pose_refiner.dataset.set_corrections(state.pose_corrections)
            else:
                state.pose_corrections = np.zeros((len(dataset.views), 6))
        self._dataset = dataset
        self._batches = BatchSource(dataset, BatchOptions.from_config(config, dataset))
        pixels, shown = self._batches.sampler.pixel_count, valid_pixel_fraction(dataset)
        self.schedule = Schedule.from_config(config, iteration_count(config, pixels, shown))
        rates = config.lr.scaled_for(self.schedule.iterations)
        self._config = config = config.model_copy(update={"lr": rates})
        densifier = make_densifier(
            config.densify,
            iterations=self.schedule.iterations,
            max_gaussians=max_gaussian_count(config, pixels, shown),
        )
        if config.materials.learn and config.materials.normal_propagation:
            propagate = material_shading(config.materials.recipe).propagate_normals
            densifier = NormalPropagation(densifier, propagate, iterations=self.schedule.iterations)
        if state.early_stop_at is not None:
            self.schedule = self.schedule.stop_early(state.early_stop_at)
        self.shading = shading or make_shading(
            ShadingOptions.from_config(config), len(dataset.views), dataset.extent
        )
        if state.densifier:
            densifier.restore(state.densifier)
        if state.shading:
            self.shading.restore(state.shading)
        self._given_tracer = tracer
        self._components = TrainComponents(tracer or self._make_tracer(), self.shading, densifier)
        self._probe = ValidationProbe(
            dataset,
            folder,
            progress,
            rays=config.probe_rays,
            background_srgb=self._background_srgb,
            best_margin_db=config.best_checkpoint_margin_db,
            seed=config.seed,
        )
        self._names = [view.name for view in dataset.views]
        self._outlier_detector = OutlierDetector(dataset, self._background_srgb)
        self.views: TrainingViewReport | None = None
        self.poses: RefinedPoses | None = None
        if len(state.excluded_views):
            self._batches.exclude_views(state.excluded_views)

    def run(self) -> FlatGaussians:
        """Train to the end and return the Gaussians to export: the last ones, or the best if those collapsed.

        Raises:
            TrainingError: parameters became not-a-number, or nothing is left to see.
            CancelledError: stopped as asked; a checkpoint is on disk.
        """
        with PrefetchedBatches(self._batches) as batches:
            return self._run(batches)

    def _run(self, batches: PrefetchedBatches) -> FlatGaussians:
        state = self.state
        watch, began_at = Stopwatch(state.seconds), state.iteration
        stale = True  # whether the hierarchy is of other Gaussians
        while True:
            schedule = self.schedule
            if schedule.is_finished(state.iteration) and state.average.gaussians is not None:
                state.gaussians = state.average.gaussians
                state.average.clear()
            if schedule.is_rebuild_due(state.iteration, len(state.gaussians)):
                state.raise_sh_degree(schedule.sh_degree(state.iteration))
                if self._scale_floor is not None:
                    self._scale_floor.apply(state.gaussians)
                self._build()
                self._checkpoint_or_stop(watch, resumed=0 < state.iteration == began_at)
                schedule = self.schedule
            elif stale:
                self._build()
            if schedule.is_finished(state.iteration):
                return self._finish()
            machinery = self._components
            batch = batches.draw(state.rng, state.iteration)
            if self._threads != 1 and not self._uses_rng_or_stops(state.iteration + 1):
                batches.prefetch(state.rng, state.iteration + 1)
            progress = schedule.training_progress(state.iteration)
            found = train_step(
                state, batch, machinery,
                loss=self._config.loss, lr=self._config.lr, min_blend_weight=self._config.min_blend_weight,
                training_progress=progress, extent=self._extent,
            )  # fmt: skip
            stale = schedule.may_densify(state.iteration) and self._update_gaussians()
            if stale:
                state.average.clear()
            elif schedule.is_averaging_due(state.iteration):
                state.average.add(state.gaussians)
            if schedule.is_event_due(state.iteration):
                self._report(found, watch, state.iteration - began_at)
            if self._on_step is not None and not stale:
                with watch.paused():
                    self._on_step(state.iteration, machinery.tracer)

    def _finish(self) -> FlatGaussians:
        """The Gaussians to export, seen once more from all views."""
        state, machinery = self.state, self._components
        chosen = self._probe.select_final(state, machinery.tracer, machinery.shading)
        near, gone = self._outside_masks(chosen, FINAL_CLEARANCE_SCALE)
        if gone.any():
            state.pruned_near_cameras += int((near & (chosen.opacity_logits > PRUNED_LOGIT)).sum())
            chosen = chosen.select(np.flatnonzero(~gone))
        if chosen is not state.gaussians:
            if self._pose_refiner is not None:
                self._pose_refiner.dataset.set_corrections(state.pose_corrections)
            machinery.tracer.build(chosen, machinery.shading.features(chosen))
        estimate_untrained_exposures(
            self._dataset, self._background_srgb, machinery.tracer, machinery.shading
        )
        self.views = self._outlier_detector.report(machinery.tracer, machinery.shading, state.excluded_views)
        if (complaint := self.views.warning()) is not None:
            self._progress(Warned(complaint))
        if self._pose_refiner is not None:
            self.poses = self._pose_refiner.report(
                state.pose_corrections, machinery.tracer, machinery.shading, state.excluded_views
            )
            self._progress(Warned(self.poses.summary()))
        return chosen

    def _uses_rng_or_stops(self, done: int) -> bool:
        """Whether, that far, anything but a batch draws from the generator or keeps its state."""
        schedule = self.schedule
        densifies = schedule.may_densify(done) and self._components.densifier.is_due(done)
        return (
            densifies
            or schedule.is_finished(done)
            or schedule.is_rebuild_due(done, len(self.state.gaussians))
        )

    def _make_tracer(self) -> Tracer:
        """A tracer for the next iteration; boxes leave room for what moves between rebuilds."""
        order = "packet" if self.schedule.uses_shared_sort(self.state.iteration) else "ray"
        settings = self._config.trace.model_copy(update={"sort": order})
        return make_tracer(settings, threads=self._threads, box_padding=self._config.box_padding)

    def _build(self) -> None:
        one_order = self._components.tracer.settings.sort == "packet"
        if self._given_tracer is None and one_order != self.schedule.uses_shared_sort(self.state.iteration):
            self._components = replace(self._components, tracer=self._make_tracer())
        gaussians, machinery = self.state.gaussians, self._components
        machinery.tracer.build(gaussians, machinery.shading.features(gaussians))
        self._orient_normals()
        progress = self.schedule.training_progress(self.state.iteration)
        machinery.shading.on_rebuild(gaussians, machinery.tracer, training_progress=progress)

    def _orient_normals(self) -> None:
        """Turn Gaussians with their outer sides out, where that is due; done twice, it changes nothing."""
        state, tracer = self.state, self._components.tracer
        if self.schedule.is_orientation_due(state.iteration):
            turned = orient_normals(state.gaussians, self._dataset, self._dataset.train_indices, tracer)
            state.adam.reset(turned)
            tracer.refresh(turned)

    def _checkpoint_or_stop(self, watch: Stopwatch, *, resumed: bool) -> None:
        """Measure and keep the state where that is due, and stop if asked to.

        A state that has just been read from its checkpoint was measured by the run that wrote it, if an
        unstopped run measures it at all: so the best one is the same with and without a stop.
        """
        state, schedule = self.state, self.schedule
        stopping = self._should_stop() and not schedule.is_finished(state.iteration)
        measuring = schedule.is_validation_due(state.iteration)
        if not resumed:  # else done before the checkpoint was written
            self._refine_poses()
        if (stopping or measuring) and not resumed:
            with watch.paused() as seconds:
                state.seconds = seconds
                if measuring:
                    self._probe.measure(state, self._components.tracer, self._components.shading)
                    self._exclude_outlier_views()
                    self._stop_early()
                self._save_checkpoint()
        if stopping:
            raise CancelledError(
                f"Stopped after iteration {state.iteration} of {self.schedule.iterations}; "
                "the same command with --resume goes on."
            )

    def _refine_poses(self) -> None:
        """Align the training views with what the Gaussians show, where that is due."""
        state, machinery = self.state, self._components
        if self._pose_refiner is not None and self.schedule.is_pose_refinement_due(state.iteration):
            state.pose_corrections = self._pose_refiner.refine(
                state.pose_corrections, machinery.tracer, machinery.shading, state.excluded_views
            )

    def _exclude_outlier_views(self) -> None:
        """Find views that do not fit, and train without them from here on."""
        state, done = self.state, self.state.iteration
        if not (self._config.exclude_outlier_views and self.schedule.is_outlier_check_due(done)):
            return
        found = self._outlier_detector.find(
            self._components.tracer, self._components.shading, state.excluded_views
        )
        if len(found):
            state.excluded_views = np.sort(np.concatenate([state.excluded_views, found]))
            self._batches.exclude_views(state.excluded_views)
            names = ", ".join(self._names[i] for i in found.tolist())
            self._progress(
                Warned(
                    f"From iteration {done} on these photographs are left out of the training, "
                    f"since they do not fit the others: {names}."
                )
            )

    def _stop_early(self) -> None:
        """Bring the end forward where the training hardly gains any more."""
        state, schedule, least_db = self.state, self.schedule, self._config.early_stopping_db
        if schedule.early_stop_at is not None or not has_converged(
            state.probes, schedule.iterations, least_db
        ):
            return
        sooner = schedule.stop_early(state.iteration)
        if sooner.iterations < schedule.iterations:
            state.early_stop_at, self.schedule = state.iteration, sooner
            self._progress(
                Warned(
                    f"The training rays gained less than {least_db:g} dB in a fifth of all iterations, so "
                    f"that the training ends after {sooner.iterations} of {schedule.iterations}; "
                    "early_stopping_db=0 lets it go on."
                )
            )

    def _save_checkpoint(self) -> None:
        state = self.state
        state.densifier = self._components.densifier.state()
        state.shading = self._components.shading.state()
        path = save_checkpoint(state, self._folder, self._fingerprint)
        self._progress(CheckpointWritten(state.iteration, str(path)))

    def _update_gaussians(self) -> bool:
        """Change the set of Gaussians where that is due; whether it was."""
        cleared = self._prune_outside()  # first, so that the strategy can use those elsewhere
        return self._densify() or cleared

    def _prune_outside(self) -> bool:
        """Make what is where nothing stays invisible, and so dead to the strategy; whether any was.

        Not while states are averaged, which would have to begin anew: at the end it is all taken away.
        """
        state, schedule = self.state, self.schedule
        if state.iteration % self._config.densify.interval or schedule.is_averaging(state.iteration):
            return False
        near, gone = self._outside_masks(state.gaussians)
        gone &= state.gaussians.opacity_logits > PRUNED_LOGIT
        state.pruned_near_cameras += int((near & gone).sum())
        rows = np.flatnonzero(gone)
        state.gaussians.opacity_logits[rows] = PRUNED_LOGIT
        state.adam.reset(rows)
        return len(rows) > 0

    def _outside_masks(
        self, gaussians: FlatGaussians, grown: float = 1.0
    ) -> tuple[Bool[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
        """Which Gaussians are in the grown zone around a camera, and which are that or in no view."""
        near = np.zeros(len(gaussians), np.bool_)
        if self._camera_clearance is not None:
            near = self._camera_clearance.scaled(grown).contains(gaussians.means_world)
        if self._view_frusta is None:
            return near, near.copy()
        return near, near | ~self._view_frusta.contains(gaussians.means_world)

    def _densify(self) -> bool:
        """Let the strategy change the set of Gaussians if it is time; whether it was."""
        state, densifier = self.state, self._components.densifier
        if not densifier.is_due(state.iteration):
            return False
        gaussians, adam = densifier.apply(state.gaussians, state.adam, state.rng, extent=self._extent)
        if len(gaussians) == 0:
            raise TrainingError(
                f"Densification removed every Gaussian at iteration {state.iteration}; "
                "nothing is exported. Lower the pruning thresholds (--set densify.prune_opacity=...)."
            )
        # Neighbours in space become neighbours in memory, which the tracer's caches like.
        order = morton_order(gaussians.means_world)
        densifier.reorder(order)
        state.gaussians, state.adam = gaussians.select(order), adam.select(order)
        return True

    def _report(self, found: LossGradients, watch: Stopwatch, iterations_here: int) -> None:
        state, total = self.state, self.schedule.iterations
        pace_s = watch.seconds_here / iterations_here
        self._progress(
            TrainingProgress(
                iteration=state.iteration,
                total_iterations=total,
                loss=found.loss.value,
                psnr=psnr_from_mse(state.running_mse),
                gaussians=len(state.gaussians),
                rays_per_second=self._config.rays_per_batch / pace_s,
                hits_per_ray=found.hits_per_ray,
                seconds=watch.seconds,
                seconds_left=pace_s * (total - state.iteration),
            )
        )


def _make_pose_refiner(dataset: TrainingData, background_srgb: Float32[np.ndarray, "3"]) -> PoseRefiner:
    if not isinstance(dataset, PosedTrainingData):
        raise ConfigError("refine_poses projects into the photographs, but these come without cameras.")
    return PoseRefiner(dataset, background_srgb)

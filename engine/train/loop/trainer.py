"""The training loop: iterations, and between them rebuilds, probes, checkpoints and densification."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from octasplat.engine.core.errors import CancelledError, TrainingError
from octasplat.engine.core.events import CheckpointWritten, EventListener, TrainingProgress, Warned
from octasplat.engine.core.progress import ProgressCallback, no_progress
from octasplat.engine.dataset.camera_clearance import CameraClearance
from octasplat.engine.dataset.region import Region
from octasplat.engine.dataset.view_frusta import ViewFrusta
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.morton import morton_order
from octasplat.engine.shading.protocol import ShadingModel
from octasplat.engine.shading.recipes import material_shading
from octasplat.engine.trace.factory import make_tracer
from octasplat.engine.trace.fixed_gaussians import PartlyFixedTracer
from octasplat.engine.trace.protocol import Tracer
from octasplat.engine.train.config import TrainConfig, iteration_count, max_gaussian_count
from octasplat.engine.train.densify import make_densifier
from octasplat.engine.train.densify.normal_propagation import NormalPropagation
from octasplat.engine.train.densify.opacity_decay import DECAY_UNTIL, decayed_logits
from octasplat.engine.train.loop.allowed_region import AllowedRegion
from octasplat.engine.train.loop.checkpoint import save_checkpoint
from octasplat.engine.train.loop.iteration import LossGradients, TrainComponents, train_step
from octasplat.engine.train.loop.schedule import Schedule, Stopwatch, has_converged
from octasplat.engine.train.loop.state import MinScale, TrainState
from octasplat.engine.train.loop.validation_probe import ValidationProbe, psnr_from_mse
from octasplat.engine.train.sampling.batches import (
    BatchOptions,
    BatchSource,
    PrefetchedBatches,
    evaluation_background,
)
from octasplat.engine.train.sampling.pixel_sampler import TrainingData, valid_pixel_fraction
from octasplat.engine.train.shading_factory import ShadingOptions, make_shading
from octasplat.engine.train.views.normal_orientation import orient_normals
from octasplat.engine.train.views.outlier_views import OutlierDetector, TrainingViewReport
from octasplat.engine.train.views.pose_refinement import RefinedPoses, make_pose_refiner
from octasplat.engine.train.views.view_grids import estimate_untrained_exposures


class Trainer:
    """Train flat Gaussians on a dataset.

    Args:
        dataset: the photographs.
        config: all settings of the training.
        state: where to begin, fresh or from a checkpoint.
        folder: receives the checkpoints.
        fingerprint: digest of the settings and photographs that the checkpoints belong to.
        progress: receives the events.
        threads: for everything; 0 means all cores.
        should_stop: asked wherever a run may stop, see
            :class:`octasplat.engine.train.loop.schedule.Schedule`.
        min_scale: least size of Gaussians.
        camera_clearance: zones around cameras in which no Gaussian stays, whatever the strategy does.
        view_frusta: frusta of the views; no Gaussian stays outside of all of them.
        fixed_gaussians: Gaussians that are seen, too, and stay as they are; not with a tracer that is given.
        is_fixed_in_files: whether all that is traced, where some are fixed, is in files beside ``folder``,
            which may be removed before them.
        region: where Gaussians are added first; None for everywhere alike.
        tracer: anything that follows the protocol; None takes the one that the configuration names.
        shading: anything that follows the protocol; None takes the one that the configuration asks for.
        on_step: called after each iteration with the number of those done and the tracer as it is then; it
            may trace without recording and must change nothing.

    Attributes:
        state: the present state.
        config: its settings, with the rates of its length.
        dataset: the photographs, at refined poses where these are refined.
        schedule: when what happens; another one from where it is decided to end early.
        shading: the shading model.
        views: how well the exported Gaussians show the training views; None before the end.
        poses: the refined poses of the training views; None before the end, or where none are refined.

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
        min_scale: MinScale | None = None,
        camera_clearance: CameraClearance | None = None,
        view_frusta: ViewFrusta | None = None,
        fixed_gaussians: FlatGaussians | None = None,
        is_fixed_in_files: bool = False,
        region: Region | None = None,
        tracer: Tracer | None = None,
        shading: ShadingModel | None = None,
        on_step: Callable[[int, Tracer], None] | None = None,
    ) -> None:
        self.state = state
        self._fixed_gaussians = fixed_gaussians
        self._traced_folder = folder.parent if is_fixed_in_files else None
        self._on_step = on_step
        self._min_scale = min_scale
        self._allowed_region = AllowedRegion(camera_clearance, view_frusta)
        self.config = config
        self._folder = folder
        self._fingerprint = fingerprint
        self._progress = progress
        self._should_stop = should_stop
        self._extent = dataset.extent
        self._threads = threads
        self._background_srgb = evaluation_background(config.background)
        self._pose_refiner = (
            make_pose_refiner(dataset, self._background_srgb) if config.refine_poses else None
        )
        given = dataset
        if self._pose_refiner is not None:
            dataset = self._pose_refiner.dataset
            if len(state.pose_corrections):
                self._pose_refiner.dataset.set_corrections(state.pose_corrections)
            else:
                state.pose_corrections = np.zeros((len(dataset.views), 6))
        self.dataset = dataset
        self._batches = BatchSource(dataset, BatchOptions.from_config(config, dataset), observed=given)
        pixels, valid = self._batches.sampler.pixel_count, valid_pixel_fraction(dataset)
        # its length first: rates and the strategy depend on it
        self.schedule = Schedule.from_config(config, iteration_count(config, pixels, valid))
        rates = config.lr.scaled_for(self.schedule.iterations)
        self.config = config = config.model_copy(update={"lr": rates})
        densifier = make_densifier(
            config.densify,
            iterations=self.schedule.iterations,
            max_gaussians=max_gaussian_count(config, pixels, valid),
            region=region,
        )
        if config.materials.learn and config.materials.normal_propagation:
            propagate = material_shading(config.materials.recipe).propagate_normals
            densifier = NormalPropagation(densifier, propagate, iterations=self.schedule.iterations)
        if state.early_stop_at is not None:  # decided before the checkpoint: resumed with the same end
            self.schedule = self.schedule.stop_early(state.early_stop_at)
        self.shading = shading or make_shading(
            ShadingOptions.from_config(config), len(dataset.views), dataset.extent
        )
        if state.densifier:
            densifier.restore(state.densifier)
        if state.shading:
            self.shading.restore(state.shading)
        self._caller_tracer = tracer
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
        watch, first_iteration = Stopwatch(state.seconds), state.iteration
        is_stale = True  # whether the hierarchy was built for other Gaussians
        while True:
            schedule = self.schedule
            if schedule.is_finished(state.iteration) and state.average.gaussians is not None:
                # the mean replaces the last state before it is measured
                state.gaussians = state.average.gaussians
                state.average.clear()
            if schedule.is_rebuild_due(state.iteration, len(state.gaussians)):
                state.raise_sh_degree(schedule.sh_degree(state.iteration))
                is_resumed = 0 < state.iteration == first_iteration
                if state.iteration > 0 and not is_resumed:  # else done before the checkpoint was written
                    self._decay_opacities()
                if self._min_scale is not None:
                    self._min_scale.apply(state.gaussians)
                self._rebuild_bvh()
                self._checkpoint_or_stop(watch, resumed=is_resumed)
                schedule = self.schedule
            elif is_stale:
                self._rebuild_bvh()
            if schedule.is_finished(state.iteration):
                return self._finish()
            components = self._components
            batch = batches.draw(state.rng, state.iteration)
            # with one thread there is nobody to draw it meanwhile
            if self._threads != 1 and not self._uses_rng_or_stops(state.iteration + 1):
                batches.prefetch(state.rng, state.iteration + 1)
            progress = schedule.training_progress(state.iteration)
            step = train_step(
                state, batch, components,
                loss=self.config.loss, lr=self.config.lr, min_blend_weight=self.config.min_blend_weight,
                training_progress=progress, extent=self._extent,
            )  # fmt: skip
            is_stale = schedule.may_densify(state.iteration) and self._update_gaussians()
            # rows belong to other Gaussians now
            if is_stale:
                state.average.clear()
            elif schedule.is_averaging_due(state.iteration):
                state.average.add(state.gaussians)
            if schedule.is_event_due(state.iteration):
                self._report(step, watch, state.iteration - first_iteration)
            if self._on_step is not None and not is_stale:
                with watch.paused():
                    self._on_step(state.iteration, components.tracer)

    def _decay_opacities(self) -> None:
        """Take a little of all opacities in the first part of the training, where that is asked for."""
        factor, gaussians = self.config.opacity_decay, self.state.gaussians
        if factor is not None and self.schedule.training_progress(self.state.iteration) <= DECAY_UNTIL:
            gaussians.opacity_logits = decayed_logits(gaussians.opacity_logits, factor)

    def _finish(self) -> FlatGaussians:
        """Return the Gaussians to export, after measuring them on all views."""
        state, tracer, shading = self.state, self._components.tracer, self._components.shading
        gaussians = self._probe.select_final(state, tracer, shading)
        gaussians = self._allowed_region.select_final(gaussians, state)
        if gaussians is not state.gaussians:
            if self._pose_refiner is not None:  # the Gaussians of the best state belong to its poses
                self._pose_refiner.dataset.set_corrections(state.pose_corrections)
            tracer.build(gaussians, shading.features(gaussians))
        estimate_untrained_exposures(self.dataset, self._background_srgb, tracer, shading)
        self.views = self._outlier_detector.report(tracer, shading, state.excluded_views)
        if (warning := self.views.warning()) is not None:
            self._progress(Warned(warning))
        if self._pose_refiner is not None:
            self.poses = self._pose_refiner.report(
                state.pose_corrections, tracer, shading, state.excluded_views
            )
            self._progress(Warned(self.poses.summary()))
        return gaussians

    @property
    def measured_view_count(self) -> int:
        """Return how many views are measured at the end: all but those that were left out."""
        return len(self.dataset.views) - len(self.state.excluded_views)

    def measure_views_again(self, shading: ShadingModel, progress: ProgressCallback = no_progress) -> None:
        """Measure once more how well the exported Gaussians show the views, by what was added to the shading.

        Views that do not fit stay those that were told at the end of the training. ``progress`` is told of
        the views that are measured.
        """
        assert self.views is not None, "the training has ended"
        tracer, left_out = self._components.tracer, self.state.excluded_views
        measured = self._outlier_detector.report(tracer, shading, left_out, progress)
        self.views = replace(self.views, psnr=measured.psnr)

    def _uses_rng_or_stops(self, done: int) -> bool:
        """Return whether anything but a batch uses the generator, or keeps its state, after an iteration."""
        schedule = self.schedule
        will_densify = schedule.may_densify(done) and self._components.densifier.is_due(done)
        return (
            will_densify
            or schedule.is_finished(done)
            or schedule.is_rebuild_due(done, len(self.state.gaussians))
        )

    def _make_tracer(self) -> Tracer:
        """Return a tracer for the next iteration; its boxes leave room for moves between rebuilds."""
        sort = "packet" if self.schedule.uses_shared_sort(self.state.iteration) else "ray"
        settings = self.config.trace.model_copy(update={"sort": sort})
        tracer = make_tracer(settings, threads=self._threads, box_padding=self.config.box_padding)
        if self._fixed_gaussians is None:
            return tracer
        return PartlyFixedTracer(tracer, self._fixed_gaussians, self._traced_folder)

    def _rebuild_bvh(self) -> None:
        """Rebuild the BVH over the current Gaussians, replacing the tracer when the sort mode changes."""
        uses_shared_sort = self._components.tracer.settings.sort == "packet"
        if self._caller_tracer is None and uses_shared_sort != self.schedule.uses_shared_sort(
            self.state.iteration
        ):
            self._components = replace(self._components, tracer=self._make_tracer())
        gaussians, tracer, shading = self.state.gaussians, self._components.tracer, self._components.shading
        tracer.build(gaussians, shading.features(gaussians))
        self._orient_normals()
        progress = self.schedule.training_progress(self.state.iteration)
        shading.on_rebuild(gaussians, tracer, training_progress=progress)

    def _orient_normals(self) -> None:
        """Turn Gaussians so that normals point outwards, where that is due; again, it changes nothing."""
        state, tracer = self.state, self._components.tracer
        if self.schedule.is_orientation_due(state.iteration):
            flipped_ids = orient_normals(state.gaussians, self.dataset, self.dataset.train_indices, tracer)
            state.adam.reset(flipped_ids)  # moments belong to the former axes
            tracer.refresh(flipped_ids)

    def _checkpoint_or_stop(self, watch: Stopwatch, *, resumed: bool) -> None:
        """Measure the state and save it where that is due, and stop if asked to.

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
        """Refine the poses of the training views by what the Gaussians show, where that is due."""
        state, components = self.state, self._components
        if self._pose_refiner is not None and self.schedule.is_pose_refinement_due(state.iteration):
            state.pose_corrections = self._pose_refiner.refine(
                state.pose_corrections, components.tracer, components.shading, state.excluded_views
            )

    def _exclude_outlier_views(self) -> None:
        """Find views that do not fit the others, and train without them from here on."""
        state, done = self.state, self.state.iteration
        if not (self.config.exclude_outlier_views and self.schedule.is_outlier_check_due(done)):
            return
        outliers = self._outlier_detector.find(
            self._components.tracer, self._components.shading, state.excluded_views
        )
        if len(outliers):
            state.excluded_views = np.sort(np.concatenate([state.excluded_views, outliers]))
            self._batches.exclude_views(state.excluded_views)
            names = ", ".join(self._names[i] for i in outliers.tolist())
            self._progress(
                Warned(
                    f"From iteration {done} on these photographs are left out of the training, "
                    f"since they do not fit the others: {names}."
                )
            )

    def _stop_early(self) -> None:
        """End the training early where it hardly gains any more."""
        state, schedule, min_gain_db = self.state, self.schedule, self.config.early_stopping_db
        if schedule.early_stop_at is not None or not has_converged(
            state.probes, schedule.iterations, min_gain_db
        ):
            return
        shortened = schedule.stop_early(state.iteration)
        if shortened.iterations < schedule.iterations:
            state.early_stop_at, self.schedule = state.iteration, shortened
            self._progress(
                Warned(
                    f"The training rays gained less than {min_gain_db:g} dB in a fifth of all iterations, so "
                    f"that the training ends after {shortened.iterations} of {schedule.iterations}; "
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
        """Change the set of Gaussians where that is due; return whether it was."""
        has_pruned = self._prune_outside()  # first, so that the strategy can use those elsewhere
        return self._densify() or has_pruned

    def _prune_outside(self) -> bool:
        """Hide Gaussians outside of the allowed region where that is due; return whether there were any.

        Not while states are averaged, which would have to begin anew: at the end they are all removed.
        """
        done = self.state.iteration
        if done % self.config.densify.interval or self.schedule.is_averaging(done):
            return False
        return self._allowed_region.hide_outside(self.state)

    def _densify(self) -> bool:
        """Let the strategy change the set of Gaussians where that is due; return whether it was."""
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

    def _report(self, step: LossGradients, watch: Stopwatch, iterations_here: int) -> None:
        state, total = self.state, self.schedule.iterations
        pace_s = watch.pace_seconds / iterations_here
        self._progress(
            TrainingProgress(
                iteration=state.iteration,
                total_iterations=total,
                loss=step.loss.value,
                psnr=psnr_from_mse(state.running_mse),
                gaussians=len(state.gaussians),
                rays_per_second=self.config.rays_per_batch / pace_s,
                hits_per_ray=step.hits_per_ray,
                seconds=watch.seconds,
                seconds_left=pace_s * (total - state.iteration),
            )
        )

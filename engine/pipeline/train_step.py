"""The training step: its result is the scene, and what the training learnt beside it."""

import json
import time
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from octasplat.engine.core import versions
from octasplat.engine.core.events import Event, EventListener, Noted, TrainingProgress, Warned
from octasplat.engine.core.progress import PhaseClock, ProgressCallback, counted_phase, phase
from octasplat.engine.core.threads import use_threads
from octasplat.engine.core.writing import write_json
from octasplat.engine.dataset import Dataset
from octasplat.engine.dataset.camera_clearance import CameraClearance, camera_clearances
from octasplat.engine.dataset.region import OUTSIDE_FREQUENCY
from octasplat.engine.dataset.view_frusta import ViewFrusta
from octasplat.engine.dataset.view_tiles import FULL_FREQUENCY, Rectangles
from octasplat.engine.files.gaussian_ply import write_gaussian_ply
from octasplat.engine.gaussians.materials import reflective_fraction
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.scene_metadata import SceneMetadata
from octasplat.engine.pipeline.block_steps import count_blocks, train_all_blocks
from octasplat.engine.pipeline.material_choice import choose_materials, rewrite_config
from octasplat.engine.pipeline.run import ReconstructionRun
from octasplat.engine.pipeline.start_scene import has_start, started_state
from octasplat.engine.render.environment_files import write_background_map, write_environment
from octasplat.engine.render.shots import training_pixel_angle
from octasplat.engine.runs.config import resolve_config
from octasplat.engine.runs.residual_file import write_residual
from octasplat.engine.runs.run_folder import (
    BACKGROUND,
    CHECKPOINTS,
    ENVIRONMENT_EXR,
    ENVIRONMENT_HDR,
    PLAN,
    RESIDUAL,
    RESIDUAL_ITERATIONS,
    SCENE,
    TRAINING,
)
from octasplat.engine.shading.material_settings import MaterialSettings
from octasplat.engine.shading.protocol import ShadingModel
from octasplat.engine.shading.recipes import material_shading
from octasplat.engine.shading.residual_colors import ResidualColors
from octasplat.engine.trace.factory import make_tracer
from octasplat.engine.train.config import (
    TrainConfig,
    has_residual_colors,
    iteration_count,
    residual_cost_share,
    residual_iteration_count,
)
from octasplat.engine.train.initialization.initial_gaussians import initial_train_state
from octasplat.engine.train.loop.checkpoint import (
    load_latest_checkpoint,
    remove_former_checkpoints,
    run_fingerprint,
)
from octasplat.engine.train.loop.residual_fit import fit_residual_colors
from octasplat.engine.train.loop.state import MinScale, TrainState
from octasplat.engine.train.loop.time_budget import make_plan, read_plan, write_plan
from octasplat.engine.train.loop.trainer import Trainer
from octasplat.engine.train.sampling.pixel_sampler import valid_pixel_fraction
from octasplat.engine.train.shading_factory import (
    add_residual,
    find_background,
    find_deferred,
    find_exposures,
)
from octasplat.engine.train.views.exposure_changes import resolve_exposure

MIN_REFLECTIVE_SHARE = 0.01
"""Share of the surface that must reflect for materials and the environment to be more than guesses."""


def tell_of_former_scene(run: ReconstructionRun) -> None:
    """Tell where the scene of a run that goes on was trained by a version with other results."""
    record: object = {}
    with suppress(OSError, ValueError):  # as of a run of old
        record = json.loads((run.output / TRAINING).read_text(encoding="utf-8"))
    if (run.output / SCENE).exists() and isinstance(record, dict) and not versions.has_same_results(record):
        run.progress(
            Warned(
                f"{run.output / SCENE} was trained by a version in which the same settings gave other "
                "results; it stays as it is, and what is still missing is made by this version."
            )
        )


class TrainStep:
    """Train the scene; resumes from the newest checkpoint."""

    is_needed_later = True

    def is_done(self, run: ReconstructionRun) -> bool:
        """Return whether the scene exists."""
        return (run.output / SCENE).exists()

    def __call__(self, run: ReconstructionRun) -> None:
        """Train, and write the scene after everything else."""
        began = time.perf_counter()
        if remove_former_checkpoints(run.output / CHECKPOINTS, run.progress):
            rewrite_config(run)  # which names the versions that train
        if count_blocks(run) == 1 and not any((run.output / CHECKPOINTS).glob("*.npz")):
            choose_materials(run)  # before the plan, which shares out what is left of the time
        dataset, config = run.dataset, run.config
        steps, choosing_s = 0, time.perf_counter() - began
        if not config.minutes:
            steps = iteration_count(
                run.train_config, dataset.train_pixel_count, valid_pixel_fraction(dataset)
            )
        with phase("train", run.progress, steps) as clock:
            clock.add(choosing_s)
            if (count := count_blocks(run)) > 1:
                _write_scene(run, _train_in_blocks(run, count))
                return
            trained = _train(run, clock)
            fits = residual_iteration_count(trained.trainer.config, trained.trainer.state.iteration)
            if not fits:
                (run.output / RESIDUAL).unlink(missing_ok=True)  # of a training that was begun anew
                trained.write(run, clock.stop())
        if fits:  # its own stage: what was trained is in a checkpoint, and the scene is there after both
            began = time.perf_counter()
            steps = fits + trained.trainer.measured_view_count
            with counted_phase("residual", run.progress, steps) as count_steps:
                _fit_residual(run, trained.trainer, trained.gaussians, fits, count_steps)
                seconds = clock.seconds() + time.perf_counter() - began
                trained.write(run, seconds, residual_iterations=fits)


def _write_scene(run: ReconstructionRun, gaussians: FlatGaussians) -> None:
    """Write the scene, with which the training is done."""
    dataset = run.dataset
    facts = SceneMetadata(
        near_world=dataset.near_world,
        pixel_rad=training_pixel_angle(dataset.viewpoints),
        turned_beyond=run.config.train.trace.flip_normal_cos,
        origin_world=dataset.origin_world,
    )
    write_gaussian_ply(gaussians, run.output / SCENE, facts=facts)


@dataclass(frozen=True)
class _Trained:
    """A training of the whole scene that has ended, and what its files need."""

    trainer: Trainer
    gaussians: FlatGaussians
    nearest_world: Float64[np.ndarray, " views"]
    keeps_near_free: bool

    def write(self, run: ReconstructionRun, seconds: float, *, residual_iterations: int = 0) -> None:
        """Write the record of the training, then the scene."""
        _write_training_record(
            self.trainer, run.dataset, self.nearest_world, seconds, run.output,
            keeps_near_free=self.keeps_near_free, residual_iterations=residual_iterations,
        )  # fmt: skip
        _write_scene(run, self.gaussians)


def _train(run: ReconstructionRun, clock: PhaseClock) -> _Trained:
    config = _plan_settings(run, clock)
    nearest_world = camera_clearances(run.dataset.viewpoints, run.dataset.points)
    trainer = _make_trainer(run, config, nearest_world, clock)
    gaussians = trainer.run()
    _write_learnt_light(trainer.shading, gaussians, run.output, run.progress)
    return _Trained(trainer, gaussians, nearest_world, config.camera_clearance > 0)


def _with_residual_time(progress: EventListener, config: TrainConfig) -> EventListener:
    """Return a listener that adds the fit of residual colors to the time that a training still takes."""
    if not has_residual_colors(config):
        return progress

    def listen(event: Event) -> None:
        if isinstance(event, TrainingProgress):
            pace_s = config.rays_per_batch / event.rays_per_second
            after = residual_cost_share(config) * event.total_iterations * pace_s
            event = replace(event, seconds_left=event.seconds_left + after, seconds_after=after)
        progress(event)

    return listen


def _fit_residual(
    run: ReconstructionRun,
    trainer: Trainer,
    gaussians: FlatGaussians,
    iterations: int,
    progress: ProgressCallback,
) -> None:
    """Fit and write residual colors after a training with materials, and measure the views with them."""
    config, steps = trainer.config, iterations + trainer.measured_view_count
    residual_sh = fit_residual_colors(
        gaussians, trainer.dataset, trainer.shading, config,
        iterations=iterations, excluded_views=trainer.state.excluded_views, threads=run.threads,
        should_stop=run.should_stop, progress=lambda done, _total, _part=0.0: progress(done, steps),
    )  # fmt: skip
    write_residual(run.output, gaussians, residual_sh)
    materials = find_deferred(trainer.shading)
    assert materials is not None, "materials are learnt"
    tracer = make_tracer(config.trace, threads=run.threads)
    residual = ResidualColors(materials, gaussians, residual_sh, tracer)
    trainer.measure_views_again(
        add_residual(trainer.shading, residual),
        lambda done, _total, _part=0.0: progress(iterations + done, steps),
    )


def _train_in_blocks(run: ReconstructionRun, count: int) -> FlatGaussians:
    """Return the scene trained in so many blocks; writes the facts on it."""
    scene = train_all_blocks(run, count)
    _write_learnt_light(scene.shading, scene.gaussians, run.output, run.progress)
    record: dict[str, object] = {
        "seconds": sum(piece.get("seconds", 0.0) for piece in scene.record.values()),
        "iterations": sum(int(piece.get("iterations", 0)) for piece in scene.record.values()),
        "pieces": scene.record,
    }
    nearest_world = camera_clearances(run.dataset.viewpoints, run.dataset.points)
    _write_record(record, run.dataset, scene.shading, nearest_world, run.output)
    return scene.gaussians


def _make_trainer(
    run: ReconstructionRun,
    config: TrainConfig,
    nearest_world: Float64[np.ndarray, " views"],
    clock: PhaseClock,
) -> Trainer:
    """Return the training from its start, or from its newest checkpoint."""
    dataset, progress, folder = run.dataset, run.progress, run.output / CHECKPOINTS
    exposure, exposure_changes = resolve_exposure(
        config.exposure, dataset, has_materials=config.materials.learn
    )
    config = config.model_copy(update={"exposure": exposure})
    fingerprint = run_fingerprint(dataset, config)
    state = load_latest_checkpoint(folder, fingerprint, progress)
    if state is None:
        state = _first_state(run, config)
        if exposure_changes is not None:
            progress(Warned(f"{exposure_changes} That is learnt; exposure=false leaves it out."))
        if dataset.trained_pixels is not None:
            progress(Noted(_region_text(dataset, dataset.trained_pixels)))
        state.seconds = clock.seconds()  # the clock of the phase, the making of the first Gaussians included
    else:
        clock.add(state.seconds)  # time of earlier processes counts
    zones = CameraClearance.from_views(
        dataset.viewpoints, config.camera_clearance * nearest_world, dataset.train_indices
    )
    frusta = ViewFrusta.from_views(dataset.viewpoints, dataset.train_indices)
    trainer: Trainer = Trainer(
        dataset,
        config,
        state,
        folder=folder,
        fingerprint=fingerprint,
        progress=_with_residual_time(progress, config),
        threads=run.threads,
        should_stop=run.should_stop,
        min_scale=MinScale.of_views(dataset.viewpoints, dataset.train_indices, config.min_scale_px),
        region=dataset.region,
        camera_clearance=zones if config.camera_clearance > 0 else None,
        view_frusta=frusta if _prunes_unseen(config.materials) else None,
        on_step=None
        if (on_step := run.on_step) is None
        else lambda done, tracer: on_step(done, dataset, tracer, trainer.shading, trainer.state.gaussians),
    )
    return trainer


def _region_text(dataset: Dataset, trained_pixels: Rectangles) -> str:
    """Return a sentence on the pixels that see the region."""
    chosen = trained_pixels.of_views(dataset.train_indices)
    seeing = chosen.of_frequency(FULL_FREQUENCY).pixel_count
    return (
        f"The region is seen by {seeing / 1e6:.1f} of {chosen.pixel_count / 1e6:.1f} million pixels; the "
        f"others are drawn {FULL_FREQUENCY // OUTSIDE_FREQUENCY} times less often."
    )


def _prunes_unseen(materials: MaterialSettings) -> bool:
    """Return whether Gaussians that lie in no photograph are removed."""
    return materials.learn and material_shading(materials.recipe).prunes_unseen(materials)


def _write_learnt_light(
    shading: ShadingModel, gaussians: FlatGaussians, output: Path, progress: EventListener
) -> None:
    """Write the learnt environment and background, if there are any."""
    if (deferred := find_deferred(shading)) is not None:
        for name in (ENVIRONMENT_EXR, ENVIRONMENT_HDR):
            write_environment(output / name, deferred.light.radiance_linear)
        if reflective_fraction(gaussians) < MIN_REFLECTIVE_SHARE:
            progress(
                Warned(
                    "Nothing was seen that reflects its surroundings clearly: metallic, roughness and the "
                    "environment are guesses, and relighting will show it."
                )
            )
    if (background := find_background(shading)) is not None:
        write_background_map(output / BACKGROUND, background.rgb_srgb)


def _write_training_record(
    trainer: Trainer,
    dataset: Dataset,
    nearest_world: Float64[np.ndarray, " views"],
    seconds: float,
    output: Path,
    *,
    keeps_near_free: bool,
    residual_iterations: int,
) -> None:
    """Write the facts on a finished training that later steps and commands need."""
    record: dict[str, object] = {"seconds": seconds, "iterations": trainer.state.iteration}
    if trainer.schedule.early_stop_at is not None:
        record["planned_iterations"] = trainer.schedule.planned_iterations
    if trainer.views is not None:
        record["training_views"] = trainer.views.as_dict()
    if trainer.poses is not None:
        record["poses"] = trainer.poses.as_dict()
    if residual_iterations:
        record[RESIDUAL_ITERATIONS] = residual_iterations
    if keeps_near_free:
        record["taken_near"] = trainer.state.pruned_near_cameras
    _write_record(record, dataset, trainer.shading, nearest_world, output)


def _write_record(
    record: dict[str, object],
    dataset: Dataset,
    shading: ShadingModel,
    nearest_world: Float64[np.ndarray, " views"],
    output: Path,
) -> None:
    """Write a record of a training with the exposures and the nearest distance of each view."""
    if (exposures := find_exposures(shading)) is not None:
        record["exposures"] = exposures.as_dict([view.name for view in dataset.views])
    distances = dict(zip((view.name for view in dataset.views), nearest_world.tolist(), strict=True))
    record[versions.STATED] = versions.RESULTS_VERSION
    record["nearest_world"] = {name: distance for name, distance in distances.items() if distance > 0}
    write_json(output / TRAINING, record)


def _first_state(run: ReconstructionRun, config: TrainConfig) -> TrainState:
    """Return the state before the first iteration: on the sparse points, or with the scene of another run."""
    threads = use_threads(run.threads)
    if has_start(run.output):
        return started_state(run.output, run.dataset, config, threads, run.progress)
    return initial_train_state(run.dataset, config, threads=threads)


def _plan_settings(run: ReconstructionRun, clock: PhaseClock) -> TrainConfig:
    """Return the training's settings; those chosen by the time budget are recorded the first time."""
    settings, output = run.config, run.output
    config = run.train_config
    if settings.minutes is None:
        return config
    if not (output / PLAN).exists():
        of_preset = resolve_config(settings.preset, materials=config.materials.learn).train
        if config.iterations != of_preset.iterations:
            run.progress(Warned(f"iterations={config.iterations} is passed over, as minutes decides them."))
        began = clock.seconds()
        first = _first_state(run, config).gaussians
        now = clock.seconds()
        left = 60 * settings.minutes - now - (now - began)  # the first Gaussians are made once more
        plan = make_plan(
            run.dataset,
            config,
            first,
            seconds=left,
            threads=run.threads,
            keeps_first=has_start(output),
            should_stop=run.should_stop,
        )
        write_plan(output / PLAN, plan)
    # read back, so that a run that goes on has the very same numbers
    return read_plan(output / PLAN).apply_to(config)

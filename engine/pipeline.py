"""The main job, from photographs to a measured scene and its meshes.

Each stage leaves its result on disk and is skipped when the result is there, so that a run that was stopped
or killed goes on where it was.

    (features -> matches -> poses ->) load (-> check) -> train (initialise, fit) -> scene.ply
    -> evaluate -> export
"""

import shutil
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np

from octasplat.engine.config import ReconstructionConfig, read_config
from octasplat.engine.errors import (
    Cancelled,
    CheckpointError,
    ConfigError,
    DatasetError,
    ExportFailed,
    OutputError,
)
from octasplat.engine.evaluate.runs import measure_run
from octasplat.engine.events import (
    JsonLinesListener,
    Listener,
    RunFinished,
    StageProgress,
    Warned,
    broadcast,
)
from octasplat.engine.files import ExportOptions, check_writable, export_losses, read_facts
from octasplat.engine.files.gaussian_ply import read_gaussian_ply, write_gaussian_ply
from octasplat.engine.files.several import export_files, known_targets
from octasplat.engine.gaussians.materials import reflective_share
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.scene_facts import SceneFacts
from octasplat.engine.plain_colours import PlainScene
from octasplat.engine.render.environment_map import write_background, write_environment
from octasplat.engine.render.jobs import trained_pixel_rad
from octasplat.engine.run_folder import (
    BACKGROUND,
    CACHE,
    CHECKPOINTS,
    CONFIG,
    ENVIRONMENT,
    EVENTS,
    HELD_OUT,
    PLAN,
    POSES,
    SCENE,
    TRAINING,
    VIEWS,
    found_model,
    not_exported,
    open_photographs,
    run_scene,
)
from octasplat.engine.run_poses import find_missing_poses, free_lenses, place_misfits
from octasplat.engine.scene import Dataset, write_held_out
from octasplat.engine.scene.colmap import has_model as has_model_files
from octasplat.engine.scene.near import NearZones, nearest_distances
from octasplat.engine.scene.seen import SeenSpace
from octasplat.engine.scene.views_file import ViewsRecord, read_views, write_views
from octasplat.engine.shading.protocol import ShadingModel
from octasplat.engine.stages import StageClock, stage
from octasplat.engine.threads import use_threads
from octasplat.engine.trace.protocol import Tracer
from octasplat.engine.train.batches import BatchSource
from octasplat.engine.train.checkpoint import newest_state
from octasplat.engine.train.config import TrainConfig, iteration_count
from octasplat.engine.train.exposure_changes import with_exposure_decided
from octasplat.engine.train.fingerprint import run_fingerprint
from octasplat.engine.train.first_state import first_state
from octasplat.engine.train.floors import ScaleFloor
from octasplat.engine.train.shading import background_of, deferred_of, exposures_of
from octasplat.engine.train.shown import shown_share
from octasplat.engine.train.trainer import Trainer
from octasplat.engine.train.within import make_plan, read_plan, write_plan
from octasplat.engine.versions import versions
from octasplat.engine.writing import write_json

LEAST_REFLECTIVE = 0.01
"""Share of the surface that must reflect for materials and the environment to be more than guesses."""

Watcher = Callable[[int, Dataset, Tracer, ShadingModel], None]
"""Shown a training between two iterations: iterations done, photographs, tracer and shading as they are."""


def reconstruct(
    scene: Path,
    output: Path,
    config: ReconstructionConfig,
    *,
    resume: bool = False,
    threads: int = 0,
    listener: Listener = lambda _event: None,
    should_stop: Callable[[], bool] = lambda: False,
    watch: Watcher | None = None,
) -> Path:
    """Reconstruct ``scene`` into the folder ``output`` and return it.

    The folder then holds ``scene.ply``, the meshes, ``metrics.json``, ``report.html``, ``renders/``,
    ``checkpoints/``, ``config.json``, ``held_out.json``, ``views.json`` and ``events.jsonl``.

    Args:
        scene: folder with photographs and a COLMAP model, see :meth:`octasplat.engine.scene.Dataset.open`;
            one of photographs alone, if ``config`` says that poses are to be found, which then are in
            ``poses/``.
        output: a folder that does not exist, is empty, or holds the same run if ``resume``.
        config: all settings.
        resume: go on with the run that is in ``output``; only ``exports`` may then be others than the run's.
        threads: for everything; 0 means all cores.
        listener: hears the events that also go to ``events.jsonl``.
        should_stop: asked now and then; True stops the run after a checkpoint.
        watch: shown the training after each iteration; it must change nothing.

    Raises:
        DatasetError: the photographs or the model cannot be used, or no poses be found.
        PosesCrashed: COLMAP died.
        OutputError: ``output`` holds something else or cannot be written.
        ConfigError: settings that the photographs rule out or, with ``resume``, other ones than the run's.
        SceneFileError: a file of ``exports`` could not be written on this machine; told before the training.
        CheckpointError: with ``resume``, other photographs or another model than the run's.
        TrainingFailure: training collapsed.
        ExportFailed: some of ``exports`` could not be written; all the rest is there.
        Cancelled: stopped as asked.
    """
    if not (output / SCENE).exists():
        check_writable(config.exports)
    began = time.perf_counter()
    use_threads(threads)
    is_made = not output.exists()
    is_new = _claim_output(scene, output, config, resume)
    recorded = read_views(output / VIEWS) if (output / VIEWS).exists() else None
    events = JsonLinesListener(output / EVENTS, hold=recorded is not None)

    def accept(found: ViewsRecord) -> None:
        """Go on with the photographs of the run only; until here nothing has been written."""
        if recorded is not None and (difference := recorded.difference(found)) is not None:
            raise CheckpointError(
                f"{output} was made from other photographs or another model than {scene} holds "
                f"({difference}); name the folder that it was made from, or another output folder."
            )
        events.release()

    tell = broadcast([events, listener])
    try:
        try:
            find_missing_poses(scene, output, config, threads, tell, should_stop)
            accepted = None if recorded is None else accept
            dataset = _load(scene, output, config, threads, tell, accepted)
            if recorded is None:
                if place_misfits(dataset, output, config, threads, tell, should_stop):
                    dataset = _load(scene, output, config, threads, tell, accepted)
                if free_lenses(dataset, output, config, tell, should_stop):
                    dataset = _load(scene, output, config, threads, tell, accepted)
                write_views(output / VIEWS, dataset.record)
            write_held_out(output / HELD_OUT, [dataset.views[i].name for i in dataset.test_indices])
            if run_scene(output) != scene.resolve() or read_config(output / CONFIG) != config:
                # The photographs have moved, or other files are wanted.
                _write_config(scene, output, config)
        except (DatasetError, ConfigError):
            if is_new:  # so that the corrected command finds the folder free
                (output / CONFIG).unlink()
                (output / EVENTS).unlink()
                shutil.rmtree(output / POSES, ignore_errors=True)
                if is_made:
                    with suppress(OSError):  # it holds something
                        output.rmdir()
            raise
        if not (output / SCENE).exists():
            steps = 0
            if not config.minutes:
                steps = iteration_count(config.train, dataset.train_pixel_count, shown_share(dataset))
            with stage("train", tell, steps) as clock:
                gaussians = _train(dataset, output, config, threads, tell, should_stop, clock, watch)
                write_gaussian_ply(
                    gaussians,
                    output / SCENE,
                    facts=SceneFacts(
                        near_world=dataset.near_world,
                        pixel_rad=trained_pixel_rad(dataset.viewpoints),
                        turned_beyond=config.train.trace.turned_beyond,
                    ),
                )
        unmeasured: Exception | None = None
        if not (output / "metrics.json").exists() or not (output / "report.html").exists():
            try:
                with stage("evaluate", tell, len(dataset.test_indices)):
                    measure_run(dataset, output, config, threads, tell)
            except Cancelled:
                raise
            except Exception as error:  # noqa: BLE001 - raised below, after the files are written
                unmeasured = error
        with stage("export", tell, len(config.exports)):
            failed = _export(output, config, threads, tell)
        if unmeasured is not None:
            raise unmeasured
        if failed is not None:
            raise ExportFailed(f"{failed} Everything else is there.")
        dataset.release_pages()
        outputs = tuple(
            sorted(p.name for p in output.iterdir() if p.name != CACHE and not p.name.startswith("."))
        )
        tell(RunFinished(outputs, time.perf_counter() - began))
    finally:
        events.close()
    return output


def _claim_output(scene: Path, output: Path, config: ReconstructionConfig, resume: bool) -> bool:
    """Create the folder and its ``config.json``, or make sure that it is the run to go on with.

    Returns:
        Whether the run is new.
    """
    if output.exists() and not output.is_dir():
        raise OutputError(f"{output} is a file; name a folder for the results.")
    if (output / CONFIG).exists():
        if not resume:
            raise OutputError(
                f"{output} already holds a run; add --resume to go on with it, or name another folder."
            )
        has_model = has_model_files(scene)
        before = read_config(output / CONFIG).model_copy(update={"exports": config.exports})
        if before.with_poses_decided(has_model) != config.with_poses_decided(has_model):
            raise ConfigError(
                f"{output / CONFIG} has other settings than this command; repeat the settings of the run, "
                "or name another folder."
            )
        return False
    if output.is_dir() and any(not path.name.startswith(".") for path in output.iterdir()):
        raise OutputError(f"{output} is not empty and holds no run; name an empty or a new folder.")
    try:
        output.mkdir(parents=True, exist_ok=True)
        for left in output.glob(".*.partial.*"):  # by a run that was killed while it wrote
            left.unlink()
        _write_config(scene, output, config)
    except OSError as error:
        raise OutputError(
            f"{output} cannot be written to ({error.strerror or error}); name another folder."
        ) from None
    return True


def _write_config(scene: Path, output: Path, config: ReconstructionConfig) -> None:
    content = {
        "scene": str(scene.resolve()),
        "reconstruction": config.model_dump(mode="json"),
        "versions": versions(),
    }
    write_json(output / CONFIG, content)


def _load(
    scene: Path,
    output: Path,
    config: ReconstructionConfig,
    threads: int,
    tell: Listener,
    accept: Callable[[ViewsRecord], None] | None,
) -> Dataset:
    with stage("load", tell):
        dataset = open_photographs(
            scene, output, config, threads, tell, model_folder=found_model(output), accept=accept
        )
        BatchSource(dataset, config.train)  # refuses settings that do not suit the photographs
    return dataset


def _train(
    dataset: Dataset,
    output: Path,
    settings: ReconstructionConfig,
    threads: int,
    tell: Listener,
    should_stop: Callable[[], bool],
    clock: StageClock,
    watch: Watcher | None,
) -> FlatGaussians:
    folder = output / CHECKPOINTS
    config = _planned(dataset, output, settings, threads, should_stop, clock)
    config, exposure_changes = with_exposure_decided(config, dataset)
    fingerprint = run_fingerprint(dataset, config)
    state = newest_state(folder, fingerprint, tell)
    if state is None:
        state = first_state(dataset, config, threads=use_threads(threads))
        if exposure_changes is not None:
            tell(Warned(f"{exposure_changes} That is learnt; exposure=false leaves it out."))
        state.seconds = clock.seconds()
    else:
        clock.add(state.seconds)
    nearest_world = nearest_distances(dataset.viewpoints, dataset.points)
    zones = NearZones.of(dataset.viewpoints, config.near_share * nearest_world, dataset.train_indices)
    seen = SeenSpace.of(dataset.viewpoints, dataset.train_indices)
    trainer = Trainer(
        dataset,
        config,
        state,
        folder=folder,
        fingerprint=fingerprint,
        listener=tell,
        threads=threads,
        should_stop=should_stop,
        scale_floor=_scale_floor(dataset, config),
        near_zones=zones if config.near_share > 0 else None,
        seen_space=seen if config.materials.clears_unseen else None,
        onlooker=None
        if watch is None
        else lambda done, tracer: watch(done, dataset, tracer, trainer.shading),
    )
    gaussians = trainer.run()
    if (deferred := deferred_of(trainer.shading)) is not None:
        write_environment(output / ENVIRONMENT, deferred.light.radiance_linear)
        if reflective_share(gaussians) < LEAST_REFLECTIVE:
            tell(
                Warned(
                    "Nothing was seen that reflects its surroundings clearly: metallic, roughness and the "
                    "environment are guesses, and relighting will show it."
                )
            )
    if (background := background_of(trainer.shading)) is not None:
        write_background(output / BACKGROUND, background.rgb_srgb)
    record: dict[str, object] = {"seconds": clock.stop(), "iterations": trainer.state.iteration}
    if trainer.schedule.hastened_after is not None:
        record["planned_iterations"] = trainer.schedule.planned
    if trainer.views is not None:
        record["training_views"] = trainer.views.as_dict()
    if trainer.poses is not None:
        record["poses"] = trainer.poses.as_dict()
    if (exposures := exposures_of(trainer.shading)) is not None:
        record["exposures"] = exposures.as_dict([view.name for view in dataset.views])
    if config.near_share > 0:
        record["taken_near"] = trainer.state.taken_near
    distances = dict(zip((view.name for view in dataset.views), nearest_world.tolist(), strict=True))
    record["nearest_world"] = {name: distance for name, distance in distances.items() if distance > 0}
    write_json(output / TRAINING, record)
    return gaussians


def _scale_floor(dataset: Dataset, config: TrainConfig) -> ScaleFloor | None:
    if config.min_scale_px == 0:
        return None
    pixel_rad = trained_pixel_rad(dataset.viewpoints)
    origins = np.stack([dataset.views[i].origin_world for i in dataset.train_indices.tolist()])
    return ScaleFloor(origins, config.min_scale_px * pixel_rad)


def _planned(
    dataset: Dataset,
    output: Path,
    settings: ReconstructionConfig,
    threads: int,
    should_stop: Callable[[], bool],
    clock: StageClock,
) -> TrainConfig:
    """The settings of the training; those that the time decides are written down the first time."""
    config = settings.train
    if settings.minutes is None:
        return config
    if not (output / PLAN).exists():
        first = first_state(dataset, config, threads=use_threads(threads)).gaussians
        left = 60 * settings.minutes - 2 * clock.seconds()  # the first Gaussians are made once more
        plan = make_plan(dataset, config, first, seconds=left, threads=threads, should_stop=should_stop)
        write_plan(output / PLAN, plan)
    return read_plan(output / PLAN).applied(config)


def _export(output: Path, config: ReconstructionConfig, threads: int, tell: Listener) -> str | None:
    """Write what is missing; returns what could not be written and why."""
    missing = [name for name in config.exports if not (output / name).exists()]
    if not missing:
        return None
    gaussians, _ = read_gaussian_ply(output / SCENE)
    if (left_out := not_exported(output)) is not None:
        tell(Warned(left_out))
    options = ExportOptions(q=config.train.trace.q, facts=read_facts(output))
    plain = PlainScene(
        gaussians,
        output,
        threads=threads,
        on_pass=lambda _done, _total: tell(StageProgress("export", 0, len(missing))),
        on_unknown=lambda text: tell(Warned(text)),
    )
    targets = [output / name for name in missing]
    for lost in export_losses(gaussians, known_targets(targets)):
        tell(Warned(lost))
    _, failed = export_files(
        targets,
        lambda exporter: (gaussians if exporter.holds_harmonics else plain.gaussians, options),
        on_done=lambda done: tell(StageProgress("export", done, len(missing))),
    )
    return failed

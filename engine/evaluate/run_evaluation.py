"""The scene of a run measured: on the photographs that it held out, or on those of another folder."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from octasplat.engine.core.errors import ConfigError, OutputError
from octasplat.engine.core.events import EventListener, PhaseProgress, Warned
from octasplat.engine.core.georeference import GEOREFERENCE_FILE, read_georeference
from octasplat.engine.core.progress import counted_phase, phase
from octasplat.engine.core.threads import use_threads
from octasplat.engine.core.versions import package_versions
from octasplat.engine.core.writing import write_json
from octasplat.engine.dataset import Dataset
from octasplat.engine.dataset.views_file import read_views, write_views
from octasplat.engine.evaluate.ground_truth import GroundTruth, find_ground_truth
from octasplat.engine.evaluate.held_out import METRICS, evaluate_held_out
from octasplat.engine.evaluate.multiscale import measure_multiscale
from octasplat.engine.evaluate.other_world import OtherWorldCheck
from octasplat.engine.files import read_metadata
from octasplat.engine.files.gaussian_ply import read_gaussian_ply
from octasplat.engine.gaussians.materials import has_materials
from octasplat.engine.pathtracing.environment import EnvironmentMap, environment_frame
from octasplat.engine.poses.found_models import other_models, read_pose_record
from octasplat.engine.render.environment_files import read_environment
from octasplat.engine.render.renderer import background_color
from octasplat.engine.runs.config import ReconstructionConfig, read_config
from octasplat.engine.runs.finished_shading import finished_shading, shown_options
from octasplat.engine.runs.run_dataset import open_run_dataset
from octasplat.engine.runs.run_folder import (
    CACHE,
    CONFIG,
    EVALUATIONS,
    POSES,
    SCENE,
    TRAINING,
    VIEWS,
    found_model_folder,
    has_photographs_of_run,
    other_poses_error,
    photographs_folder,
    run_environment,
    run_extent,
)
from octasplat.engine.trace.factory import make_tracer

SCALES = "scales.json"
ESTIMATED_EXPOSURE_NOTE = (
    "held-out views are shown as exposed as their brightness and the views beside them suggest"
)
TRAINING_KEYS = ("planned_iterations", "training_views", "taken_near")
RAYS_ACROSS = (1, 2, 4)
"""Rays across a pixel with which smaller sizes are measured."""


def evaluate(
    output: Path,
    *,
    scene: Path | None = None,
    on: Path | None = None,
    background: Literal["black", "white"] | None = None,
    threads: int = 0,
    progress: EventListener = lambda _event: None,
) -> Path:
    """Measure the scene of a finished run again and write its metrics, renders and report anew.

    Args:
        output: folder of the run.
        scene: where the photographs are now; None takes the folder that the run was made from.
        on: other photographs of the same scene in the same world, with a COLMAP model of their own; all of
            them are measured, into a folder of their name in ``output / "on"``, and the run's own results
            stay as they are.
        background: behind the scene; None takes that of the run.
        threads: for everything; 0 means all cores.
        progress: receives the progress events.

    Returns:
        The path of ``metrics.json``.

    Raises:
        ConfigError: ``output`` is no run.
        DatasetError: the photographs cannot be used.
        OutputError: there is no scene yet, or other photographs of that name were measured before.
    """
    use_threads(threads)
    config = _finished_config(output, background)
    if on is not None:
        return _evaluate_on(on, output, config, threads, progress)
    dataset = _open_photographs(output, config, scene, threads, progress)
    _check_coordinates(output, dataset, photographs_folder(output, scene))
    if (output / VIEWS).exists():
        difference = read_views(output / VIEWS).difference(dataset.views_record)
        if difference is not None:
            progress(Warned(f"{output} was made from other photographs or another model ({difference})."))
    with phase("evaluate", progress, len(dataset.test_indices)):
        measure_run(dataset, output, config, threads, progress)
    return output / "metrics.json"


def evaluate_scales(
    output: Path,
    scales: Sequence[int],
    *,
    scene: Path | None = None,
    background: Literal["black", "white"] | None = None,
    threads: int = 0,
    listener: EventListener = lambda _event: None,
) -> dict[str, dict[str, float]]:
    """Measure a finished run at smaller sizes and write ``scales.json``.

    See :mod:`octasplat.engine.evaluate.multiscale`.

    Args:
        output: folder of the run.
        scales: by how much pixels are larger than those of the training.
        scene: where the photographs are now; None takes the folder that the run was made from.
        background: behind the scene; None takes that of the run.
        threads: for everything; 0 means all cores.
        listener: receives the progress events.

    Returns:
        Mean PSNR of the held-out views, by scale and by rays per pixel.

    Raises:
        ConfigError: ``output`` is no run.
        DatasetError: the photographs cannot be used.
        OutputError: there is no scene yet.
    """
    use_threads(threads)
    config = _finished_config(output, background)
    dataset = _open_photographs(output, config, scene, threads, listener)
    _check_coordinates(output, dataset, photographs_folder(output, scene))
    gaussians, _ = read_gaussian_ply(output / SCENE, folder=output)
    extent = run_extent(output, dataset.extent)
    shading = finished_shading(
        output, shown_options(config.train, gaussians), extent, [view.name for view in dataset.views],
        scene=gaussians, trace=config.train.trace,
    )  # fmt: skip
    tracer = make_tracer(config.train.trace, threads=threads)
    tracer.build(gaussians, shading.features(gaussians))
    with counted_phase("evaluate", listener, len(dataset.test_indices)) as progress:
        found = measure_multiscale(
            dataset=dataset,
            tracer=tracer,
            shading=shading,
            background_srgb=background_color(config.evaluation_background),
            scales=scales,
            rays_across=RAYS_ACROSS,
            on_view=lambda done: progress(done, len(dataset.test_indices)),
        )
    write_json(output / SCALES, found)
    return found


def _finished_config(output: Path, background: Literal["black", "white"] | None) -> ReconstructionConfig:
    """Return the settings of a run that has a scene, to be measured with that background."""
    config = read_config(output / CONFIG)
    if background is not None:
        config = config.model_copy(update={"evaluation_background": background})
    if not (output / SCENE).exists():
        raise OutputError(
            f"{output} holds no {SCENE} yet; finish the run with: octasplat reconstruct --resume."
        )
    return config


def _open_photographs(
    output: Path, config: ReconstructionConfig, scene: Path | None, threads: int, progress: EventListener
) -> Dataset:
    return open_run_dataset(
        photographs_folder(output, scene),
        output,
        config,
        threads,
        progress,
        model_folder=found_model_folder(output),
    )


def _check_coordinates(output: Path, dataset: Dataset, folder: Path) -> None:
    """Refuse photographs whose model stands in another world than the scene, as after a transform.

    Raises:
        DatasetError: it does.
    """
    if (output / VIEWS).exists() and read_views(output / VIEWS).is_of_another_world(dataset.views_record):
        raise other_poses_error(output, folder)


def measure_run(
    dataset: Dataset,
    output: Path,
    config: ReconstructionConfig,
    threads: int,
    progress: EventListener,
    into: Path | None = None,
    check: OtherWorldCheck | None = None,
    is_own: bool = True,
) -> None:
    """Measure the scene of ``output``; the results go ``into`` another folder or that one.

    A ``check`` warns of photographs of another world. Those that are the run's own (``is_own``) are shown at
    the exposures that it has learnt.
    """
    truth = _find_ground_truth(dataset, progress, needed=into is not None)
    gaussians, _ = read_gaussian_ply(output / SCENE, folder=output)
    extent = run_extent(output, dataset.extent)
    environment = _read_run_environment(output, config.train.materials.up_world)
    relighter = None
    if truth is not None and truth.relit_folders and environment is not None and has_materials(gaussians):
        from octasplat.engine.pathtracing.relighting.split_sum_relighter import SplitSumRelighter

        relighter = SplitSumRelighter(
            gaussians, config.train.trace, config.train.materials, extent_world=extent, threads=threads
        )
    training = json.loads((output / TRAINING).read_text(encoding="utf-8"))
    evaluate_held_out(
        dataset,
        gaussians,
        into or output,
        settings=config.train.trace,
        shading=finished_shading(
            output,
            shown_options(config.train, gaussians),
            extent,
            [view.name for view in dataset.views] if is_own else (),
            scene=gaussians,
            trace=config.train.trace,
        ),
        background=config.evaluation_background,
        run={
            "gaussians": len(gaussians),
            "iterations": training["iterations"],
            "seconds": training["seconds"],
            "seed": config.train.seed,
            "resolution": {"max_side": config.max_side},
            "background": config.evaluation_background,
            "versions": package_versions(),
            **{key: training[key] for key in TRAINING_KEYS if key in training},
            **_pose_facts(output),
            **_place_facts(output),
            **({"exposure": ESTIMATED_EXPOSURE_NOTE} if "exposures" in training and is_own else {}),
        },
        config=json.loads((output / CONFIG).read_text(encoding="utf-8")),
        threads=threads,
        progress=progress,
        truth=truth,
        environment=environment,
        relighter=relighter,
        check=check,
        are_held_out=into is None,
    )


def _find_ground_truth(dataset: Dataset, progress: EventListener, *, needed: bool) -> GroundTruth | None:
    """Return the ground truth of the photographs; an invalid file is a warning, or an error if ``needed``."""
    try:
        return find_ground_truth(dataset.root)
    except ConfigError as error:
        if needed:
            raise
        progress(Warned(f"{error} Nothing is measured against it."))
        return None


def _read_run_environment(output: Path, up_world: tuple[float, float, float]) -> EnvironmentMap | None:
    """Return the environment map that a run with materials has learnt."""
    if not run_environment(output).exists():
        return None
    up = np.array(up_world, np.float64)
    return EnvironmentMap(read_environment(run_environment(output)), environment_frame(up))


def _evaluate_on(
    on: Path, output: Path, config: ReconstructionConfig, threads: int, progress: EventListener
) -> Path:
    """Measure other photographs into a folder of their own."""
    name = on.resolve().name
    into = output / EVALUATIONS / name
    find_ground_truth(on)  # complains before anything is written
    is_own = has_photographs_of_run(output, on)  # whose poses may have been found or mended
    dataset = Dataset.open_for_evaluation(
        on,
        output / CACHE / EVALUATIONS / name,
        near_world=read_metadata(output).near_world,
        origin_world=read_metadata(output).origin_world,
        max_side=config.max_side,
        masks=config.masks,
        model_folder=found_model_folder(output) if is_own else None,
        model=config.model if is_own else None,
        threads=threads,
        progress=lambda done, total: progress(PhaseProgress("load", done, total)),
    )
    for warning in dataset.warnings:
        progress(Warned(warning))
    _check_coordinates(output, dataset, on)
    if (into / VIEWS).exists():
        difference = read_views(into / VIEWS).difference(dataset.views_record)
        if difference is not None:
            raise OutputError(
                f"{into} holds the measures of other photographs than {on} has ({difference}); delete or "
                "rename that folder."
            )
    with phase("evaluate", progress, len(dataset.test_indices)):
        origin = read_metadata(output).origin_world
        run_views = read_views(output / VIEWS).about(origin) if (output / VIEWS).exists() else None
        # A later evaluation tells by it whether the folder has measures of the same photographs.
        write_views(into / VIEWS, dataset.views_record)
        measure_run(
            dataset=dataset,
            output=output,
            config=config,
            threads=threads,
            progress=progress,
            into=into,
            check=OtherWorldCheck(on, run_views, _own_psnr(output)),
            is_own=is_own,
        )
    return into / "metrics.json"


def _own_psnr(output: Path) -> float | None:
    """Return the mean PSNR of the views that a run held out, in dB, or None where none was measured."""
    try:
        value = json.loads((output / METRICS).read_text(encoding="utf-8"))["mean"].get("psnr")
    except (OSError, ValueError, KeyError):
        return None
    return None if value is None else float(value)


def _pose_facts(output: Path) -> dict[str, object]:
    """Return how many photographs have poses, how many were corrected, and whether lenses were adjusted.

    Also which models were found beside the one of the run, and how many photographs each has that this lacks.
    """
    record = read_pose_record(output / POSES)
    known: dict[str, object]
    known = {name: record[name] for name in ("placed", "photographs", "moved", "lenses") if name in record}
    if others := other_models(output / POSES):
        known["other_models"] = [
            {"model": f"{POSES}/{other.number}", "placed": other.placed, "not_in_taken": len(other.names)}
            for other in others
        ]
    return {"poses": known} if known else {}


def _place_facts(output: Path) -> dict[str, object]:
    """Return the georeference of a run, where it has one."""
    found = read_georeference(output / GEOREFERENCE_FILE)
    return {} if found is None else {"georeference": found.model_dump(mode="json")}

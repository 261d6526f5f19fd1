"""Poses of a run: estimated where there are none, and checked where they are given."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Int64

from octasplat.engine.core import versions
from octasplat.engine.core.errors import CancelledError, ColmapCrashError, DatasetError
from octasplat.engine.core.events import EventListener, PhaseProgress, Warned
from octasplat.engine.core.progress import phase
from octasplat.engine.dataset import Dataset, split_views
from octasplat.engine.dataset.model_sources import find_model, has_model
from octasplat.engine.dataset.photograph_files import image_folder
from octasplat.engine.poses.config import GivenModel
from octasplat.engine.poses.find_poses import (
    adjust_principal_points,
    find_poses,
    repair_poses,
)
from octasplat.engine.poses.found_models import (
    choose_found_model,
    describe_other_models,
    parse_found_model,
    read_pose_record,
)
from octasplat.engine.poses.lens_check import needs_per_view_principal_points
from octasplat.engine.poses.photographs import photographs_of_scene
from octasplat.engine.runs.config import ReconstructionConfig
from octasplat.engine.runs.run_folder import POSES, START, found_model_folder
from octasplat.engine.train.config import Background, iteration_count
from octasplat.engine.train.loop.trial_training import COARSE_ITERATIONS, train_coarse_scene
from octasplat.engine.train.sampling.batches import evaluation_background
from octasplat.engine.train.views.outlier_views import MIN_VIEWS, find_misplaced_views

CHECKED_FROM, CHECKED_FROM_MINUTES = 1000, 10.0
"""Given poses are checked before a training of so many iterations, or of so many minutes."""


def find_missing_poses(
    scene: Path,
    output: Path,
    config: ReconstructionConfig,
    threads: int,
    progress: EventListener,
    should_stop: Callable[[], bool],
) -> None:
    """Estimate the poses of a run's photographs, if requested and not done yet.

    Of several models that are found, the one that the configuration names is taken, else that of most
    photographs; a run that begins with a scene keeps the model of that one.

    Raises:
        DatasetError: there are no photographs, their poses cannot be found, or the model that is named is not
            there.
        ColmapCrashError: COLMAP died.
        CancelledError: stopped as asked.
    """
    if config.with_poses_decided(has_model(scene)).poses == "given":
        return
    names = photographs_of_scene(scene)
    if not (output / POSES).is_dir():  # a search that has begun was let through before
        _refuse_before_search(scene, names, config)
    find_poses(
        image_folder(scene),
        output / POSES,
        names=names,
        threads=threads,
        progress=progress,
        should_stop=should_stop,
    )
    named = parse_found_model(config.model)
    if (output / START).is_dir():
        if named is not None and named[1] != read_pose_record(output / POSES).get("number", 0):
            raise DatasetError(
                f"The scene that this run begins with stands in the world of another model than "
                f"{config.model}; leave --model or --start-from out."
            )
    else:
        choose_found_model(output / POSES, 0 if named is None else named[1])


def tell_of_former_poses(output: Path, progress: EventListener) -> None:
    """Tell where the poses that a new run goes on with were found by a version with other results.

    Those that do not state theirs may be of any version before, two of which have changed the mapping.
    """
    record = read_pose_record(output / POSES)
    is_stated = versions.STATED in record
    if "photographs_sha256" in record and not (is_stated and versions.has_same_results(record)):
        progress(
            Warned(
                f"The poses in {output / POSES} were found by a version with other results; they are taken "
                "as they are, and found anew where that folder is removed."
            )
        )


def warn_of_other_models(output: Path, progress: EventListener) -> None:
    """Tell of the models that were found beside the one that a run takes."""
    if (sentence := describe_other_models(output / POSES)) is not None:
        progress(Warned(sentence))


def _refuse_before_search(scene: Path, names: Sequence[str], config: ReconstructionConfig) -> None:
    """Refuse photographs and settings that the dataset would refuse after the search, which takes long."""
    split_views(
        names,
        config.test_every,
        config.held_out,
        source_name="photographs",
        burst_length=config.burst_length,
    )
    if config.masks == "alpha" and not (scene / "masks").is_dir():
        raise DatasetError(
            f"Masks are to be the alpha, but there is no folder {scene / 'masks'}; put them there (as "
            f"{names[0]}.png) or leave --masks alpha out."
        )


def repair_run_poses(
    dataset: Dataset,
    output: Path,
    config: ReconstructionConfig,
    threads: int,
    progress: EventListener,
    should_stop: Callable[[], bool],
) -> bool:
    """Correct wrong poses of a given model; returns whether any was corrected.

    Photographs that a short training shows to be in doubt (stage ``check``) are matched with the others;
    those that are moved have their poses from the model in the run's ``poses/`` from then on.

    Raises:
        CancelledError: stopped as asked.
    """
    is_long = _is_long(dataset, config)
    # poses that were found are not given ones
    if not (config.train.repair_poses and is_long) or found_model_folder(output) is not None:
        return False
    with phase("check", progress, COARSE_ITERATIONS):
        doubtful = _find_misplaced_views(
            dataset=dataset,
            background=config.train.background,
            seed=config.train.seed,
            threads=threads,
            progress=progress,
            should_stop=should_stop,
        )
    if len(doubtful) == 0:
        return False
    images = image_folder(dataset.root)
    given = GivenModel(
        model=find_model(dataset.root, config.model),
        names=tuple(view.name for view in dataset.views),
        doubtful=tuple(doubtful.tolist()),
    )
    files = [view.image_path.relative_to(images).as_posix() for view in dataset.views]
    names = [dataset.views[k].name for k in doubtful.tolist()]
    try:
        moved = repair_poses(
            images, files, given, output / POSES, threads=threads, progress=progress, should_stop=should_stop
        )
    except (DatasetError, ColmapCrashError) as error:
        progress(Warned(f"The poses of {', '.join(names)} are in doubt, and stay as they are: {error}"))
        return False
    if moved:
        which = "This photograph" if len(moved) == 1 else f"These {len(moved)} photographs"
        progress(
            Warned(
                f"{which} did not stand where matches with the others say: {', '.join(moved)}. The training "
                "takes the poses that follow from the matches; repair_poses=false leaves given poses alone."
            )
        )
    return bool(moved)


def _find_misplaced_views(
    dataset: Dataset,
    background: Background,
    seed: int,
    threads: int,
    progress: EventListener,
    should_stop: Callable[[], bool],
) -> Int64[np.ndarray, " d"]:
    """Return the views whose poses a short training puts in doubt, in order."""
    if len(dataset.train_indices) < MIN_VIEWS:
        return np.zeros(0, np.int64)
    # a few seconds do not learn a map: behind everything is what the photographs' alpha says
    if background == "learnt":
        background = "auto"
    try:
        tracer, shading = train_coarse_scene(
            dataset,
            background=background,
            seed=seed,
            threads=threads,
            should_stop=should_stop,
            progress=lambda done: progress(PhaseProgress("check", done, COARSE_ITERATIONS)),
        )
    except CancelledError:
        raise CancelledError(
            "Stopped before the training, while looking for photographs in the wrong place; the same command "
            "with --resume goes on."
        ) from None
    return find_misplaced_views(dataset, evaluation_background(background), tracer, shading)


def estimate_principal_points(
    dataset: Dataset,
    output: Path,
    config: ReconstructionConfig,
    progress: EventListener,
    should_stop: Callable[[], bool],
) -> bool:
    """Estimate a principal point for each photograph if the lens moved; returns whether it did.

    The model is then the one in the run's ``poses/``; see :mod:`octasplat.engine.poses.lens_check` for what
    is asked first, which takes no time worth a stage.

    Raises:
        CancelledError: stopped as asked.
    """
    if not (config.train.per_view_principal_point and _is_long(dataset, config)):
        return False
    if "lenses" in read_pose_record(output / POSES):  # was asked and answered by an earlier start
        return False
    if not needs_per_view_principal_points(dataset.viewpoints, dataset.points, dataset.observations):
        return False
    model = found_model_folder(output) or find_model(dataset.root, config.model)
    try:
        facts = adjust_principal_points(model, output / POSES, progress=progress, should_stop=should_stop)
    except (DatasetError, ColmapCrashError) as error:
        progress(Warned(f"The lens seems to have moved between the photographs, but stays as it is: {error}"))
        return False
    if facts is None:
        return False
    before, after = facts["reprojection_px_before"], facts["reprojection_px"]
    progress(
        Warned(
            "The lens moved between the photographs, as stabilised ones do: each has a principal point of "
            f"its own, {facts['shift_px_median']:.1f} px from the given one in the middle, and the sparse "
            f"points fit to {after:.2f} px instead of {before:.2f}; "
            f"per_view_principal_point=false leaves lenses alone."
        )
    )
    return True


def _is_long(dataset: Dataset, config: ReconstructionConfig) -> bool:
    if config.minutes is not None:
        return config.minutes >= CHECKED_FROM_MINUTES
    return iteration_count(config.train, dataset.train_pixel_count) >= CHECKED_FROM

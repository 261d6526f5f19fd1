"""Run folder: the names of its files, and the cameras of the run."""

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float

from octasplat.engine.core.errors import ConfigError, DatasetError
from octasplat.engine.core.local_origin import Origin
from octasplat.engine.dataset.camera_clearance import CameraClearance
from octasplat.engine.dataset.scene_split import SplitRule
from octasplat.engine.dataset.views_file import SplitViewpoints, read_views, scene_viewpoints
from octasplat.engine.files import read_metadata
from octasplat.engine.runs.config import ReconstructionConfig, read_config

if TYPE_CHECKING:
    from octasplat.engine.shading.exposure import ExposuresByName

CONFIG, EVENTS, HELD_OUT, SCENE, TRAINING, VIEWS = (
    "config.json", "events.jsonl", "held_out.json", "scene.ply", "training.json", "views.json",
)  # fmt: skip
METRICS, REPORT = "metrics.json", "report.html"
EDITS = "edits.json"
"""What was changed since the training, first to last."""
CHECKPOINTS, CACHE, POSES = "checkpoints", "cache", "poses"
PLAN = "plan.json"
BLOCKS, START = "blocks", "start"
ENVIRONMENT_HDR, ENVIRONMENT_EXR = "environment.hdr", "environment.exr"
"""The learnt light, for programs that show it and as it was learnt: an HDR has one exponent for all channels
of a pixel, so that a dark channel beside a bright one is coarse."""
BACKGROUND = "background.exr"
RESIDUAL = "residual.npz"
"""Harmonics of the residual colors of a run with materials, and positions, row by row as in its scene."""
RESIDUAL_ITERATIONS = "residual_iterations"
"""Key of the record of a training that has fitted residual colors."""
EVALUATIONS = "on"
"""Below it are the measures on photographs of other folders, a folder each."""
_COMPARED_PHOTOGRAPHS = 8
"""So many of a run, evenly by name, tell its photographs from others: hashing all may take long."""


def is_run(source: Path) -> bool:
    """Return whether ``source`` is a run folder, not a file or the folder of an unpacked SOG."""
    # an unpacked SOG is a folder with meta.json
    return source.is_dir() and not (source / "meta.json").exists()


def is_full_run(source: Path) -> bool:
    """Return whether ``source`` is a run folder, and not one that an edit has left with the scene alone."""
    return is_run(source) and ((source / CONFIG).exists() or not (source / SCENE).exists())


def dataset_folder_of_run(output: Path) -> Path:
    """Return the dataset folder that a run was trained on.

    Raises:
        ConfigError: ``output`` is no run.
    """
    try:
        return Path(json.loads((output / CONFIG).read_text(encoding="utf-8"))["scene"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(f"{output / CONFIG} cannot be read ({error}); name the folder of a run.") from None


def _was_moved(output: Path) -> bool:
    """Return whether the scene of a run was transformed, as its record of edits says."""
    try:
        edits = json.loads((output / EDITS).read_text(encoding="utf-8"))
        return any("world_map" in edit for edit in edits)
    except (OSError, ValueError, TypeError):
        return False


def photographs_folder(output: Path, scene: Path | None = None) -> Path:
    """Return the folder of a run's photographs: ``scene`` if given, else the recorded one.

    Raises:
        ConfigError: ``output`` is no run.
        DatasetError: they are not there any more, or were never on this machine.
    """
    if scene is not None:
        return scene
    noted = dataset_folder_of_run(output)
    if noted.is_absolute() and noted.is_dir():  # a downloaded run names a folder of another machine
        return noted
    if _was_moved(output):
        raise DatasetError(
            f"{output} was moved, and its photographs ({noted}) stand where they stood: measure the run that "
            "it was made of, or name photographs whose model was moved likewise with --dataset FOLDER."
        )
    raise DatasetError(
        f"The photographs that {output} was made from ({noted}) are not on this machine; "
        "say where they are with --dataset FOLDER."
    )


def run_viewpoints(
    output: Path, *, scene: Path | None = None, max_side: int | None = None
) -> SplitViewpoints:
    """Return the viewpoints of a run; the photographs themselves are not needed.

    Args:
        output: folder of the run.
        scene: photographs whose cameras to take instead of those that the run keeps.
        max_side: cap on the longer side of the views, px; None takes the run's.

    Raises:
        ConfigError: ``output`` is no run.
        DatasetError: the run keeps no cameras, as runs of old, and the photographs cannot be used; or they
            are the run's and stand in another world than its scene, as after a transform.
    """
    config = read_config(output / CONFIG)
    max_side = max_side or config.max_side
    if scene is None and (output / VIEWS).exists():  # no photographs are needed
        return read_views(output / VIEWS).viewpoints(max_side)
    from octasplat.engine.dataset.load import load_dataset_model  # here, as most runs keep their cameras

    folder = photographs_folder(output, scene)
    model_folder, model = model_of_photographs(output, folder, config)
    photographs = load_dataset_model(
        folder,
        max_side=max_side,
        model_folder=model_folder,
        model=model,
        origin_world=run_origin(output),
    )
    if (
        (output / VIEWS).exists()
        and read_views(output / VIEWS).has_other_poses(photographs.views)
        and has_photographs_of_run(output, folder)  # others of the same names may stand anywhere
    ):
        raise other_poses_error(output, folder)
    rule = SplitRule(
        config.test_every, config.held_out, config.burst_length, config.split, stored_split(output)
    )
    return scene_viewpoints(photographs, rule)


def other_poses_error(output: Path, folder: Path) -> DatasetError:
    """Return what to say of photographs of a run whose model stands in another world than its scene."""
    return DatasetError(
        f"The photographs in {folder} have other poses than the scene of {output} was made or moved with; "
        "name a folder whose model stands in the same world."
    )


def stored_split(output: Path) -> dict[str, bool] | None:
    """Return whether each view of a run is held out; None before the run has opened its photographs."""
    if not (output / VIEWS).exists():
        return None
    return {view.name: view.held_out for view in read_views(output / VIEWS).views}


def run_origin(output: Path) -> Origin | None:
    """Return the local origin of a run's scene, see :mod:`octasplat.engine.core.local_origin`.

    None before the run has opened its photographs; zeros where coordinates are not large, and of runs of old.
    """
    if (output / SCENE).exists():
        return read_metadata(output / SCENE).origin_world
    return read_views(output / VIEWS).origin_world if (output / VIEWS).exists() else None


def run_extent(output: Path, other: float) -> float:
    """Return the scene extent that a run was trained with; ``other`` of a run of old, which keeps none."""
    return read_views(output / VIEWS).extent_world if (output / VIEWS).exists() else other


def run_min_view_distance(output: Path, viewpoints: SplitViewpoints) -> float:
    """Return the distance from a camera at which anything of a run's scene is seen, as in its training.

    Args:
        output: folder of the run.
        viewpoints: of the run; they stand in where its scene does not say, as scenes of old.

    Raises:
        ConfigError: ``output`` is no run.
    """
    noted = read_metadata(output / SCENE).near_world if (output / SCENE).exists() else 0.0
    # scenes of old do not say
    return noted if noted > 0 else read_config(output / CONFIG).train.near * viewpoints.extent


def run_camera_clearance(output: Path, share: float) -> CameraClearance | None:
    """Return the free space around a run's cameras, see :mod:`octasplat.engine.dataset.camera_clearance`.

    Args:
        output: folder of the run.
        share: of the distance at which the sparse points around each camera begin.

    Returns:
        None where the run does not know these distances, as runs of old, or keeps no cameras.
    """
    try:
        known = json.loads((output / TRAINING).read_text(encoding="utf-8"))["nearest_world"]
        scene = read_views(output / VIEWS).viewpoints(None)
        radii = np.array([share * float(known.get(view.name, 0.0)) for view in scene.views])
    except (OSError, ValueError, KeyError, TypeError, AttributeError, ConfigError):
        return None
    return CameraClearance.from_views(scene, radii, scene.train_indices)


def run_seen_test(
    output: Path, min_views: int
) -> Callable[[Float[np.ndarray, "n 3"]], Bool[np.ndarray, " n"]] | None:
    """Return the test of which points lie in the images of at least so many training views of a run.

    None where the run keeps no cameras. A run of fewer views than ``min_views`` is asked for all of them.
    """
    try:
        scene = read_views(output / VIEWS).viewpoints(None)
    except (OSError, ConfigError):
        return None
    from octasplat.engine.dataset.view_frusta import ViewFrusta  # here, as it loads kernels

    frusta = ViewFrusta.from_views(scene, scene.train_indices)
    return partial(frusta.contains_often, count=min(min_views, len(frusta.views)))


def run_exposures(output: Path) -> "ExposuresByName | None":
    """Return the learnt exposures of a finished run by view name; None if it has none."""
    try:
        known: ExposuresByName | None = json.loads((output / TRAINING).read_text("utf-8")).get("exposures")
    except (OSError, ValueError, AttributeError):
        return None
    return known


def run_environment(output: Path) -> Path:
    """Return the file of the light that a run has learnt; runs of old have the HDR only, others none."""
    exact = output / ENVIRONMENT_EXR
    return exact if exact.exists() else output / ENVIRONMENT_HDR


def unexported_parts(output: Path) -> str | None:
    """Return a sentence on learnt parts of a run that scene files do not carry; None if there are none."""
    if not (output / CONFIG).exists() or read_config(output / CONFIG).train.background != "learnt":
        return None
    return (
        f"What is infinitely far away is a map of its own, {output / BACKGROUND}, and in no other file; "
        "give it to the program that shows them as its environment, with -y up."
    )


def found_model_folder(output: Path) -> Path | None:
    """Return the folder of the estimated poses of a run's photographs; None if poses were given."""
    for folder in (output / POSES, output / POSES / "sparse" / "0"):
        if any((folder / f"cameras{suffix}").is_file() for suffix in (".bin", ".txt")):
            return folder
    return None


def has_photographs_of_run(output: Path, folder: Path) -> bool:
    """Return whether a folder holds the photographs that a run was made from.

    False elsewhere than in the recorded folder, if the run keeps no views.

    Raises:
        ConfigError: ``output`` is no run.
    """
    # here, as this one alone reads photographs
    from octasplat.engine.dataset.image_names import match_image_names
    from octasplat.engine.dataset.photograph_files import image_folder, photographs_below
    from octasplat.engine.dataset.pixel_cache import file_sha256

    if folder.resolve() == dataset_folder_of_run(output):
        return True
    if not (output / VIEWS).exists():
        return False
    digests = {view.name: view.photograph_sha256 for view in read_views(output / VIEWS).views}
    names = sorted(digests)
    places = np.linspace(0, len(names) - 1, min(len(names), _COMPARED_PHOTOGRAPHS)).round().astype(np.int64)
    files = photographs_below(image_folder(folder))
    found = match_image_names(names, files.keys())
    return all(
        name in found and file_sha256(files[found[name]]) == digests[name]
        for name in (names[place] for place in places.tolist())
    )


def model_of_photographs(
    output: Path, folder: Path, config: ReconstructionConfig
) -> tuple[Path | None, str | None]:
    """Return the folder of found poses and the chosen model with which photographs are opened for a run.

    Other photographs than the run's stand where their own model says.

    Args:
        output: folder of the run.
        folder: of the photographs.
        config: of the run.

    Raises:
        ConfigError: ``output`` is no run.
    """
    from octasplat.engine.dataset.model_sources import has_model

    is_other = (output / VIEWS).exists() and has_model(folder) and not has_photographs_of_run(output, folder)
    return (None, None) if is_other else (found_model_folder(output), config.model)

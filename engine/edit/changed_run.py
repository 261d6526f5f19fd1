"""Folders of finished runs with a changed scene, without the measurements of the original."""

import json
import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from octasplat.engine.core.errors import OutputError
from octasplat.engine.core.georeference import GEOREFERENCE_FILE, is_similarity, write_georeference
from octasplat.engine.core.partial_folders import partial_folder
from octasplat.engine.core.writing import report_disk_full, write_json
from octasplat.engine.edit.run_transform import write_transformed_run_files
from octasplat.engine.files import read_metadata
from octasplat.engine.files.gaussian_ply import write_gaussian_ply
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.scene_metadata import SceneMetadata
from octasplat.engine.runs.run_folder import (
    BACKGROUND,
    CONFIG,
    EDITS,
    ENVIRONMENT_EXR,
    ENVIRONMENT_HDR,
    EVENTS,
    HELD_OUT,
    POSES,
    RESIDUAL,
    RESIDUAL_ITERATIONS,
    SCENE,
    TRAINING,
    VIEWS,
)

_COPIED_FILES = (CONFIG, EVENTS, HELD_OUT, VIEWS, ENVIRONMENT_HDR, ENVIRONMENT_EXR, BACKGROUND)
"""What is as true of the scene after it was changed where it stands."""
_LEFT_OUT = ("training_views", RESIDUAL_ITERATIONS)
"""Of the facts on a training: how well its scene showed the views that it was trained on, and what was fitted
to them in the end."""


def check_new_run(target: Path) -> None:
    """Check that a folder does not exist or is empty.

    Raises:
        OutputError: it is not.
    """
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise OutputError(f"{target} is there already; name a new folder.")


def write_edited_run(
    source: Path,
    gaussians: FlatGaussians,
    target: Path,
    edit_record: Mapping[str, object],
    *,
    facts: SceneMetadata | None = None,
    matrix: Float[np.ndarray, "4 4"] | None = None,
) -> tuple[str, ...]:
    """Write a run's folder with an edited scene, atomically.

    What was measured, rendered and exported of the run does not come along, nor do checkpoints. Of a scene
    that was moved the cameras and the learnt light are moved along, or left out where that cannot be.

    Args:
        source: folder of the run.
        gaussians: the Gaussians after the edit.
        target: a folder that does not exist or is empty.
        edit_record: description of the edit, added to ``edits.json``.
        facts: metadata of the edited scene as a whole; None takes that of the run's.
        matrix: affine map from the run's world to the edited scene's; None if the world frame is unchanged.

    Returns:
        What of the run was left out or is not as exact as it was, a sentence each.

    Raises:
        OutputError: the folder is taken or cannot be written.
        DiskFullError: its disk is full.
    """
    check_new_run(target)
    metadata = facts or read_metadata(source)
    messages: tuple[str, ...] = ()
    try:
        with report_disk_full(target), partial_folder(target) as partial:
            if matrix is None:
                _copy(source, partial)
            elif is_similarity(matrix):
                messages = write_transformed_run_files(source, partial, matrix, metadata.origin_world)
            else:
                messages = (
                    "Cameras and learnt light cannot follow a scene that was mirrored, sheared or scaled "
                    f"unevenly, so {target} holds the scene alone.",
                )
            if metadata.georeference is not None:
                write_georeference(partial / GEOREFERENCE_FILE, metadata.georeference)
            write_gaussian_ply(gaussians, partial / SCENE, facts=replace(metadata, georeference=None))
            write_json(partial / EDITS, [*_read_edits(source), dict(edit_record)])
            partial.replace(target)
    except OSError as error:
        raise OutputError(f"{target} cannot be written ({error.strerror or error}).") from None
    return (*messages, *_residual_note(source))


def _residual_note(source: Path) -> list[str]:
    """Return a sentence on the residual colors that an edited run has not, if its source has them."""
    if not (source / TRAINING).exists():
        return []
    if RESIDUAL_ITERATIONS not in json.loads((source / TRAINING).read_text(encoding="utf-8")):
        return []
    return [
        f"The residual colors of {source} ({RESIDUAL}) are left out: pictures of the result show its "
        "materials in the learnt light alone."
    ]


def _copy(source: Path, target: Path) -> None:
    for name in _COPIED_FILES:
        if (source / name).exists():
            shutil.copyfile(source / name, target / name)
    if (source / TRAINING).exists():
        facts = json.loads((source / TRAINING).read_text(encoding="utf-8"))
        write_json(target / TRAINING, {name: fact for name, fact in facts.items() if name not in _LEFT_OUT})
    if (source / POSES).is_dir():
        # Not by copytree, which sets access and times as well, as a confined job may not.
        for path in (source / POSES).rglob("*"):
            if path.is_file():
                copy = target / path.relative_to(source)
                copy.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(path, copy)


def _read_edits(source: Path) -> list[object]:
    if not (source / EDITS).exists():
        return []
    try:
        found = json.loads((source / EDITS).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise OutputError(f"{source / EDITS} cannot be read ({error}); delete it.") from None
    return found if isinstance(found, list) else [found]

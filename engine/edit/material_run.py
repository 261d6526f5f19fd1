"""A finished run with other materials: the folder of a run again, but for what was measured of the first."""

import json
import os
import shutil
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from octasplat.engine.config import read_config
from octasplat.engine.edit.choices import MaterialChange, Selection
from octasplat.engine.edit.material_change import with_harmonics_following, with_materials
from octasplat.engine.errors import ConfigError, OutputError
from octasplat.engine.files import read_facts
from octasplat.engine.files.gaussian_ply import write_gaussian_ply
from octasplat.engine.gaussians.materials import require_materials
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.render.environment_map import read_environment
from octasplat.engine.run_folder import (
    CONFIG,
    ENVIRONMENT,
    EVENTS,
    HELD_OUT,
    POSES,
    SCENE,
    TRAINING,
    VIEWS,
    is_run,
)
from octasplat.engine.shading.environment_frame import environment_frame
from octasplat.engine.shading.learnt_light import LearntLight
from octasplat.engine.writing import telling_of_room, write_json

EDITS = "edits.json"
"""What was changed since the training, first to last."""
_KEPT = (CONFIG, EVENTS, HELD_OUT, TRAINING, VIEWS, ENVIRONMENT)


def change_materials(
    source: Path, gaussians: FlatGaussians, chosen: Bool[np.ndarray, " n"], change: MaterialChange
) -> FlatGaussians:
    """The scene of a run or file with the materials of the chosen Gaussians changed.

    Where it is that of a run which learnt its environment, harmonics follow.

    Args:
        source: folder of the run, or file.
        gaussians: its scene.
        chosen: whose materials.
        change: what becomes of them.

    Raises:
        ConfigError: the scene has no materials, or nothing is chosen.
    """
    require_materials(gaussians, source / SCENE if is_run(source) else source)
    if not chosen.any():
        raise ConfigError(
            f"{source}: none of its {len(chosen):,} Gaussians is chosen, so nothing is changed."
        )
    changed = with_materials(gaussians, chosen, change)
    if not follows(source):
        return changed
    settings = read_config(source / CONFIG).train.materials
    light = LearntLight(settings.environment_height)
    light.put(read_environment(source / ENVIRONMENT))
    frame = environment_frame(np.array(settings.up_world, np.float64))
    return with_harmonics_following(gaussians, changed, chosen, light.levels, frame)


def follows(source: Path) -> bool:
    """Whether the harmonics of a scene show its materials in a light that is known."""
    if not is_run(source) or not (source / ENVIRONMENT).exists():
        return False
    return read_config(source / CONFIG).train.materials.recipe != "seed"  # there they are the matt part


def edit_note(
    change: MaterialChange, selection: Selection, chosen: Bool[np.ndarray, " n"]
) -> dict[str, object]:
    """Return a change in a few words of JSON, for ``edits.json``."""
    asked, where = set(MaterialChange.model_fields), set(Selection.model_fields)
    return {
        **change.model_dump(mode="json", exclude_defaults=True, include=asked),
        **selection.model_dump(mode="json", exclude_defaults=True, include=where),
        "gaussians": int(chosen.sum()),
    }


def check_new_run(target: Path) -> None:
    """Make sure that a folder is free.

    Raises:
        OutputError: it is not.
    """
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise OutputError(f"{target} is there already; name a new folder.")


def write_changed_run(
    source: Path, gaussians: FlatGaussians, target: Path, note: Mapping[str, object]
) -> None:
    """Write a folder like that of a run with another scene in it, all at once.

    What was measured, rendered and exported of the run does not come along, nor do checkpoints.

    Args:
        source: folder of the run.
        gaussians: the other scene.
        target: a folder that does not exist or is empty.
        note: what was changed, added to ``edits.json``.

    Raises:
        OutputError: the folder is taken or cannot be written.
        NoSpaceLeft: its disk is full.
    """
    check_new_run(target)
    partial = target.with_name(f".{target.name}.{os.getpid()}.partial")
    try:
        with telling_of_room(target):
            partial.mkdir(parents=True)
            for name in _KEPT:
                if (source / name).exists():
                    shutil.copyfile(source / name, partial / name)
            if (source / POSES).is_dir():
                shutil.copytree(source / POSES, partial / POSES)
            write_gaussian_ply(
                gaussians,
                partial / SCENE,
                facts=read_facts(source),
            )
            write_json(partial / EDITS, [*_edits(source), dict(note)])
            partial.replace(target)
    except OSError as error:
        raise OutputError(f"{target} cannot be written ({error.strerror or error}).") from None
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _edits(source: Path) -> list[object]:
    if not (source / EDITS).exists():
        return []
    try:
        found = json.loads((source / EDITS).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise OutputError(f"{source / EDITS} cannot be read ({error}); delete it.") from None
    return found if isinstance(found, list) else [found]

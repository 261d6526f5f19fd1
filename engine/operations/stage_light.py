"""How the first stage of a scene lights it: with materials, if their light is known."""

import os
from collections.abc import Callable
from pathlib import Path

from octasplat.engine.gaussians.materials import has_materials, is_material_known
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.pathtracing.stage.stage_template import StageLight
from octasplat.engine.runs.config import read_config
from octasplat.engine.runs.run_folder import CONFIG, SCENE, is_full_run, run_environment
from octasplat.engine.shading.recipes import material_shading

_HOW = 'For materials write light = "relit" under [[gaussians]] and name a map of light under [environment].'
_MAY_DIFFER = (
    "Paths of light see more than octasplat render of the run: what mirrors mirror again, and noise; more "
    "samples have less of it."
)
_LACKS_RESIDUAL = "Residual colors, which that adds if the run has some, hold its own light and are left out."


def run_around(source: Path) -> Path | None:
    """Return the folder of the run whose scene a source is: a run's folder, or its ``scene.ply``."""
    folder = source if source.is_dir() else source.parent if source.name == SCENE else None
    if folder is None or not is_full_run(folder) or not (folder / CONFIG).exists():
        return None
    return folder


def first_stage_light(
    source: Path, gaussians: FlatGaussians, stage_folder: Path, note: Callable[[str], None]
) -> StageLight:
    """Return how the first stage of a scene lights it.

    Args:
        source: the folder of a run, or a file of Gaussians.
        gaussians: the scene.
        stage_folder: where the stage is written, to which the name of the map is relative.
        note: called with a sentence where a scene with materials is shown without them.

    Raises:
        ConfigError: the run's settings cannot be read.
    """
    if not has_materials(gaussians):
        return StageLight()
    run = run_around(source)
    reason = _why_not_relit(run, gaussians)
    if run is None or reason:
        note(f"{source}: {reason} So the stage shows its harmonics. {_HOW}")
        return StageLight(
            note=(f"The scene has materials, but {reason}", f"So its harmonics are shown. {_HOW}")
        )
    materials = read_config(run / CONFIG).train.materials
    x, y, z = materials.up_world
    return StageLight(
        mode="relit",
        environment=_relative_name(run_environment(run), stage_folder),
        environment_up=(x, y, z),
        note=(
            "The scene has materials, and is shown with them in the light that was learnt with them.",
            _MAY_DIFFER,
            _LACKS_RESIDUAL,
        ),
    )


def _why_not_relit(run: Path | None, gaussians: FlatGaussians) -> str:
    """Return why a scene's materials cannot be shown in their own light, as a sentence; empty if they can."""
    if run is None:
        return "a file does not hold the light that they were learnt in."
    if not is_material_known(gaussians).all():
        return "some of its Gaussians came from a scene without."
    learnt = read_config(run / CONFIG).train.materials
    if not (learnt.learn and run_environment(run).exists()):
        return "the run holds no light that they were learnt in."
    if material_shading(learnt.recipe).albedo_holds_light:
        return (
            f"with materials.recipe={learnt.recipe} base colors hold the light of the photographs, which a "
            "stage would add once more."
        )
    return ""


def _relative_name(path: Path, folder: Path) -> str:
    """Return the name of a file relative to a folder; whole where it is on another drive."""
    try:
        return Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix()
    except ValueError:
        return path.resolve().as_posix()

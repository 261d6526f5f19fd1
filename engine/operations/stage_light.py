"""How a stage lights a scene where nobody says it: with materials, if their light is known."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from octasplat.engine.gaussians.materials import has_materials, is_material_known
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.pathtracing.stage.model import Environment, Stage
from octasplat.engine.pathtracing.stage.stage_template import (
    FILE_HAS_NO_LIGHT,
    StageLight,
    shown_as_harmonics,
)
from octasplat.engine.runs.config import read_config
from octasplat.engine.runs.run_folder import CONFIG, SCENE, is_full_run, run_environment
from octasplat.engine.shading.recipes import material_shading

_MAY_DIFFER = (
    "Paths of light see more than octasplat render of the run: what mirrors mirror again, and noise; more "
    "samples have less of it."
)
_LACKS_RESIDUAL = "Residual colors, which that adds if the run has some, hold its own light and are left out."


@dataclass(frozen=True)
class SceneLight:
    """How a stage that does not say it lights a scene.

    Attributes:
        mode: value of ``light`` under ``[[gaussians]]``.
        learnt: map of the light that the run has learnt, where that lights the stage.
        learnt_up: the direction in the world that is at the map's top.
        reason: a sentence on why materials are not shown; empty where they are, or where there are none.
    """

    mode: Literal["shadowed", "relit"] = "shadowed"
    learnt: Path | None = None
    learnt_up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    reason: str = ""


@dataclass(frozen=True)
class LitStage:
    """A stage that says how its scene is lit.

    Attributes:
        stage: with the ``light`` of each entry that stands for the scene.
        identity: what decides how images look, beside the stage as it was given, for a digest.
    """

    stage: Stage
    identity: tuple[object, ...]


def run_around(source: Path) -> Path | None:
    """Return the folder of the run whose scene a source is: a run's folder, or its ``scene.ply``."""
    folder = source if source.is_dir() else source.parent if source.name == SCENE else None
    if folder is None or not is_full_run(folder) or not (folder / CONFIG).exists():
        return None
    return folder


def choose_light(source: Path, gaussians: FlatGaussians, stage: Stage | None = None) -> SceneLight:
    """Return how a scene is lit by a stage that does not say it.

    Args:
        source: the folder of a run, or a file of Gaussians.
        gaussians: the scene.
        stage: the stage; None for a first one, which has neither lamps nor surroundings yet.

    Raises:
        ConfigError: the run's settings cannot be read.
    """
    if not has_materials(gaussians):
        return SceneLight()
    run = run_around(source)
    if run is None:
        return SceneLight(reason=FILE_HAS_NO_LIGHT)
    if not is_material_known(gaussians).all():
        return SceneLight(reason="some of its Gaussians came from a scene without materials.")
    materials = read_config(run / CONFIG).train.materials
    is_lit = stage is not None and stage.environment is not None
    if not is_lit and not (materials.learn and run_environment(run).exists()):
        return SceneLight(reason="the run holds no light that its materials were learnt in.")
    shading = material_shading(materials.recipe)
    if shading.matt_color_is_harmonics:
        return SceneLight(
            reason=f"with materials.recipe={materials.recipe} what is matt has its color from the harmonics, "
            "which a stage does not light, and its light is in display values."
        )
    if shading.albedo_holds_light:
        return SceneLight(
            reason=f"with materials.recipe={materials.recipe} base colors hold the light of the photographs, "
            "which a stage would add once more."
        )
    for number, light in enumerate(() if stage is None else stage.lights):
        if light.only_shadows:
            return SceneLight(
                reason=f"the shadows of lights[{number}] (only_shadows) do not fall on materials."
            )
    x, y, z = materials.up_world
    return SceneLight("relit", None if is_lit else run_environment(run), (x, y, z))


def lit_stage(stage: Stage, source: Path, gaussians: FlatGaussians, note: Callable[[str], None]) -> LitStage:
    """Return a stage with the light that its scene has where it does not say it.

    Args:
        stage: as it was given.
        source: the folder of a run, or a file of Gaussians.
        gaussians: the scene.
        note: called with a sentence where the scene has materials, on how these are shown.

    Raises:
        ConfigError: the run's settings cannot be read.
    """
    if all(part.light is not None or part.file is not None for part in stage.gaussians):
        return LitStage(stage, ())
    light = choose_light(source, gaussians, stage)
    if light.reason:
        note(f"{source}: {shown_as_harmonics(light.reason)}")
    elif light.mode == "relit":
        shown = "of the stage's environment" if light.learnt is None else "that was learnt with them"
        note(
            f"{source}: the stage names no light for the scene, so that materials are shown, in the light "
            f'{shown}; light = "shadowed" under [[gaussians]] shows harmonics.'
        )
    parts = tuple(
        part.model_copy(update={"light": light.mode}) if part.light is None and part.file is None else part
        for part in stage.gaussians
    )
    lit = stage.model_copy(update={"gaussians": parts})
    if light.learnt is None:
        return LitStage(lit, (light.mode,))
    around = Environment(file=str(light.learnt.resolve()), up=light.learnt_up, visible=False)
    return LitStage(
        lit.model_copy(update={"environment": around}), (light.mode, light.learnt, light.learnt_up)
    )


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
    light = choose_light(source, gaussians)
    if light.reason:
        sentence = shown_as_harmonics(light.reason)
        note(f"{source}: {sentence}")
        return StageLight(note=(f"The scene has materials, but {sentence}",))
    if light.learnt is None:
        return StageLight()
    return StageLight(
        mode=light.mode,
        environment=_relative_name(light.learnt, stage_folder),
        environment_up=light.learnt_up,
        note=(
            "The scene has materials, and is shown with them in the light that was learnt with them.",
            _MAY_DIFFER,
            _LACKS_RESIDUAL,
        ),
    )


def _relative_name(path: Path, folder: Path) -> str:
    """Return the name of a file relative to a folder; whole where it is on another drive."""
    try:
        return Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix()
    except ValueError:
        return path.resolve().as_posix()

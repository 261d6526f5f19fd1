"""Whether a run learns materials, and by which recipe: chosen by short trainings before a long one."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, get_args

from octasplat.engine.core.events import Noted, Warned
from octasplat.engine.pipeline.output_folder import other_settings_error, write_config
from octasplat.engine.pipeline.run import ReconstructionRun
from octasplat.engine.pipeline.start_scene import has_start
from octasplat.engine.runs.config import (
    ReconstructionConfig,
    read_given,
    revise_config,
    without_later_settings,
)
from octasplat.engine.runs.run_folder import CONFIG
from octasplat.engine.settings.refusals import InvalidSettingsError
from octasplat.engine.shading.material_settings import Recipe
from octasplat.engine.train.config import iteration_count
from octasplat.engine.train.loop.trial_training import MATERIAL_TRIAL_RAYS, material_gain_db
from octasplat.engine.train.sampling.pixel_sampler import valid_pixel_fraction

MaterialChoice = Literal["split_sum", "near_field", "none"]
"""What is chosen between: materials in far light, mirrors of what stands near, or no materials."""
CHOICE_KEY = "material_choice"
"""Of ``config.json``, where a run has chosen."""
LONG_TRAINING_TRIALS = 8
"""Trainings of less than so many times the rays of a trial are begun without one."""
MAX_MATERIAL_LOSS_DB = 1.0
"""Loss of a trial above which a warning is given for a thing that masks or alpha cut out. Its materials are
learnt all the same: what is polished may gain in the end what it loses in a trial."""
MAX_WHOLE_LOSS_DB = 0.3
"""Loss of a trial above which ``near_field`` is tried for whole photographs, whose surroundings are not far
away, and chosen if it loses nothing. They are trained without materials if it loses, too."""


def apply_choice(
    config: ReconstructionConfig, choice: MaterialChoice, given: Sequence[str] | None = None
) -> ReconstructionConfig:
    """Return the settings of a run that asked for materials, with what was chosen.

    Args:
        config: the settings.
        choice: what was chosen.
        given: names of the settings that were given, which stay without materials; None keeps those that
            differ from the settings of the preset with materials.

    Raises:
        InvalidSettingsError: what was given cannot be used without materials.

    Example:
        >>> from octasplat.engine.runs.config import resolve_config
        >>> apply_choice(resolve_config("fast", materials=True), "near_field").train.materials.recipe
        'near_field'
        >>> apply_choice(resolve_config("fast", materials=True), "none") == resolve_config("fast")
        True
        >>> few_rays = resolve_config("fast", materials=True, assignments=["rays_per_batch=8192"])
        >>> apply_choice(few_rays, "none", ["rays_per_batch"]).train.rays_per_batch
        8192
    """
    before = config.model_dump(mode="json")
    if choice != "none":
        return revise_config(before, train={"materials": {"recipe": choice}}, given=given)
    # edges are a term of materials alone, which would be refused
    return revise_config(before, materials=False, train={"loss": {"edges": None}}, given=given)


def with_recorded_choice(
    output: Path, config: ReconstructionConfig, given: tuple[str, ...] | None = None
) -> tuple[ReconstructionConfig, tuple[str, ...] | None]:
    """Return the settings of a command with what the run in a folder has chosen, if it is there and has.

    Settings that the version of the run did not have, and that the command does not name, stay as without
    them.

    Args:
        output: the folder.
        config: as the command gives it; the run's own settings have the choice already.
        given: names of the settings that the command gives; None where it goes on by those of the run, or
            where that is not known.

    Returns:
        The settings, and the names of those that were given: by the run, if it is there.

    Raises:
        ConfigError: the run was given other settings, so that without materials it would be another one.
    """
    if not (output / CONFIG).exists():
        return config, given
    recorded = read_given(output / CONFIG)
    config = without_later_settings(config, output / CONFIG, {*(given or ()), *(recorded or ())})
    if _asks_for_choice(config):
        # a run of old does not know what it was given, and goes on as it was begun
        of_command = recorded if given is None or recorded is None else given
        if (choice := recorded_choice(output)) is not None:
            config = apply_choice(config, choice, of_command)
        elif _without_materials(config, of_command) != _without_materials(config, recorded):
            raise other_settings_error(output)
    return config, recorded


def recorded_choice(output: Path) -> MaterialChoice | None:
    """Return what the run in a folder has chosen; None where there is no run, or it has not chosen."""
    try:
        content = json.loads((output / CONFIG).read_text(encoding="utf-8"))
    except (OSError, ValueError):  # told by whoever needs the file
        return None
    choice = content.get(CHOICE_KEY) if isinstance(content, dict) else None
    return choice if choice in get_args(MaterialChoice) else None


def choose_materials(run: ReconstructionRun) -> None:
    """Choose by short trainings what a long training learns, and tell it; changes the run's settings.

    Nothing is chosen where a recipe was named or is to be used in any case (``materials.fallback``), or where
    the run begins with a scene; it is told all the same where materials lose accuracy. There are no trials
    before a short training. A named recipe may be that of the default; ``materials.fallback=true`` lets it be
    replaced.

    Raises:
        CancelledError: stopped as asked.
    """
    config = run.train_config
    if not config.materials.learn or recorded_choice(run.output) is not None:
        return
    steps = iteration_count(config, run.dataset.train_pixel_count, valid_pixel_fraction(run.dataset))
    if steps * config.rays_per_batch < LONG_TRAINING_TRIALS * MATERIAL_TRIAL_RAYS:
        return
    run.progress(Noted("Two short trainings show first whether materials explain these photographs."))
    gain_db = _trial_gain_db(run, config.materials.recipe)
    is_named = config.materials.fallback is None and "materials.recipe" in (run.given or ())
    is_chosen = _asks_for_choice(run.config) and not is_named and not has_start(run.output)
    is_whole = not (run.dataset.has_alpha or run.dataset.has_masks)
    if gain_db >= -(MAX_WHOLE_LOSS_DB if is_whole and is_chosen else MAX_MATERIAL_LOSS_DB):
        if is_chosen:
            _record(run, "split_sum")
        return
    loss = f"In a short training new views are {-gain_db:.1f} dB worse with materials than without"
    if is_chosen and is_whole and _choose_for_whole_photographs(run, loss):
        return
    if is_chosen:
        _record(run, "split_sum")
    advice = (
        ""
        if (is_chosen and is_whole) or config.materials.recipe == "near_field"
        else " For something shiny in a room there is --set materials.recipe=near_field."
    )
    run.progress(
        Warned(
            f"{loss}: little here reflects its surroundings clearly, or they are near. Leave out --materials "
            f"unless the scene is to be lit anew.{advice}"
        )
    )


def _choose_for_whole_photographs(run: ReconstructionRun, loss: str) -> bool:
    """Choose mirrors of what stands near, or no materials, where ``loss`` tells what the trial has lost.

    Returns:
        Whether one of them was chosen: settings that were given may be possible with materials only.
    """
    run.progress(Noted(f"{loss}. Another one shows whether mirrors of what stands near explain them."))
    near_gain_db = _trial_gain_db(run, "near_field")
    if near_gain_db >= 0:
        run.progress(
            Warned(
                f"{loss}, but {near_gain_db:.1f} dB better with materials.recipe=near_field, by which "
                "mirrors show what stands near. That recipe is used; --set materials.fallback=false "
                "keeps the other."
            )
        )
        _record(run, "near_field")
        return True
    if _without_materials(run.config, run.given) is None:
        return False
    but = "" if run.given is not None else " that differs from those with materials"
    run.progress(
        Warned(
            f"{loss}: little here reflects its surroundings clearly. The scene is trained without "
            f"materials, with the settings of its preset for that where none was given{but}; --set "
            "materials.fallback=false learns them all the same, for a scene that is to be lit anew."
        )
    )
    _record(run, "none")
    return True


def _asks_for_choice(config: ReconstructionConfig) -> bool:
    materials = config.train.materials
    return materials.learn and materials.recipe == "split_sum" and materials.fallback is not False


def _without_materials(
    config: ReconstructionConfig, given: Sequence[str] | None
) -> ReconstructionConfig | None:
    """Return the settings of the training without materials; None where there can be none."""
    try:
        return apply_choice(config, "none", given)
    except InvalidSettingsError:
        return None


def _trial_gain_db(run: ReconstructionRun, recipe: Recipe) -> float:
    return material_gain_db(
        run.dataset,
        recipe=recipe,
        background=run.config.train.background,
        seed=run.config.train.seed,
        threads=run.threads,
        should_stop=run.should_stop,
    )


def _record(run: ReconstructionRun, choice: MaterialChoice) -> None:
    """Keep a choice in the run's settings and in ``config.json``, for this process and later ones."""
    run.config = apply_choice(run.config, choice, run.given)
    rewrite_config(run, choice)


def rewrite_config(run: ReconstructionRun, choice: MaterialChoice | None = None) -> None:
    """Write ``config.json`` anew, with what the run has chosen by now or before."""
    choice = choice or recorded_choice(run.output)
    decided = {} if choice is None else {CHOICE_KEY: choice}
    write_config(run.scene, run.output, run.config, given=run.given, decided=decided)

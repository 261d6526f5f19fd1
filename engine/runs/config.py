"""Settings of a reconstruction, and their resolution from preset, options and assignments.

Imports neither torch nor numba.
"""

import json
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from pydantic import Field, TypeAdapter, ValidationError, model_validator

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.poses.found_models import parse_found_model
from octasplat.engine.runs.run_settings import RunSettings
from octasplat.engine.runs.setting_names import check_names, leaf_paths, named_values, value_at
from octasplat.engine.settings.base import Settings
from octasplat.engine.settings.fields import ADVANCED
from octasplat.engine.settings.nested_options import merge_options
from octasplat.engine.settings.preset_names import PRESETS, PRESETS_WITH_MATERIALS
from octasplat.engine.settings.refusals import InvalidSettingsError, Refusal, refusals_from
from octasplat.engine.settings.renamed_settings import replace_former_names
from octasplat.engine.shading.material_settings import Recipe
from octasplat.engine.train.config import TrainConfig, preset, with_materials

GIVEN = "given"
"""Of a run's ``config.json``: the names of the settings that were asked for, see :func:`given_settings`."""


class ReconstructionConfig(RunSettings):
    """All settings that decide the result of a reconstruction; the number of threads does not."""

    train: TrainConfig = Field(TrainConfig(), description="The settings of the training.")
    evaluation_background: Annotated[Literal["black", "white"], ADVANCED] = Field(
        "black",
        description="What lies behind renders and photographs with alpha when they are compared; by default "
        "that of the training: white where background is white, else black.",
    )

    @model_validator(mode="before")
    @classmethod
    def _default_evaluation_background(cls, values: Any) -> Any:
        """Set the background of the evaluation, if it is not given, to that of the training.

        Backgrounds that are no fixed color are evaluated on black.
        """
        if not isinstance(values, Mapping):
            return values
        values = replace_former_names((cls,), values)
        if values.get("evaluation_background") is not None:
            return values
        train = values.get("train", {})
        train_background = (
            train.get("background") if isinstance(train, Mapping) else getattr(train, "background", None)
        )
        return {**values, "evaluation_background": _background_behind(train_background)}

    def background_mismatch(self, has_alpha: bool) -> str | None:
        """Return a sentence where views are measured on another background than they were trained on.

        Args:
            has_alpha: whether the photographs have alpha, so that they have no background of their own.
        """
        evaluated = self.evaluation_background
        trained = self.train.background if self.train.background != "auto" else "black"
        if has_alpha or trained not in ("black", "white") or trained == evaluated:
            return None
        return (
            f"The scene is trained on {trained} and measured on {evaluated}, which shows where it does "
            "not cover a photograph; leave the background of the evaluation out."
        )

    def preset_notice(self) -> str | None:
        """Return a sentence where the preset has no settings of its own with materials."""
        recipe = self.train.materials.recipe if self.train.materials.learn else None
        if self.preset != "high" or recipe is None:
            return None
        if _preset_settings("high", recipe) != _preset_settings("standard", recipe):
            return None
        return (
            "With materials the preset high has the settings of standard; for more detail set rays_per_pixel "
            "and --max-gaussians."
        )

    def without_run_of_model(self) -> "tuple[ReconstructionConfig, Path | None]":
        """Return the settings with a found model named without the run that has found it, and that run."""
        named = parse_found_model(self.model)
        if named is None or named[0] is None:
            return self, None
        return self.model_copy(update={"model": f"poses/{named[1]}"}), named[0]

    def with_poses_decided(self, has_model: bool) -> "ReconstructionConfig":
        """Return the settings with ``poses`` resolved for a dataset with or without a COLMAP model."""
        if self.poses != "missing":
            return self
        is_given = has_model and parse_found_model(self.model) is None
        return self.model_copy(update={"poses": "given" if is_given else "auto"})


def resolve_config(
    preset_name: str = "standard",
    *,
    materials: bool = False,
    settings: Mapping[str, object] | None = None,
    train: Mapping[str, Any] | None = None,
    assignments: Sequence[str] = (),
) -> ReconstructionConfig:
    """Return the configuration that a preset, settings and assignments mean; later ones win.

    Whatever switches materials on, the flag, ``train`` or an assignment, means the same: the preset with
    materials, see :func:`octasplat.engine.train.config.with_materials`, and what else is given on top.

    Args:
        preset_name: one of :data:`octasplat.engine.settings.preset_names.PRESETS`.
        materials: learn materials and the environment.
        settings: fields of :class:`RunSettings`; None values are left at their defaults.
        train: some settings of the training, nested as in :class:`ReconstructionConfig`.
        assignments: of any setting, values as JSON: ``lr.mean=2e-4``, which is
            ``train.lr.mean=2e-4``, or ``test_every=4``.

    Raises:
        InvalidSettingsError: an unknown name, a value out of range, or settings that contradict each other.
    """
    given = {key: value for key, value in (settings or {}).items() if value is not None}
    # None where nothing was said, so that train or an assignment may decide
    values, changes = _collect_changes(
        {**given, "preset": preset_name}, materials or None, train, assignments
    )
    # the preset depends on the changes: any of them may switch materials on
    base = _preset_settings(values["preset"], _learnt_recipe(changes))
    return _validate_config({**values, "train": merge_options(base, changes)})


def requested_settings(
    settings: Mapping[str, object],
    *,
    materials: bool | None = None,
    train: Mapping[str, Any] | None = None,
    assignments: Sequence[str] = (),
) -> dict[str, Any]:
    """Return what was given, unresolved: settings of the run, and those of the training below ``train``.

    Args:
        settings: fields of :class:`RunSettings`.
        materials: as for :func:`resolve_config`; None where nothing was said of them.
        train: as for :func:`resolve_config`.
        assignments: as for :func:`resolve_config`.

    Raises:
        InvalidSettingsError: an unknown name.
    """
    values, changes = _collect_changes(settings, materials, train, assignments)
    return {**values, "train": changes} if changes else values


def given_settings(
    settings: Mapping[str, object],
    *,
    materials: bool | None = None,
    train: Mapping[str, Any] | None = None,
    assignments: Sequence[str] = (),
) -> tuple[str, ...]:
    """Return the names, with dots, of the settings that were given, also those given what they are anyway.

    Args:
        settings: fields of :class:`RunSettings`.
        materials: as for :func:`resolve_config`; None where nothing was said of them.
        train: as for :func:`resolve_config`.
        assignments: as for :func:`resolve_config`.

    Raises:
        InvalidSettingsError: an unknown name.
    """
    values, changes = _collect_changes(settings, materials, train, assignments)
    # an empty section says nothing of what is in it
    paths = (path for path in leaf_paths(changes, ()) if value_at(changes, path) != {})
    return tuple(sorted({*values, *(".".join(path) for path in paths)}))


def revise_requested(requested: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return :func:`requested_settings` with changes; another preset brings its own settings."""
    kept, train = {**requested, **changes}, changes.get("train", {})
    default = RunSettings.model_fields["preset"].default
    if kept.get("preset", default) == requested.get("preset", default):
        # settings of the same preset stay, another preset brings its own
        train = merge_options(requested.get("train", {}), train)
    if "depth_normal" in changes.get("train", {}).get("loss", {}) and "for_surface" not in changes:
        kept.pop("for_surface", None)  # which means a value of its own
    kept.pop("train", None)
    return {**kept, "train": train} if train else kept


def revise_config(
    before: Mapping[str, Any],
    *,
    materials: bool | None = None,
    settings: Mapping[str, object] | None = None,
    train: Mapping[str, Any] | None = None,
    assignments: Sequence[str] = (),
    given: Sequence[str] | None = None,
) -> ReconstructionConfig:
    """Return a configuration with changes; another preset brings its own settings of the training.

    Where the changes switch materials on or off, or their recipe, the rest of what that means comes with it,
    but for the settings that were given. The background of the evaluation goes on following that of the
    training.

    Args:
        before: the configuration, as JSON.
        materials: as for :func:`resolve_config`; None leaves them as they are.
        settings: fields of :class:`RunSettings`; those that are not there stay as they are.
        train: as for :func:`resolve_config`.
        assignments: as for :func:`resolve_config`.
        given: names of the settings of ``before`` that were given, see :func:`given_settings`; None takes
            those that differ from the settings of its preset.

    Raises:
        InvalidSettingsError: an unknown name, a value out of range, or settings that contradict each other.
    """
    before = replace_former_names((ReconstructionConfig,), before)
    values, changes = _collect_changes(settings or {}, materials, train, assignments)
    former: Mapping[str, Any] = before.get("train", {})
    follows = before.get("evaluation_background") == _background_behind(former.get("background"))
    if follows and "evaluation_background" not in (given or ()):
        before.pop("evaluation_background")  # that of the new background
    values = {**before, **values}
    recipe, wanted = _learnt_recipe(former), _learnt_recipe(merge_options(former, changes))
    if values.get("preset") != before.get("preset"):
        former, wanted = {}, _learnt_recipe(changes)  # of another preset: none of its settings stay
    elif wanted == recipe:
        return _validate_config({**values, "train": merge_options(former, changes)})
    else:
        # materials or their recipe were switched: what was given stays, the preset gives the rest
        former = (
            _changed_values(_preset_settings(before.get("preset"), recipe), former)
            if given is None
            else named_values(former, given)
        )
    base = _preset_settings(values.get("preset"), wanted)
    return _validate_config({**values, "train": merge_options(base, merge_options(former, changes))})


def _background_behind(train_background: object) -> Literal["black", "white"]:
    """Return the background of an evaluation by that of the training; most are no fixed color."""
    return "white" if train_background == "white" else "black"


def read_given(path: Path) -> tuple[str, ...] | None:
    """Return the names of the settings that a run was given, by its ``config.json``.

    None where the file does not say so, as those of earlier versions, or cannot be read, of which whoever
    needs it tells.
    """
    try:
        names = json.loads(path.read_text(encoding="utf-8"))[GIVEN]
    except (OSError, ValueError, KeyError, TypeError):
        return None
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        return None
    return tuple(names)


def read_config(path: Path) -> ReconstructionConfig:
    """Return the ``reconstruction`` section of a run's ``config.json``.

    Raises:
        ConfigError: the file is missing, damaged, or of another version.
    """
    try:
        section = json.loads(path.read_text(encoding="utf-8"))["reconstruction"]
        if not isinstance(section, Mapping):
            raise TypeError("reconstruction is no object")
        return _validate_config(replace_former_names((ReconstructionConfig,), section, source=str(path)))
    except InvalidSettingsError as error:  # not told as damage: the file is of another version
        raise ConfigError(f"{path} is not a configuration of this version: {error}") from None
    except (OSError, ValueError, KeyError, TypeError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise ConfigError(
            f"{path} cannot be read ({reason}); name the folder of a finished or stopped run."
        ) from None


def without_later_settings(
    config: ReconstructionConfig, path: Path, given: Collection[str]
) -> ReconstructionConfig:
    """Return settings without those that the version of a run did not have; None stands for that.

    Args:
        config: the settings.
        path: ``config.json`` of the run; a file that cannot be read is told by whoever needs it.
        given: names of settings that stay, as somebody asked for them.
    """
    try:
        recorded = json.loads(path.read_text(encoding="utf-8"))["reconstruction"]["train"]
    except (OSError, ValueError, KeyError, TypeError):
        return config
    return config.model_copy(update={"train": _without_later(config.train, recorded, given, "")})


def _without_later(settings: Settings, recorded: object, given: Collection[str], prefix: str) -> Settings:
    """Return a section of settings, whose names begin with ``prefix``, without those not recorded."""
    if not isinstance(recorded, Mapping):
        return settings
    changes: dict[str, object] = {}
    for name in type(settings).model_fields:
        value, path = getattr(settings, name), f"{prefix}{name}"
        if isinstance(value, Settings):
            changes[name] = _without_later(value, recorded.get(name), given, f"{path}.")
        elif name in settings.later_settings and recorded.get(name) is None and path not in given:
            changes[name] = None
    return settings.model_copy(update=changes)


def _collect_changes(
    settings: Mapping[str, object],
    materials: bool | None,
    train: Mapping[str, Any] | None,
    assignments: Sequence[str],
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the requested fields of :class:`RunSettings` and the nested training settings."""
    values = replace_former_names((RunSettings,), settings)
    changes: dict[str, Any] = {} if materials is None else {"materials": {"learn": materials}}
    if train:
        train = replace_former_names((TrainConfig,), train)
        check_names(train)
        changes = merge_options(changes, train)
    for assignment in assignments:
        path, value = _read_assignment(assignment)
        for name in reversed(path):  # from the innermost name outwards
            value = {name: value}
        value = replace_former_names((RunSettings, TrainConfig), value)
        if RunSettings.model_fields.keys() & value:  # a setting of the run, not of its training
            values |= value
            continue
        check_names(value)
        changes = merge_options(changes, value)
    return values, changes


def _validate_config(values: Mapping[str, Any]) -> ReconstructionConfig:
    try:
        return ReconstructionConfig.model_validate(dict(values))
    except ValidationError as error:
        raise InvalidSettingsError(refusals_from(error, ReconstructionConfig)) from None


def _read_assignment(assignment: str) -> tuple[list[str], Any]:
    """Return the path and value of an assignment; the value is read as JSON, or else as text."""
    name, equals, text = (part.strip() for part in assignment.partition("="))
    if not equals or not name:
        sentence = f"{assignment}: write an assignment as name=value, e.g. lr.mean=2e-4."
        raise InvalidSettingsError([Refusal(("set",), "assignment", sentence)])
    try:
        value = json.loads(text)
    except ValueError:
        value = text  # a text needs no quotes
    path = name.split(".")
    return path[1:] if path[0] == "train" and len(path) > 1 else path, value  # train. may be left out


def _preset_settings(preset_name: object, recipe: Recipe | None) -> dict[str, Any]:
    """Return a preset's training settings as JSON; empty for an unknown preset, which validation refuses."""
    if preset_name not in PRESETS:
        return {}
    if recipe is not None and preset_name not in PRESETS_WITH_MATERIALS:
        *others, last = PRESETS_WITH_MATERIALS
        sentence = (
            f"The preset {preset_name} is for scenes without materials; with materials choose "
            f"{', '.join(others)} or {last}."
        )
        raise InvalidSettingsError([Refusal(("preset",), "materials", sentence)])
    chosen = preset(str(preset_name))
    return (with_materials(chosen, recipe) if recipe is not None else chosen).model_dump(mode="json")


def _learnt_recipe(train: Mapping[str, Any]) -> Recipe | None:
    """Return the recipe of training settings that switch materials on, in any accepted spelling, or None."""
    materials = train.get("materials")
    try:
        if not isinstance(materials, Mapping) or not _BOOL.validate_python(materials.get("learn", False)):
            return None
    except ValidationError:
        return None  # refused later, with a sentence that names it
    recipe = materials.get("recipe")
    return recipe if recipe in get_args(Recipe) else "split_sum"  # what there is not is refused later, too


_BOOL = TypeAdapter(bool)


def _changed_values(base: Mapping[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values that differ from ``base``, section by section."""
    found: dict[str, Any] = {}
    for key, value in values.items():
        old = base.get(key)
        # sections of another kind have other fields: they differ as a whole
        if isinstance(value, Mapping) and isinstance(old, Mapping) and value.get("kind") == old.get("kind"):
            if inner := _changed_values(old, value):
                found[key] = inner
        elif value != old:
            found[key] = value
    return found

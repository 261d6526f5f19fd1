"""The catalog of settings: name, type, unit, range, default by preset, group and description of each.

Imports neither torch nor numba.
"""

import types
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import annotated_types
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.runs.config import ReconstructionConfig, resolve_config
from octasplat.engine.runs.setting_names import former_setting_names
from octasplat.engine.settings.fields import Group, SettingLevel, Unit
from octasplat.engine.settings.preset_names import PRESETS, PRESETS_WITH_MATERIALS
from octasplat.engine.settings.refusals import InvalidSettingsError, refuse_unknown_setting

MATERIALS = "+materials"
"""What is added to the name of a preset where materials are learnt with it."""
_ABSENT = object()  # None is a value


@dataclass(frozen=True)
class Setting:
    """A setting.

    Attributes:
        name: with dots, as ``--set`` takes it.
        type: type of its values, or the values themselves, in words.
        unit: unit of a number; empty for what is no quantity.
        range: interval or other condition on its values, in words; empty where all are allowed.
        group: how many users need it.
        description: what it does, and when to touch it.
        defaults: value by preset, where the preset has the setting; ``+materials`` after the name of a preset
            stands for its values where materials are learnt.
    """

    name: str
    type: str
    unit: str
    range: str
    group: SettingLevel
    description: str
    defaults: Mapping[str, object]

    @property
    def default(self) -> object:
        """Return the value in the preset ``standard``, or else in the first that has the setting."""
        return self.defaults.get("standard", next(iter(self.defaults.values()), None))

    @property
    def exceptions(self) -> Mapping[str, object]:
        """Return the values by preset that differ from the default."""
        return {name: value for name, value in self.defaults.items() if value != self.default}


@dataclass(frozen=True)
class Difference:
    """A setting that has another value in one configuration than in the other.

    Attributes:
        name: of the setting.
        before: value in the first configuration, None where it has no such setting.
        after: value in the second one, likewise.
    """

    name: str
    before: object
    after: object


@cache
def all_settings() -> tuple[Setting, ...]:
    """Return all settings of a reconstruction, in the order of its configuration."""
    values = {
        name + (MATERIALS if materials else ""): setting_values(resolve_config(name, materials=materials))
        for name in PRESETS
        for materials in (False, True)
        if not materials or name in PRESETS_WITH_MATERIALS  # redisplats has no settings with materials
    }
    found: dict[str, Setting] = {}
    for name, info in _walk(ReconstructionConfig, ""):
        defaults = {key: value[name] for key, value in values.items() if name in value}
        if name == "preset":
            defaults = {"standard": "standard"}  # each preset is its own default
        found.setdefault(name, _setting_entry(name, info, defaults))
    return tuple(found.values())


def find_setting(name: str) -> Setting:
    """Return the setting of that name, which may begin with ``train.``.

    Raises:
        ConfigError: there is none; the sentence offers the nearest one.
    """
    plain_name = name.removeprefix("train.")
    names = [setting.name for setting in all_settings()]
    for setting in all_settings():
        if setting.name == plain_name:
            return setting
    inside = [known for known in names if known.startswith(f"{plain_name}.")]
    if inside:
        raise ConfigError(f"{name} is a group of settings: {', '.join(inside)}.")
    raise InvalidSettingsError(
        [refuse_unknown_setting(plain_name.split("."), names, former=former_setting_names())]
    )


def setting_values(config: ReconstructionConfig) -> dict[str, object]:
    """Return the JSON value of each setting by its name."""
    return dict(_flatten_settings(config.model_dump(mode="json"), ""))


def setting_differences(before: ReconstructionConfig, after: ReconstructionConfig) -> tuple[Difference, ...]:
    """Return the settings whose values differ, in the order of the catalog."""
    first, second = setting_values(before), setting_values(after)
    names = [setting.name for setting in all_settings()]
    return tuple(
        Difference(name, first.get(name), second.get(name))
        for name in names
        if first.get(name, _ABSENT) != second.get(name, _ABSENT)
    )


def default_values(config: ReconstructionConfig) -> ReconstructionConfig:
    """Return the defaults that a configuration began from: its preset's, with or without materials.

    With materials of another recipe than the default's they are those that come with it; the recipe itself is
    that of the default.
    """
    materials = config.train.materials
    base = resolve_config(config.preset, materials=materials.learn)
    usual = base.train.materials.recipe
    if not materials.learn or materials.recipe == usual:
        return base
    others = resolve_config(config.preset, materials=True, train={"materials": {"recipe": materials.recipe}})
    learnt = others.train.materials.model_copy(update={"recipe": usual})
    return others.model_copy(update={"train": others.train.model_copy(update={"materials": learnt})})


def format_value(value: object) -> str:
    """Return a value as users write it."""
    if value is None:
        return "none"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(format_value, value)) + "]"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _walk(model: type[BaseModel], prefix: str) -> Iterator[tuple[str, FieldInfo]]:
    for name, info in model.model_fields.items():
        path = f"{prefix}{name}".removeprefix("train.")
        models = [part for part in _alternatives(info.annotation) if _is_model(part)]
        if not models:
            yield path, info
        for inner in models:
            yield from _walk(inner, f"{prefix}{name}.")


def _setting_entry(name: str, info: FieldInfo, defaults: Mapping[str, object]) -> Setting:
    group: SettingLevel = next((mark.level for mark in info.metadata if isinstance(mark, Group)), "advanced")
    unit = next((mark.symbol for mark in info.metadata if isinstance(mark, Unit)), "")
    kind = _type_text(info.annotation)
    if name == "densify.kind":  # the alternatives of a kind are one setting
        kind = " or ".join(dict.fromkeys(str(value) for value in defaults.values()))
    return Setting(
        name=name,
        type=kind,
        unit=unit,
        range=_range_text(info.metadata),
        group=group,
        description=info.description or "",
        defaults=defaults,
    )


def _alternatives(annotation: Any) -> tuple[Any, ...]:
    """Return the alternatives of a type annotation, without their marks."""
    if get_origin(annotation) is Annotated:
        return _alternatives(get_args(annotation)[0])
    if get_origin(annotation) in (Union, types.UnionType):
        return tuple(part for option in get_args(annotation) for part in _alternatives(option))
    return (annotation,)


def _is_model(annotation: Any) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, BaseModel)


_TYPE_NAMES: Mapping[Any, str] = {
    bool: "true or false",
    int: "whole number",
    float: "number",
    str: "text",
    type(None): "none",
}


def _type_text(annotation: Any) -> str:
    texts: list[str] = []
    for part in _alternatives(annotation):
        if get_origin(part) is Literal:
            texts += map(str, get_args(part))
        elif get_origin(part) is tuple:
            inner = get_args(part)
            if inner[-1] is Ellipsis:
                texts.append(f"list of {_type_text(inner[0])}")
            else:
                texts.append(f"{len(inner)} numbers")
        else:
            texts.append(_TYPE_NAMES.get(part, str(part)))
    return " or ".join(texts)


def _range_text(marks: Sequence[Any]) -> str:
    texts = []
    for mark in marks:
        match mark:
            case annotated_types.Ge(ge=bound):
                texts.append(f"at least {format_value(bound)}")
            case annotated_types.Gt(gt=bound):
                texts.append(f"more than {format_value(bound)}")
            case annotated_types.Le(le=bound):
                texts.append(f"at most {format_value(bound)}")
            case annotated_types.Lt(lt=bound):
                texts.append(f"less than {format_value(bound)}")
            case annotated_types.MultipleOf(multiple_of=factor):
                texts.append(f"a multiple of {format_value(factor)}")
            case _:
                pass
    return ", ".join(texts)


def _flatten_settings(values: Mapping[str, Any], prefix: str) -> Iterator[tuple[str, object]]:
    for name, value in values.items():
        path = f"{prefix}{name}"
        if isinstance(value, Mapping):
            yield from _flatten_settings(value, f"{path}.")
        else:
            yield path.removeprefix("train."), value

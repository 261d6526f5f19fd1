"""Names of settings of a training, with dots, and the places in nested values that they stand for."""

from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from typing import Any

from pydantic import BaseModel

from octasplat.engine.runs.run_settings import RunSettings
from octasplat.engine.settings.base import Settings
from octasplat.engine.settings.nested_options import merge_options
from octasplat.engine.settings.refusals import InvalidSettingsError, refuse_unknown_setting, submodels
from octasplat.engine.settings.renamed_settings import former_names
from octasplat.engine.train.config import TrainConfig

_MISSING = object()


def named_values(values: Mapping[str, Any], names: Sequence[str]) -> dict[str, Any]:
    """Return those of nested values that dotted names are of; former names and those of nothing count."""
    found: dict[str, Any] = {}
    for name in names:
        path = former_setting_names().get(name, name).split(".")
        value = value_at(values, path)
        if value is not _MISSING:
            for key in reversed(path):  # from the innermost name outwards
                value = {key: value}
            found = merge_options(found, value)
    return found


def value_at(values: Any, path: Sequence[str]) -> Any:
    """Return the value at a path in nested values, or an object that is nothing else."""
    for key in path:
        if not isinstance(values, Mapping) or key not in values:
            return _MISSING
        values = values[key]
    return values


def check_names(train: Mapping[str, Any]) -> None:
    """Refuse settings of the training that there are not, with the nearest name.

    Raises:
        InvalidSettingsError: some are unknown.
    """
    unknown = list(_unknown_paths((TrainConfig,), train, ("train",)))
    if unknown:
        raise InvalidSettingsError(
            [
                refuse_unknown_setting(path, _setting_names(), former=former_setting_names())
                for path in unknown
            ]
        )


def _unknown_paths(
    models: Sequence[type[BaseModel]], values: Mapping[str, Any], path: tuple[str, ...]
) -> Iterator[tuple[str, ...]]:
    """Yield the paths of values that none of ``models`` has a field for."""
    for key, value in values.items():
        place = (*path, str(key))
        infos = [model.model_fields[key] for model in models if key in model.model_fields]
        if not infos:
            former = (model.former_settings for model in models if issubclass(model, Settings))
            # former settings are read, and refused elsewhere if they differ
            if not any(key in names for names in former):
                yield from leaf_paths(value, place)
        elif isinstance(value, Mapping):
            inner = tuple(model for info in infos for model in submodels(info.annotation))
            yield from _unknown_paths(inner, value, place)


def leaf_paths(value: object, path: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
    """Yield the paths of what nested values hold, each after ``path``; an empty section is a leaf itself."""
    if isinstance(value, Mapping) and value:
        for key, inner in value.items():
            yield from leaf_paths(inner, (*path, str(key)))
    else:
        yield path


@cache
def _setting_names() -> tuple[str, ...]:
    """Return the dotted names of all settings."""
    return (*RunSettings.model_fields, *dict.fromkeys(_names_in((TrainConfig,), "")))


def _names_in(models: Sequence[type[BaseModel]], prefix: str) -> Iterator[str]:
    for model in models:
        for name, info in model.model_fields.items():
            inner = submodels(info.annotation)
            if inner:
                yield from _names_in(inner, f"{prefix}{name}.")
            else:
                yield prefix + name


@cache
def former_setting_names() -> Mapping[str, str]:
    """Return the names of all settings of the training, with dots, by those of the last version."""
    return dict(_former_in((TrainConfig,), "", ""))


def _former_in(models: Sequence[type[BaseModel]], before: str, after: str) -> Iterator[tuple[str, str]]:
    for model in models:
        former = {new: old for old, new in former_names(model).fields.items()}
        for name, info in model.model_fields.items():
            old = former.get(name, name)
            if inner := submodels(info.annotation):
                yield from _former_in(inner, f"{before}{old}.", f"{after}{name}.")
            elif (before, old) != (after, name):
                yield before + old, after + name

"""Base of all models of settings, and the settings that have become constants."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from pydantic import BaseModel, ConfigDict, model_validator

from octasplat.engine.settings.renamed_settings import NONE, FormerNames, former_names, replace_former_names


@dataclass(frozen=True)
class FormerSetting:
    """A setting of earlier versions that is a constant now.

    Attributes:
        value: the constant, as JSON has it.
        after: the setting after which earlier versions wrote it; None where its last version is so old that
            no run of it can go on.
    """

    value: object
    after: str | None = None


class Settings(BaseModel):
    """Base of the models of settings; runs of earlier versions are read, see :class:`FormerSetting`."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    former_settings: ClassVar[Mapping[str, FormerSetting]] = {}
    former_names: ClassVar[FormerNames] = NONE
    later_settings: ClassVar[frozenset[str]] = frozenset()
    """Settings that earlier versions did not have; left out of digests where they are None."""

    @model_validator(mode="before")
    @classmethod
    def _without_former_settings(cls, given: Any) -> Any:
        """Read former names; leave out former settings that have the value of the constant, refuse others."""
        if not isinstance(given, Mapping):
            return given
        values = replace_former_names((cls,), given)
        for name, former in cls.former_settings.items():
            if name not in values or name in cls.model_fields:
                continue
            value = values.pop(name)
            if (list(value) if isinstance(value, tuple) else value) != former.value:  # JSON has lists only
                raise ValueError(
                    f"{name} is no setting any more: it is always {former.value}, not {value}; leave it out"
                )
        return values


def json_by_former_names(settings: Settings) -> str:
    """Return the settings as JSON by the names of the last version, for digests that are to stay valid."""
    names = former_names(type(settings))
    former_name = {new: old for old, new in names.fields.items()}
    text = settings.model_dump_json()
    for name in type(settings).model_fields:
        text = text.replace(f'"{name}":', f'"{former_name.get(name, name)}":')
        for old, new in names.values.get(name, {}).items():
            text = text.replace(f'"{name}":"{new}"', f'"{name}":"{old}"')
    return text


def dump_with_former_settings(settings: Settings) -> dict[str, Any]:
    """Return the settings as JSON values, by former names, with the former ones where these were written.

    Digests of settings stay valid by this when a setting is renamed or becomes a constant.
    """
    dumped: dict[str, Any] = {}
    names = former_names(type(settings))
    former_name = {new: old for old, new in names.fields.items()}
    for name, value in settings.model_dump(mode="json").items():
        if value is None and name in settings.later_settings:
            continue
        inner = getattr(settings, name)
        former_value = {new: old for old, new in names.values.get(name, {}).items()}
        if isinstance(inner, Settings):
            # nested models have former names of their own
            dumped[former_name.get(name, name)] = dump_with_former_settings(inner)
        else:
            dumped[former_name.get(name, name)] = former_value.get(value, value) if former_value else value
        previous = name
        for constant, former in settings.former_settings.items():
            if former.after == previous:
                dumped[constant] = former.value
                previous = constant  # several constants may have followed one setting
    return dumped

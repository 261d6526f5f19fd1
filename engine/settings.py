"""The base of all models of settings, and what it knows of settings that became constants."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from pydantic import BaseModel, ConfigDict, model_validator


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

    @model_validator(mode="before")
    @classmethod
    def _without_former_settings(cls, given: Any) -> Any:
        """Leave out former settings that have the value of the constant; refuse other values."""
        if not isinstance(given, Mapping):
            return given
        kept = dict(given)
        for name, former in cls.former_settings.items():
            if name not in kept or name in cls.model_fields:
                continue
            value = kept.pop(name)
            if (list(value) if isinstance(value, tuple) else value) != former.value:
                raise ValueError(
                    f"{name} is no setting any more: it is always {former.value}, not {value}; leave it out"
                )
        return kept


def dump_with_former_settings(settings: Settings) -> dict[str, Any]:
    """Return the settings as JSON values, with the former ones where earlier versions wrote them.

    Digests of settings stay valid by this when a setting becomes a constant.
    """
    dumped: dict[str, Any] = {}
    for name, value in settings.model_dump(mode="json").items():
        inner = getattr(settings, name)
        dumped[name] = dump_with_former_settings(inner) if isinstance(inner, Settings) else value
        previous = name
        for former_name, former in settings.former_settings.items():
            if former.after == previous:
                dumped[former_name] = former.value
                previous = former_name
    return dumped

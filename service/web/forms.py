"""Forms of the job kinds, in three groups: basic, advanced and experimental settings."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

from octasplat.engine.settings.preset_names import PRESETS
from octasplat.engine.train.config import preset
from octasplat.service.web.form_fields import DEFAULT_FILE_NAMES, FormField, form_fields
from octasplat.workers.worker.job_kinds import JobKind

_FIRST_FIELDS = (
    "preset", "poses", "max_side", "minutes", "exports", "files",
    "train.iterations", "train.max_gaussians", "train.sh_degree",
)  # fmt: skip
"""Basic settings that come before the others."""
_SHORT_TITLES = {
    "evaluate": "Measure it again",
    "export": "Write other formats",
    "render": "Render a video or images",
    "material": "Change materials",
}
"""What to do with a result, shorter than the kinds say it; a kind that is not here keeps its own title."""
KINDS_WITH_OWN_FORM = ("relight",)
"""Kinds with a form that is made by hand."""


@dataclass
class Section:
    """A section of a form: settings that belong together."""

    title: str
    fields: list[FormField] = field(default_factory=list)


@dataclass(frozen=True)
class OptionsForm:
    """The form of a job kind.

    Attributes:
        kind: name of the kind of job.
        title: what it does.
        first: basic settings, which are open.
        more: advanced settings, which are folded.
        experimental: experiments, which are folded.
    """

    kind: str
    title: str
    first: list[FormField]
    more: list[Section]
    experimental: list[FormField]


def options_form(
    kind: JobKind, unwritable: Collection[str] = (), limits: Mapping[str, int] = MappingProxyType({})
) -> OptionsForm:
    """Return the form of a kind of job.

    Args:
        kind: which.
        unwritable: formats whose files are marked and cannot be chosen.
        limits: of numbers, by their paths.
    """
    schema = kind.user_options.model_json_schema()
    presets = _preset_values(schema)
    fields = [
        _cap_limits(_mark_unwritable(item, unwritable), limits) for item in form_fields(schema, presets)
    ]
    basic = {item.path: item for item in fields if item.group == "basic"}
    order = [name for name in _FIRST_FIELDS if name in basic] if presets else []
    sections: dict[str, Section] = {}
    for item in fields:
        if item.group == "advanced":
            title = item.path.rpartition(".")[0]
            sections.setdefault(title, Section(_section_title(title))).fields.append(item)
    return OptionsForm(
        kind.name,
        _SHORT_TITLES.get(kind.name, kind.title),
        [basic[name] for name in dict.fromkeys((*order, *basic))],
        [sections[name] for name in sorted(sections)],
        [item for item in fields if item.group == "experimental"],
    )


def _mark_unwritable(item: FormField, unwritable: Collection[str]) -> FormField:
    if item.control != "files" or not unwritable:
        return item
    lacking = {DEFAULT_FILE_NAMES[name] for name in unwritable if name in DEFAULT_FILE_NAMES}
    return replace(
        item, choices=tuple(replace(choice, lacking=choice.value in lacking) for choice in item.choices)
    )


def _cap_limits(item: FormField, limits: Mapping[str, int]) -> FormField:
    ceiling = limits.get(item.path)
    if ceiling is None:
        return item
    return replace(item, high=ceiling if item.high is None else min(item.high, ceiling))


def _section_title(path: str) -> str:
    words = {"": "More", "train": "Training", "train.trace": "Rays"}
    return words.get(path, path.rpartition(".")[2].replace("_", " ").capitalize())


def _preset_values(schema: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the training settings of each preset, if the kind has presets."""
    if "preset" not in schema["properties"]:
        return {}
    return {name: {"train": preset(name).model_dump(mode="json")} for name in PRESETS}

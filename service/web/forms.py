"""Forms from JSON Schema: the options of a kind of job, field by field."""

import json
import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, Literal

from octasplat.engine.files import exporters
from octasplat.engine.train.config import preset
from octasplat.engine.train.preset_names import PRESETS
from octasplat.workers.work.kinds import JobKind

Control = Literal["choice", "yes_no", "whole", "number", "text", "list", "files"]

_FIRST = ("preset", "poses", "max_side", "minutes", "exports", "files")
_FIRST_OF_TRAINING = ("train.iterations", "train.max_gaussians", "train.sh_degree")
_WORTH_OFFERING = {
    "glb": "mesh.glb",
    "mesh-ply": "mesh.ply",
    "obj": "mesh.obj",
    "spz": "scene.spz",
    "sog": "scene.sog",
    "splat": "scene.splat",
    "khr-glb": "scene.splats.glb",
    "usd": "scene.usdz",
}
"""A file name by format."""
_LABELS = {
    "max_side": "Longest side, px",
    "minutes": "Minutes of training",
    "max_gaussians": "Most Gaussians",
    "test_every": "Hold out every n-th view",
    "exports": "Files to write",
    "files": "Files to write",
    "sh_degree": "Spherical harmonics, degree",
    "fps": "Images per second",
    "q": "Squared octagon radius, standard deviations",
    "set.albedo": "Base colour",
    "scale.albedo": "Base colour, times",
    "scale.metallic": "Metallic, times",
    "scale.roughness": "Roughness, times",
}
_TITLES = {
    "evaluate": "Measure it again",
    "export": "Write other formats",
    "render": "Render a video or images",
    "material": "Change materials",
}
"""What to do with a result, shorter than the kinds say it; a kind that is not here keeps its own title."""
WITHOUT_FORM = ("relight",)
"""Kinds that need files of their own, which no form here asks for."""
_FORMS_OF_THEIR_OWN = ("stage", "photographs")
_SHORT = re.compile(r"\b(sh|ssim|l1|l2|fov)\b", re.IGNORECASE)
_CHOICES = {
    ("poses", "given"): "use the COLMAP model",
    ("poses", "auto"): "find them",
    ("poses", "missing"): "use the model, else find them",
}
_HELPS = {
    "preset": "fast is a first look, standard is better, paper has the published settings and is slow.",
    "poses": "Where the camera poses come from; those of a model that matches contradict are found anew.",
    "max_side": "Photographs are shrunk to this; empty keeps their size.",
    "minutes": "Decides iterations and Gaussians by the machine's pace; empty leaves them to the preset.",
    "train.iterations": "More takes longer and gets sharper; 0 asks the photographs' pixels.",
    "train.max_gaussians": "More shows finer detail and makes larger files; 0 asks the photographs' pixels.",
    "train.sh_degree": "How much colours may change with the direction of view: 0 not at all.",
}
"""For settings that most people meet, words that need no other page."""
_ATTRIBUTE = re.compile(r"^ {0,8}(\w+): (.*)$")


@dataclass(frozen=True)
class Choice:
    """One of several values: what is sent, what is shown, and whether nobody can do it."""

    value: str
    text: str
    lacking: bool = False


@dataclass(frozen=True)
class Field:
    """One setting.

    Attributes:
        path: where it goes in the options, with dots.
        label: its name for people.
        control: how it is asked for.
        help: what it does.
        choices: for ``choice`` and ``files``.
        default: as text; an empty field means it.
        defaults: JSON of the default by preset, where that differs.
        low: smallest value.
        high: largest value.
        required: whether it has to be given.
    """

    path: str
    label: str
    control: Control
    help: str
    choices: tuple[Choice, ...] = ()
    default: str = ""
    defaults: str = ""
    low: float | None = None
    high: float | None = None
    required: bool = False

    @property
    def name(self) -> str:
        """For ids in the page."""
        return self.path.replace(".", "-")


@dataclass
class Section:
    """Settings that belong together."""

    title: str
    fields: list[Field] = field(default_factory=list)


@dataclass(frozen=True)
class OptionsForm:
    """A form: what most people set, and everything else."""

    kind: str
    title: str
    first: list[Field]
    more: list[Section]


def options_form(
    kind: JobKind, unwritable: Collection[str] = (), ceilings: Mapping[str, int] = MappingProxyType({})
) -> OptionsForm:
    """The form of a kind of job.

    Args:
        kind: which.
        unwritable: formats whose files are marked and cannot be chosen.
        ceilings: of numbers, by their paths.
    """
    schema = kind.options.model_json_schema()
    presets = _preset_values(schema)
    # The schema has the docstring of the class alone, not those that it inherits from.
    docstring = "\n".join(cls.__doc__ or "" for cls in reversed(kind.options.__mro__[:-1]))
    walked = _walk(schema, {**schema, "description": docstring}, "", presets)
    fields = [_capped(_marked(item, unwritable), ceilings) for item in walked]
    names = [*_FIRST, *_FIRST_OF_TRAINING] if presets else [f.path for f in fields]
    by_path = {f.path: f for f in fields}
    first = [by_path[name] for name in names if name in by_path]
    sections: dict[str, Section] = {}
    for item in fields:
        if item in first:
            continue
        title = item.path.rpartition(".")[0]
        sections.setdefault(title, Section(_section_title(title))).fields.append(item)
    return OptionsForm(
        kind.name, _TITLES.get(kind.name, kind.title), first, [sections[name] for name in sorted(sections)]
    )


def _marked(item: Field, unwritable: Collection[str]) -> Field:
    if item.control != "files" or not unwritable:
        return item
    lacking = {_WORTH_OFFERING[name] for name in unwritable if name in _WORTH_OFFERING}
    return replace(
        item, choices=tuple(replace(choice, lacking=choice.value in lacking) for choice in item.choices)
    )


def _capped(item: Field, ceilings: Mapping[str, int]) -> Field:
    ceiling = ceilings.get(item.path)
    if ceiling is None:
        return item
    return replace(item, high=ceiling if item.high is None else min(item.high, ceiling))


def _label(name: str) -> str:
    words = name.replace("_", " ").removesuffix(" px").capitalize()
    return _SHORT.sub(lambda found: found[0].upper(), words)


def _section_title(path: str) -> str:
    words = {"": "Photographs and evaluation", "train": "Training", "train.trace": "Rays"}
    return words.get(path, path.rpartition(".")[2].replace("_", " ").capitalize())


def _preset_values(schema: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """The training settings of each preset, if the kind has presets."""
    if "preset" not in schema["properties"]:
        return {}
    return {name: {"train": preset(name).model_dump(mode="json")} for name in PRESETS}


def _walk(
    root: Mapping[str, Any], schema: Mapping[str, Any], prefix: str, presets: Mapping[str, Mapping[str, Any]]
) -> Iterator[Field]:
    helps = _attribute_texts(schema.get("description", ""))
    required = set(schema.get("required", ()))
    for name, raw in schema["properties"].items():
        given = _resolved(root, raw)
        path = f"{prefix}{name}"
        if path in _FORMS_OF_THEIR_OWN or _is_file(given):
            continue
        if "oneOf" in given:  # one of several sections, told apart by their kind
            yield from _variants(root, given, path, presets)
        elif "properties" in given:
            yield from _walk(root, given, f"{path}.", presets)
        elif "const" not in given:
            text = given.get("description") or helps.get(name, "")
            yield _field(path, given, raw.get("default"), text, presets, name in required)


def _is_file(schema: Mapping[str, Any]) -> bool:
    """Return whether a field names files that are sent along, which no form here asks for."""
    return schema.get("items", schema).get("format") == "octasplat-file"


def _variants(
    root: Mapping[str, Any], given: Mapping[str, Any], path: str, presets: Mapping[str, Mapping[str, Any]]
) -> Iterator[Field]:
    kinds: list[Choice] = []
    inner: dict[str, tuple[Field, list[str]]] = {}
    for reference in given["oneOf"]:
        variant = _resolved(root, reference)
        kind = str(variant["properties"]["kind"]["const"])
        kinds.append(Choice(kind, kind))
        for item in _walk(root, variant, f"{path}.", presets):
            inner.setdefault(item.path, (item, []))[1].append(kind)
    label = path.rpartition(".")[2].capitalize()
    values = {name: _at(values, f"{path}.kind") for name, values in presets.items()}
    yield Field(
        f"{path}.kind", label, "choice", "How Gaussians come and go.", tuple(kinds), defaults=_json(values)
    )
    for item, users in inner.values():
        only = "" if len(users) == len(kinds) else f"Only for {' and '.join(users)}"
        yield replace(item, help=": ".join(text for text in (only, item.help) if text))


def _field(
    path: str,
    schema: Mapping[str, Any],
    default: object,
    text: str,
    presets: Mapping[str, Mapping[str, Any]],
    required: bool,
) -> Field:
    name = path.rpartition(".")[2]
    by_preset = {key: _at(values, path) for key, values in presets.items()}
    by_preset = {key: value for key, value in by_preset.items() if value is not _MISSING}
    low = schema.get("minimum", schema.get("exclusiveMinimum"))
    high = schema.get("maximum", schema.get("exclusiveMaximum"))
    choices: tuple[Choice, ...] = ()
    control: Control = "text"
    if "enum" in schema:
        control, choices = "choice", tuple(_choice(name, str(value)) for value in schema["enum"])
    elif schema.get("type") == "boolean":
        control = "yes_no"
    elif schema.get("type") == "integer":
        control = "whole"
    elif schema.get("type") == "number":
        control = "number"
    elif schema.get("type") == "array" and name in ("exports", "files"):
        control, choices = "files", _file_choices()
    elif schema.get("type") == "array":
        control = "list"
    return Field(
        path=path,
        label=_LABELS.get(path) or _LABELS.get(name) or _label(name),
        control=control,
        help=words if presets and (words := _HELPS.get(path)) else _sentence(text),
        choices=choices,
        default=_shown(default),
        defaults=_json(by_preset) if len(set(map(_shown, by_preset.values()))) > 1 else "",
        low=low,
        high=high,
        required=required,
    )


def _sentence(text: str) -> str:
    """Words of the code as words of a form, where None is an empty field."""
    return text[:1].upper() + re.sub(r"\bNone\b", "empty", text[1:])


def _choice(name: str, value: str) -> Choice:
    return Choice(value, _CHOICES.get((name, value), value.replace("_", " ")))


def _file_choices() -> tuple[Choice, ...]:
    found = {exporter.name: exporter.description for exporter in exporters()}
    return tuple(Choice(file, found[name]) for name, file in _WORTH_OFFERING.items() if name in found)


def _resolved(root: Mapping[str, Any], schema: Mapping[str, Any]) -> Mapping[str, Any]:
    """The schema with its reference followed, and with the null of an optional value left out."""
    if "$ref" in schema:
        target: Mapping[str, Any] = root["$defs"][schema["$ref"].rpartition("/")[2]]
        return {**target, **{key: value for key, value in schema.items() if key != "$ref"}}
    if "anyOf" in schema:
        others = [option for option in schema["anyOf"] if option.get("type") != "null"]
        if len(others) == 1:
            rest = {key: value for key, value in schema.items() if key != "anyOf"}
            return {**_resolved(root, others[0]), **rest}
    return schema


def _attribute_texts(docstring: str) -> dict[str, str]:
    """What the section ``Attributes`` of a docstring says of each."""
    texts: dict[str, str] = {}
    for part in docstring.split("Attributes:")[1:]:
        current = ""
        for line in part.splitlines():
            found = _ATTRIBUTE.match(line)
            if found:
                current = found[1]
                texts[current] = found[2]
            elif current and line.strip():
                texts[current] += f" {line.strip()}"
            elif current:
                break  # the section ends with the first empty line
    return {name: text.replace("``", "'") for name, text in texts.items()}


_MISSING = object()


def _at(values: Mapping[str, Any], path: str) -> Any:
    """The value at a dotted path."""
    found: Any = values
    for part in path.split("."):
        if not isinstance(found, Mapping) or part not in found:
            return _MISSING
        found = found[part]
    return found


def _shown(value: object) -> str:
    if value is None or isinstance(value, dict):
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list | tuple):
        return ", ".join(str(item) for item in value)
    return f"{value:g}" if isinstance(value, float) else str(value)


def _json(values: Mapping[str, object]) -> str:
    return json.dumps({name: _shown(value) for name, value in values.items() if value is not _MISSING})

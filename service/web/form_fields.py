"""Fields of forms, generated from the JSON Schema of options: one for each setting."""

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, cast

from octasplat.engine.files import exporters
from octasplat.engine.runs.result_files import RESULT_FILES
from octasplat.engine.settings.fields import SettingLevel

Control = Literal[
    "choice", "yes_no", "whole", "number", "text", "document", "list", "numbers", "json", "files",
    "upload", "uploads",
]  # fmt: skip

DEFAULT_FILE_NAMES = {
    **{file.format: file.name for file in RESULT_FILES},
    "spz": "scene.spz",
    "sog": "scene.sog",
    "streamed-sog": "lod-meta.json",
    "3d-tiles": "tileset.json",
    "splat": "scene.splat",
    "khr-glb": "scene.splats.glb",
    "usd": "scene.usdz",
    "surface-usdz": "surface.usdz",
}
"""A file name by format."""
_LABELS = {
    "max_side": "Longest side",
    "minutes": "Minutes of training",
    "max_gaussians": "Most Gaussians",
    "test_every": "Hold out every n-th view",
    "exports": "Files to write",
    "files": "Files to write",
    "sh_degree": "Spherical harmonics, degree",
    "fps": "Images per second",
    "q": "Squared octagon radius",
    "where": "Where",
    "materials.learn": "Learn materials and light",
    "set.albedo": "Base color",
    "multiply.albedo": "Base color, times",
    "multiply.metallic": "Metallic, times",
    "multiply.roughness": "Roughness, times",
}
_HIDDEN_OPTIONS = ("stage", "photographs", "camera_path")
"""Options that forms of their own, or the viewer, ask for."""
_ASSIGNMENTS_OPTION = "set"
"""Settings by name, which a form has as fields."""
_ACRONYMS = re.compile(r"\b(sh|ssim|l1|l2|fov)\b", re.IGNORECASE)
_UNIT_IN_NAME = re.compile(r" (px|degrees|db|gb)$")
_CHOICES = {
    ("poses", "given"): "use the COLMAP model",
    ("poses", "auto"): "find them",
    ("poses", "missing"): "use the model, else find them",
}

Presets = Mapping[str, Mapping[str, Any]]


@dataclass(frozen=True)
class Choice:
    """One of several values: the value, its label, and whether it is unavailable."""

    value: str
    text: str
    lacking: bool = False


@dataclass(frozen=True)
class FormField:
    """A form field for one setting.

    Attributes:
        path: where it goes in the options, with dots.
        label: its name for people.
        control: how it is asked for.
        help: what it does.
        unit: unit of a number.
        group: how many users need it.
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
    unit: str = ""
    group: SettingLevel = "basic"
    choices: tuple[Choice, ...] = ()
    default: str = ""
    defaults: str = ""
    low: float | None = None
    high: float | None = None
    required: bool = False

    @property
    def name(self) -> str:
        """Return the name for ids in the page."""
        return self.path.replace(".", "-")


def form_fields(schema: Mapping[str, Any], presets: Presets) -> Iterator[FormField]:
    """Yield the field of each setting of a JSON Schema.

    Args:
        schema: of the options.
        presets: values of the options by preset, for options that begin from one.
    """
    yield from _walk_schema(schema, schema, "", presets)


def label_of(name: str) -> str:
    """Return an identifier as words."""
    words = _UNIT_IN_NAME.sub("", name.replace("_", " ")).capitalize()
    return _ACRONYMS.sub(lambda found: found[0].upper(), words)


def _walk_schema(
    root: Mapping[str, Any], schema: Mapping[str, Any], prefix: str, presets: Presets
) -> Iterator[FormField]:
    required = set(schema.get("required", ()))
    for name, raw in schema["properties"].items():
        given = _resolve_reference(root, raw)
        path = f"{prefix}{name}"
        is_list_of_settings = path == _ASSIGNMENTS_OPTION and "properties" not in given
        if path in _HIDDEN_OPTIONS or is_list_of_settings or "shortcut" in given:
            continue
        if "oneOf" in given:  # one of several sections, told apart by their kind
            yield from _variant_fields(root, given, path, presets)
        elif "properties" in given:
            yield from _walk_schema(root, given, f"{path}.", presets)
        elif "const" not in given:
            yield _form_field(path, given, raw.get("default"), presets, name in required)


def _variant_fields(
    root: Mapping[str, Any], schema: Mapping[str, Any], path: str, presets: Presets
) -> Iterator[FormField]:
    kinds: list[Choice] = []
    inner: dict[str, tuple[FormField, list[str]]] = {}
    for reference in schema["oneOf"]:
        variant = _resolve_reference(root, reference)
        kind = str(variant["properties"]["kind"]["const"])
        kinds.append(Choice(kind, kind))
        for item in _walk_schema(root, variant, f"{path}.", presets):
            # A field that several variants have is shown once.
            inner.setdefault(item.path, (item, []))[1].append(kind)
    values = {name: _value_at(values, f"{path}.kind") for name, values in presets.items()}
    yield FormField(
        f"{path}.kind",
        path.rpartition(".")[2].capitalize(),
        "choice",
        _help_sentence(schema.get("description", "")),
        group="advanced",
        choices=tuple(kinds),
        defaults=_defaults_json(values),
    )
    for item, users in inner.values():
        only = "" if len(users) == len(kinds) else f"Only for {' and '.join(users)}"
        yield replace(item, help=": ".join(text for text in (only, item.help) if text))


def _form_field(
    path: str, schema: Mapping[str, Any], default: object, presets: Presets, required: bool
) -> FormField:
    name = path.rpartition(".")[2]
    by_preset = {key: _value_at(values, path) for key, values in presets.items()}
    by_preset = {key: value for key, value in by_preset.items() if value is not _MISSING}
    control, values = _control_for(name, schema)
    choices = _file_choices() if control == "files" else tuple(_make_choice(name, value) for value in values)
    return FormField(
        path=path,
        label=_LABELS.get(path) or _LABELS.get(name) or label_of(name),
        control=control,
        help=_help_sentence(schema.get("description", "")),
        unit=schema.get("unit", ""),
        group=cast(SettingLevel, schema.get("group", "basic")),
        choices=choices,
        default=_display_text(default),
        defaults=_defaults_json(by_preset) if len(set(map(_display_text, by_preset.values()))) > 1 else "",
        low=schema.get("minimum", schema.get("exclusiveMinimum")),
        high=schema.get("maximum", schema.get("exclusiveMaximum")),
        required=required,
    )


def _control_for(name: str, schema: Mapping[str, Any]) -> tuple[Control, Sequence[str]]:
    """Return the control of a value, and the values to choose from."""
    if "enum" in schema:
        return "choice", [str(value) for value in schema["enum"]]
    if "anyOf" in schema:
        return _control_of_several(schema["anyOf"])
    kind = schema.get("type")
    if kind == "array":
        return _control_of_array(name, schema), ()
    if schema.get("format") == "octasplat-file":
        return "upload", ()
    plain: Mapping[Any, Control] = {"boolean": "yes_no", "integer": "whole", "number": "number"}
    return plain.get(kind, "text"), ()


def _control_of_array(name: str, schema: Mapping[str, Any]) -> Control:
    items = schema.get("prefixItems") or [schema.get("items", {})]
    kinds = {item.get("type") for item in items}
    if items[0].get("format") == "octasplat-file":
        return "uploads"
    if name in ("exports", "files"):
        return "files"
    if kinds <= {"number", "integer"}:
        return "numbers"
    return "list" if kinds == {"string"} else "json"


def _control_of_several(options: Sequence[Mapping[str, Any]]) -> tuple[Control, Sequence[str]]:
    """Return the control of a union of types: a choice where all values are known, else text."""
    # a file is chosen, whatever else programs may send in its place
    if any(option.get("format") == "octasplat-file" for option in options):
        return "upload", ()
    values: list[str] = []
    for option in options:
        if option.get("type") == "null":
            continue
        if option.get("type") == "boolean":
            values += ["true", "false"]
        elif "const" in option or "enum" in option:
            values += map(str, option.get("enum", [option.get("const")]))
        else:
            return ("document" if any("$ref" in other for other in options) else "text"), ()
    return "choice", values


def _help_sentence(text: str) -> str:
    """Return the description as a form shows it, where None is an empty field."""
    return text[:1].upper() + re.sub(r"\bNone\b", "empty", text[1:])


def _make_choice(name: str, value: str) -> Choice:
    yes_no = {"true": "yes", "false": "no"}
    return Choice(value, _CHOICES.get((name, value)) or yes_no.get(value) or value.replace("_", " "))


def _file_choices() -> tuple[Choice, ...]:
    found = {exporter.name: exporter.description for exporter in exporters()}
    return tuple(Choice(file, found[name]) for name, file in DEFAULT_FILE_NAMES.items() if name in found)


def _resolve_reference(root: Mapping[str, Any], schema: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the schema with its reference followed, and with the null of an optional value left out."""
    if "$ref" in schema:
        target: Mapping[str, Any] = root["$defs"][schema["$ref"].rpartition("/")[2]]
        # What stands beside a reference, such as a description, wins over what it leads to.
        return {**target, **{key: value for key, value in schema.items() if key != "$ref"}}
    if "anyOf" in schema:
        others = [option for option in schema["anyOf"] if option.get("type") != "null"]
        if len(others) == 1:
            rest = {key: value for key, value in schema.items() if key != "anyOf"}
            return {**_resolve_reference(root, others[0]), **rest}
    return schema


_MISSING = object()


def _value_at(values: Mapping[str, Any], path: str) -> Any:
    """Return the value at a dotted path."""
    found: Any = values
    for part in path.split("."):
        if not isinstance(found, Mapping) or part not in found:
            return _MISSING
        found = found[part]
    return found


def _display_text(value: object) -> str:
    if value is None or isinstance(value, dict):
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list | tuple):
        return ", ".join(str(item) for item in value)
    return f"{value:g}" if isinstance(value, float) else str(value)


def _defaults_json(values: Mapping[str, object]) -> str:
    return json.dumps({name: _display_text(value) for name, value in values.items() if value is not _MISSING})

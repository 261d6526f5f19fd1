"""Faults of stage files as sentences. Imports neither torch nor numba."""

import json
from collections.abc import Mapping, Sequence
from typing import Any

from pydantic import BaseModel

from octasplat.engine.pathtracing.stage.materials import TEXTURE_KEYS
from octasplat.engine.pathtracing.stage.model import Environment, Stage, StageGaussians
from octasplat.engine.pathtracing.stage.value_forms import form_of_schema
from octasplat.engine.settings.nearest_names import nearest_name
from octasplat.engine.settings.refusals import path_in_model

_LONGEST_VALUE = 60
_COLOR = 'three display values from 0 to 1, such as [0.8, 0.5, 0.2], or a text such as "#cc8033"'
_VECTOR = "three numbers, such as [0, 0, 1]"
_FORMS = {
    **dict.fromkeys(("color_srgb", "tint_srgb", "emission_srgb"), _COLOR),
    **dict.fromkeys(("up", "position", "rotation_degrees", "direction", "origin"), _VECTOR),
    "absorption": "three numbers of 0 or more, such as [0.4, 0.1, 0.02]",
    "scale": "one positive number, or three of them, such as [1, 1, 2]",
    "pixel": "two numbers, the column and the row",
    "file": 'the name of a file, such as "thing.glb"',
    "view": 'the name of a photograph, such as "0001.jpg"',
    **dict.fromkeys(TEXTURE_KEYS, 'the name of an image, such as "wood.png"'),
}
"""What the values of some keys look like; of others their types say it."""
_FORMS_OF_MODELS: Mapping[tuple[type[BaseModel], str], str] = {
    (Environment, "rotation_degrees"): "one number",
    (Environment, "file"): 'the name of a file, such as "studio.hdr"',
    (StageGaussians, "scale"): "one positive number",
    (StageGaussians, "file"): 'the name of a file, such as "thing.ply"',
}
_LISTS = ("meshes", "lights", "gaussians")
_TABLES = {
    "material": 'such as { kind = "glass" }',
    "on": 'such as { view = "0001.jpg", pixel = [200, 300] }',
}
"""What tables that stand in a line look like."""
_NO_TABLE = ("model_type", "model_attributes_type", "dict_type")


def stage_error(fault: Mapping[str, Any], prefix: Sequence[str] = ()) -> tuple[tuple[str | int, ...], str]:
    """Return the keys at which pydantic found a fault in a stage, and a sentence that names them.

    The kinds of a union stand in pydantic's location, too, but are no keys of the file.

    Args:
        fault: one of the errors of a validation by :class:`Stage`.
        prefix: keys above the stage.
    """
    location, value = fault["loc"], fault.get("input")
    is_unknown = fault["type"] == "extra_forbidden"
    path, models, _ = path_in_model(Stage, location[:-1] if is_unknown else location)
    if is_unknown:
        path = (*path, location[-1])
    elif fault["type"] == "missing" and isinstance(path[-1], int):  # a number of a vector
        path, fault = path[:-1], {**fault, "type": "too_short"}
    keys = (*prefix, *path)
    key = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in keys).removeprefix(".")
    if is_unknown:
        known = [name for model in models or (Stage,) for name in model.model_fields]
        name = str(location[-1]).replace("colour", "color")
        nearest = nearest_name(name, known) or next((each for each in known if each.startswith(name)), None)
        others = (
            "see docs/light.md for those that there are" if nearest is None else f"the nearest is {nearest}"
        )
        return keys, f"there is no key {key}; {others}."
    return keys, f"{key or 'the stage'}: {_complaint(fault, path, value)}."


def _complaint(fault: Mapping[str, Any], path: Sequence[str | int], value: object) -> str:
    """Return what is wrong with a value."""
    kind, name = fault["type"], str(path[-1]) if path else ""
    if kind == "union_tag_not_found":
        return "has no `kind`, which says what it is; see docs/light.md for the kinds"
    if kind == "union_tag_invalid":
        return f"there is no kind {fault['ctx']['tag']!r}; choose one of {fault['ctx']['expected_tags']}"
    if kind == "value_error":
        return str(fault["msg"]).removeprefix("Value error, ")
    if kind == "too_long" and name in (*_LISTS, "keys"):
        return f"has {fault['ctx']['actual_length']} entries; give at most {fault['ctx']['max_length']}"
    if kind == "tuple_type" and name in _LISTS:
        shown = "" if isinstance(value, Mapping) else _shown(value)
        return f"is a list; write [[{name}]] with two brackets{shown}"
    if kind == "tuple_type" and name == "keys":
        return f"is a list of tables, such as [{{ frame = 0, position = [0, 0, 0] }}]{_shown(value)}"
    if kind in _NO_TABLE and len(path) == 1:
        return f"is one table; write [{name}] with single brackets, and its keys below"
    if kind in _NO_TABLE:
        return f"is a table{', ' * (name in _TABLES)}{_TABLES.get(name, '')}{_shown(value)}"
    if not path:
        return str(fault["msg"])
    form = _form(path, fault)
    if kind == "missing":
        return f"is missing; give {form}"
    return f"must be {form}{_shown(value)}"


def _form(path: Sequence[str | int], fault: Mapping[str, Any]) -> str:
    """Return what the value of a key looks like; of a single number of a list, what that is."""
    is_number_of_list = isinstance(path[-1], int)
    keys = path[:-1] if is_number_of_list else path
    _, models, kind = path_in_model(Stage, fault["loc"][: _depth(fault["loc"], keys[-1])])
    owners = [model for model in models or (Stage,) if keys[-1] in model.model_fields]
    # of a union the kind tells which
    owner = next((one for one in owners if kind and one.model_fields["kind"].default == kind), owners[0])
    name = str(keys[-1])
    if not is_number_of_list and (form := _FORMS_OF_MODELS.get((owner, name), _FORMS.get(name))):
        return form
    schema = owner.model_json_schema()["properties"][name]
    form = form_of_schema(schema, of_item=is_number_of_list)
    return form.replace("a number", "a finite number", 1) if fault["type"] == "finite_number" else form


def _depth(location: Sequence[str | int], name: str | int) -> int:
    """Return where in pydantic's location a key stands, the last of its name."""
    return len(location) - 1 - list(reversed(location)).index(name)


def _shown(value: object) -> str:
    """Return a value, about as TOML has it, in brackets behind a sentence, cut where it is long."""
    try:
        text = json.dumps(value, ensure_ascii=False)
    except (TypeError, ValueError):
        text = str(value)
    return f" (it is {text.replace('NaN', 'nan').replace('Infinity', 'inf')[:_LONGEST_VALUE]})"

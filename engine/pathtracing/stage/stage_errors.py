"""Faults of stage files as sentences. Imports neither torch nor numba."""

from collections.abc import Mapping, Sequence
from typing import Any

from octasplat.engine.pathtracing.stage.model import Stage
from octasplat.engine.settings.nearest_names import nearest_name
from octasplat.engine.settings.refusals import path_in_model

_LONGEST_VALUE = 60
_COLOR = 'three display values from 0 to 1, such as [0.8, 0.5, 0.2], or a text such as "#cc8033"'
_VECTOR = "three numbers, such as [0, 0, 1]"
_FORMS = {
    **dict.fromkeys(("color_srgb", "tint_srgb", "emission_srgb"), _COLOR),
    **dict.fromkeys(("up", "position", "rotation_degrees", "direction", "origin", "absorption"), _VECTOR),
    "scale": "one positive number, or three of them, such as [1, 1, 2]",
    "pixel": "two numbers, the column and the row",
}
"""What the values of some keys look like."""
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
        path = path[:-1]
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
    if kind == "tuple_type" and name in _LISTS and isinstance(value, Mapping):
        return f"is a list; write [[{name}]] with two brackets"
    if kind == "tuple_type" and name == "keys":
        return f"is a list of tables, such as [{{ frame = 0, position = [0, 0, 0] }}]{_shown(value)}"
    if kind in _NO_TABLE and len(path) == 1:
        return f"is one table; write [{name}] with single brackets, and its keys below"
    if kind in _NO_TABLE:
        return f"is a table{', ' * (name in _TABLES)}{_TABLES.get(name, '')}{_shown(value)}"
    if kind in ("tuple_type", "too_short", "too_long", "missing", "float_type") and name in _FORMS:
        return f"is {_FORMS[name]}{_shown(value)}"
    if kind in ("too_long", "missing", "value_error"):
        return str(fault["msg"]).removeprefix("Value error, ")
    return f"{fault['msg']}{_shown(value)}"


def _shown(value: object) -> str:
    """Return a value in brackets behind a sentence, cut where it is long."""
    return f" (it is {str(value)[:_LONGEST_VALUE]})"

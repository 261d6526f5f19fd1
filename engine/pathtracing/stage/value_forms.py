"""What values of a JSON schema look like, in words."""

import json
from collections.abc import Mapping
from typing import Any

_NUMBERS = {"integer": "a whole number", "number": "a number"}


def form_of_schema(schema: Mapping[str, Any], *, of_item: bool = False) -> str:
    """Return what a value looks like, for a sentence that goes on with it.

    Args:
        schema: of the value; where there are several, the first that is not null counts.
        of_item: whether one of the numbers of a list is asked for.

    >>> form_of_schema({"type": "number", "minimum": 0, "maximum": 1})
    'a number from 0 to 1'
    >>> form_of_schema({"anyOf": [{"type": "integer", "minimum": 1}, {"type": "null"}]})
    'a whole number of 1 or more'
    >>> form_of_schema({"enum": ["none", "filmic"]})
    'one of "none", "filmic"'
    """
    kinds = [one for one in schema.get("anyOf", [schema]) if one.get("type") != "null"]
    if of_item:
        items = next(one for one in kinds if one.get("type") == "array")
        return form_of_schema(items["prefixItems"][0] if "prefixItems" in items else items["items"])
    found = kinds[0]
    if "const" in found:
        return json.dumps(found["const"])
    if "enum" in found:
        return f"one of {', '.join(json.dumps(value) for value in found['enum'])}"
    if found.get("type") in _NUMBERS:
        return f"{_NUMBERS[found['type']]}{_range_of(found)}"
    return {"boolean": "true or false", "string": "a text", "array": "a list"}.get(
        found.get("type", ""), "a table"
    )


def _range_of(schema: Mapping[str, Any]) -> str:
    low, high = schema.get("minimum"), schema.get("maximum")
    above, below = schema.get("exclusiveMinimum"), schema.get("exclusiveMaximum")
    if schema["type"] == "integer" and below is not None:
        high, below = below - 1, None
    if low is not None and high is not None:
        return f" from {low:g} to {high:g}" if abs(high) < 1e5 else f" from {low} to {high}"
    lower = f"above {above:g}" if above is not None else f"of {low:g} or more" if low is not None else ""
    upper = f"below {below:g}" if below is not None else f"of {high:g} or less" if high is not None else ""
    return "".join(f" {part}" for part in (lower, "and" if lower and upper else "", upper) if part)

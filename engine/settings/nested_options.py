"""Nested options as mappings, put over each other."""

from collections.abc import Mapping
from typing import Any


def split_dotted_names(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return options whose names may have dots as sections.

    >>> split_dotted_names({"lr.quat": 1, "lr": {"mean": 2}, "iterations": 3})
    {'lr': {'quat': 1, 'mean': 2}, 'iterations': 3}
    """
    result: dict[str, Any] = {}
    for name, value in options.items():
        for part in reversed(name.split(".")[1:]):
            value = {part: value}
        result = merge_options(result, {name.partition(".")[0]: value})
    return result


def merge_options(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """Return ``base`` with the values of ``over``, section by section; another kind of section begins anew.

    >>> merge_options({"rates": {"quat": 1, "mean": 2}}, {"rates": {"quat": 3}})
    {'rates': {'quat': 3, 'mean': 2}}
    """
    result = dict(base)
    for key, value in over.items():
        old = result.get(key)
        if isinstance(old, Mapping) and isinstance(value, Mapping):
            # values of another kind would be unknown to the new one
            is_same = "kind" not in old or value.get("kind", old["kind"]) == old["kind"]
            result[key] = merge_options(old, value) if is_same else value
        else:
            result[key] = value
    return result

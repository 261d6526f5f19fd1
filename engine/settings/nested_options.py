"""Nested options as mappings, put over each other."""

from collections.abc import Mapping
from typing import Any


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

"""The verbs by name."""

from functools import cache
from importlib import import_module
from typing import Any

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.operations.base import Operation

_MODULES = {
    "reconstruct": "reconstruct",
    "estimate": "estimate",
    "plan": "plan",
    "evaluate": "evaluate",
    "info": "info",
    "surface": "surface",
    "material": "material",
    "render": "render",
    "relight": "relight",
    "stage-init": "stage_init",
    "export": "export",
    "import": "import_",
    "edit": "edit",
    "deform": "deform",
    "transform": "transform",
    "crop": "crop",
    "merge": "merge",
    "clean": "clean",
    "simplify": "simplify",
}
"""Module of each verb, in the order in which users meet them."""


def operation_names() -> tuple[str, ...]:
    """Return the names of all verbs."""
    return tuple(_MODULES)


@cache
def operation(name: str) -> Operation[Any, Any]:
    """Return the operation of that name.

    Raises:
        ConfigError: there is none.
    """
    if name not in _MODULES:
        raise ConfigError(f"There is no operation '{name}'; choose one of {', '.join(_MODULES)}.")
    # imported when it is asked for: a command loads no other verb's modules
    found: Operation[Any, Any] = import_module(f"octasplat.engine.operations.{_MODULES[name]}").OPERATION
    return found


def operations() -> tuple[Operation[Any, Any], ...]:
    """Return all operations, in the order of the documentation."""
    return tuple(map(operation, _MODULES))

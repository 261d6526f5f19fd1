"""Child processes of octasplat that import nothing from the current folder or ``PYTHONPATH``.

``python -m module`` searches the current folder first, where a file may have the name of a module we import.
The processes started here run with ``-E -P`` instead and find the packages of the starting process, and the
further modules that the caller names. This file is also the script that is run; it imports nothing of ours.
"""

import importlib.util
import os
import runpy
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

ROOT = Path(__file__).absolute().parents[3]
"""Folder that the package is imported from: ``src`` of a checkout, or where a wheel was unpacked."""
_FLAGS = ("-E", "-P")
"""Neither variables such as PYTHONPATH nor the current folder; a user's own installation stays."""


def python_command(module: str, *arguments: str, further_modules: Sequence[str] = ()) -> tuple[str, ...]:
    """Return the command that runs a module of octasplat in a process of its own, from any working folder.

    Args:
        module: what ``python -m`` would be told.
        arguments: of the program.
        further_modules: modules that are to be found as this process finds them. Their folders are searched
            last, so that nothing in them takes the place of anything else.
    """
    later = os.pathsep.join(dict.fromkeys(filter(None, map(_folder_of, further_modules))))
    return (
        sys.executable,
        *_FLAGS,
        str(Path(__file__).absolute()),
        str(ROOT),
        later,
        "-m",
        module,
        *arguments,
    )


def drop_python_variables(environment: Mapping[str, str]) -> dict[str, str]:
    """Return the environment without ``PYTHON*`` variables, for processes that start Python themselves.

    >>> drop_python_variables({"PATH": "/bin", "PYTHONPATH": "/tmp/modules"})
    {'PATH': '/bin'}
    """
    return {name: value for name, value in environment.items() if not name.startswith("PYTHON")}


def _folder_of(module: str) -> str:
    """Return the folder from which a module is imported; empty if there is no such module or folder."""
    try:
        spec = importlib.util.find_spec(module)
    except (ImportError, ValueError):  # ValueError: a module without a spec, as __main__ can be
        return ""
    if spec is None or spec.origin is None or not Path(spec.origin).is_file():
        return ""
    path = Path(spec.origin).absolute()
    path = path.parent if spec.submodule_search_locations is not None else path
    return str(path.parents[module.count(".")])


def _run() -> None:
    first, later, _, module = sys.argv[1:5]
    if not any(Path(folder).exists() and Path(folder).samefile(first) for folder in sys.path):
        sys.path.insert(0, first)
    sys.path += filter(None, later.split(os.pathsep))
    sys.argv[1:5] = []
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    _run()

"""The examples of the docstrings run, and there is one for everything public."""

import doctest
import importlib
import inspect
from pathlib import Path

import pytest

import octasplat
import octasplat.client

NEEDS_MORE = {"octasplat.client"}
"""Examples that need a service run beside its tests."""
PUBLIC = [name for name in octasplat.__all__ if not name.startswith("__")]
MODULES = sorted(
    f"octasplat.{path.stem}"
    for path in Path(octasplat.__file__).parent.glob("*.py")
    if path.stem not in ("__init__", "__main__")
)


@pytest.mark.usefixtures("in_folder")
@pytest.mark.parametrize("module", [name for name in ("octasplat", *MODULES) if name not in NEEDS_MORE])
def test_examples_of_a_module_run(module: str) -> None:
    failed, _ = doctest.testmod(
        importlib.import_module(module), optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
    )
    assert failed == 0


@pytest.mark.usefixtures("in_folder")
def test_examples_of_the_page_run() -> None:
    page = Path(__file__).parents[2] / "docs" / "python.md"
    failed, count = doctest.testfile(str(page), module_relative=False, optionflags=doctest.ELLIPSIS)
    assert failed == 0 and count > 20


def test_public_names_are_importable() -> None:
    assert len(MODULES) > 5
    assert sorted(octasplat.__all__) == octasplat.__all__ == sorted({"__version__", *octasplat._SOURCES})
    for name in PUBLIC:
        assert getattr(octasplat, name).__doc__, name
    with pytest.raises(AttributeError, match="no attribute 'scene_of'"):
        _ = octasplat.scene_of


@pytest.mark.parametrize("name", PUBLIC)
def test_public_names_have_docstring_examples(name: str) -> None:
    value = getattr(octasplat, name)
    if value.__module__.startswith("octasplat.engine"):
        return  # a class of the engine under a shorter name
    text = inspect.getdoc(value) or ""
    methods = [inspect.getdoc(method) or "" for _, method in inspect.getmembers(value, inspect.isroutine)]
    shown = ">>> " in text or (inspect.isclass(value) and any(">>> " in method for method in methods))
    # Jobs and errors come from others.
    assert shown or name == "Job" or (inspect.isclass(value) and issubclass(value, Exception)), name

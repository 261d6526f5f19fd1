"""The examples in docstrings of the engine, the workers and the service run and show what they say."""

import doctest
import importlib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PATHS = sorted(
    path
    for folder in ("engine", "workers", "service")
    for path in (ROOT / folder).rglob("*.py")
    if ">>> " in path.read_text(encoding="utf-8")
)
FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


def test_engine_has_many_examples() -> None:
    assert sum(path.read_text(encoding="utf-8").count(">>> ") for path in PATHS) > 60


@pytest.mark.parametrize("path", PATHS, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_examples_of_module_run(path: Path) -> None:
    module = ".".join(("octasplat", *path.relative_to(ROOT).with_suffix("").parts))
    failed, count = doctest.testmod(importlib.import_module(module), optionflags=FLAGS)
    assert count > 0
    assert failed == 0

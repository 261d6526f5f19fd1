"""What benchmarks and examples take from the library is there."""

import ast
import importlib
from importlib.util import find_spec
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SCRIPTS = sorted(path for folder in ("benchmarks", "examples") for path in (ROOT / folder).rglob("*.py"))
OURS = {"octasplat"}


def taken(path: Path) -> list[tuple[str, str]]:
    """Modules and the names that a script takes from each, of ours."""
    nodes = ast.walk(ast.parse(path.read_text(encoding="utf-8")))
    found = [node for node in nodes if isinstance(node, ast.ImportFrom) and not node.level]
    return [(node.module or "", name.name) for node in found for name in node.names]


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_names_are_where_scripts_take_them_from(path: Path) -> None:
    for module, name in taken(path):
        if module.split(".")[0] in OURS:
            there = hasattr(importlib.import_module(module), name)
            assert there or find_spec(f"{module}.{name}") is not None, f"{name} is not in {module}"

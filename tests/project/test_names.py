"""Names that the field does not have stay out, and the changelog lists every name that changed."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from octasplat.engine.settings import renamed_settings
from octasplat.engine.settings.renamed_settings import FormerNames

ROOT = Path(__file__).resolve().parents[2]
RETIRED = frozenset({"lean", "frosted", "chores", "upkeep", "openings", "twins", "doors"})
"""Words of earlier names."""
RETIRED_NAMES = frozenset({"see_from_counter", "put_off"})


def definitions(path: Path) -> Iterator[str]:
    """Yield the names that a module makes: its own, of classes and functions, and of parameters."""
    yield path.stem
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.arg):
            yield node.arg


def words(name: str) -> set[str]:
    """Return the words of a name: ``RayHits`` and ``ray_hits`` have ``ray`` and ``hits``."""
    return {word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])", name)}


def test_names_have_no_retired_words() -> None:
    paths = [path for name in ("engine", "workers", "service") for path in (ROOT / name).rglob("*.py")]
    assert len(paths) > 500
    found = {
        f"{path.relative_to(ROOT).as_posix()}: {name}"
        for path in paths
        for name in definitions(path)
        if name in RETIRED_NAMES or words(name) & RETIRED
    }
    assert not found


@pytest.mark.parametrize(
    "table", [name for name, value in vars(renamed_settings).items() if isinstance(value, FormerNames)]
)
def test_changelog_lists_renamed_settings(table: str) -> None:
    names = getattr(renamed_settings, table)
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    changes = [
        *names.fields.items(),
        *(
            (f"{field}={old}", f"{field}={new}")
            for field, values in names.values.items()
            for old, new in values.items()
        ),
        *((old, f"--{new.replace('_', '-')}") for old, new in names.flags.items()),
    ]
    missing = [f"| `{old}` | `{new}` |" for old, new in changes if f"| `{old}` | `{new}` |" not in text]
    assert not missing

"""Each term of docs/glossary.md is explained once, and its owner exists."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
ROW = re.compile(
    r"^\| (?P<term>[^|]+) \| (?P<symbol>[^|]*)\| (?P<meaning>[^|]+) \| `(?P<owner>[^`]+)` \|$", re.MULTILINE
)


def rows() -> list[re.Match[str]]:
    """Return the rows of all tables."""
    text = (ROOT / "docs" / "glossary.md").read_text(encoding="utf-8")
    found = list(ROW.finditer(text))
    tables = [line for line in text.splitlines() if line.startswith("| ") and not line.startswith("| Term")]
    assert len(found) == len(tables), "a row has not four columns, the last of them a module"
    return found


def test_terms_are_explained_once() -> None:
    terms = [term.strip().lower() for row in rows() for term in row["term"].split(",")]
    assert len(terms) > 60 and len(set(terms)) == len(terms)


def test_owners_exist() -> None:
    missing = []
    for row in rows():
        module, _, symbol = row["owner"].partition(":")
        path = ROOT / module
        names = set[str]()
        if path.is_file():
            tree = ast.parse(path.read_text(encoding="utf-8"))
            names = {node.name for node in tree.body if isinstance(node, ast.FunctionDef | ast.ClassDef)}
        if not path.is_file() or (symbol and symbol not in names):
            missing.append((row["term"], row["owner"]))
    assert not missing, "name in docs/glossary.md the modules and names of today"

"""Whatever a file, a library or a file name says can be written down."""

import ast
from pathlib import Path

import psycopg

from octasplat.workers.db.postgres_text import as_json, storable, storable_text

ROOT = Path(__file__).parents[2]
ODD = {"a\0b": ["\ud83d", float("nan"), ("x\0", {"deep": "\udfff"})], "sound": "ü 😀", "none": None, "n": 1.5}


def test_storable_replaces_values_postgres_refuses(conninfo: str) -> None:
    with psycopg.connect(conninfo) as connection:
        (stored,) = connection.execute("SELECT %s::jsonb", [as_json(ODD)]).fetchone() or ()
        (text,) = connection.execute("SELECT %s::text", [storable_text("a\0\ud800b")]).fetchone() or ()
    assert stored == {
        "a\ufffdb": ["\ufffd", None, ["x\ufffd", {"deep": "\ufffd"}]], "sound": "ü 😀", "none": None,
        "n": 1.5,
    }  # fmt: skip
    assert text == "a\ufffd\ufffdb"
    assert storable(stored) == stored


def test_jsonb_is_built_in_one_module_only() -> None:
    makers = set()
    for folder in ("workers", "service"):
        for path in (ROOT / folder).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.ImportFrom) and node.module == "psycopg.types.json":
                    makers.add(path.relative_to(ROOT).as_posix())
    assert makers == {"workers/db/postgres_text.py"}

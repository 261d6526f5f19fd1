"""docs/architecture.md is what the imports are today."""

import re
from pathlib import Path

import grimp
import pytest

from benchmarks import structure

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def graph() -> grimp.ImportGraph:
    """All imports of the project."""
    return grimp.build_graph("octasplat", cache_dir=None)


def test_page_is_up_to_date(graph: grimp.ImportGraph) -> None:
    written = (ROOT / structure.PAGE).read_text(encoding="utf-8")
    assert written == structure.written_page(ROOT, graph), "python -m benchmarks.structure --write"


def test_folders_have_no_circle_and_imports_run_one_way(graph: grimp.ImportGraph) -> None:
    edges = structure.arrows(graph)
    assert not structure.circles(edges) and not structure.upwards(edges)
    assert not structure.circles(structure.between_modules(graph))


@pytest.mark.parametrize("name", ["docs/architecture.md", "CONTRIBUTING.md", "docs/releasing.md"])
def test_files_that_a_page_names_exist(name: str) -> None:
    text = (ROOT / name).read_text(encoding="utf-8")
    named = set(
        re.findall(
            r"`((?:engine|workers|service|tests|docs|src|packages|benchmarks|docker)/[\w./-]*|\.ci/\w+)`",
            text,
        )
    )
    assert len(named) > 1
    missing = sorted(place for place in named if "NAME" not in place and not (ROOT / place).exists())
    assert not missing

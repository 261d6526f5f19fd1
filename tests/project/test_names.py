"""Names that the field does not have stay out, and the changelog lists every name that changed."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from octasplat.engine.settings import renamed_settings
from octasplat.engine.settings.renamed_settings import FormerNames

ROOT = Path(__file__).resolve().parents[2]
WORDS = """
chore chores contact doors doubts fitness folds footprint frosted gapless hasten heard hears hub journal
know knows lean machinery meet meets onlooker onlookers opening openings parted sight sights slips
surroundings telling told twin twins upkeep verdict verdicts widening workshop
"""
NAMES = """
Buffer Developed End Facets Front Judge LEAVING Leaving Lobe Machinery Paint Reversed Sight Slip absorb
accepting against_truth ask average_after bundles calm_after densities develop even_weight fit_iterations
free_lenses gate goes_on guards hand_over hasten_after hear kernels_eight kernels_sixteen know_alphas
know_slots learnt_light lens_doubt let_through making_room map_steps meet_block meet_group mesh_looks
near_share on_loss one_color only_seen opaque_sample opaque_value own_token place_misfits plain_colors
programs put_off rays_a_pixel see see_from_counter see_packets settle sh_every shown_share sight_lines
spatial staging step_back_db t_leaves t_viewer weigh_next window_rays window_side window_size
"""
RETIRED = frozenset(WORDS.split())
"""Words of earlier names, which no identifier has."""
RETIRED_NAMES = frozenset(NAMES.split())
"""Earlier names whose words have other uses; a leading underscore does not count."""
PAGES_OF_FORMER_NAMES = frozenset({"CHANGELOG.md"})


def identifiers(path: Path) -> Iterator[str]:
    """Yield the names that a module makes: its own, those of definitions, parameters and variables."""
    yield path.stem
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.arg):
            yield node.arg
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.attr


def words(name: str) -> set[str]:
    """Return the words of a name: ``RayHits`` and ``ray_hits`` have ``ray`` and ``hits``."""
    return {word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])", name)}


def is_retired(name: str) -> bool:
    """Return whether a name is one of the earlier ones, or has a word of theirs."""
    return name.strip("_") in RETIRED_NAMES or bool(words(name) & RETIRED)


def test_names_have_no_retired_words() -> None:
    paths = [path for name in ("engine", "workers", "service") for path in (ROOT / name).rglob("*.py")]
    assert len(paths) > 500
    found = {
        f"{path.relative_to(ROOT).as_posix()}: {name}"
        for path in paths
        for name in identifiers(path)
        if is_retired(name)
    }
    assert not found


def test_documents_have_no_retired_names() -> None:
    tables = [table for table in vars(renamed_settings).values() if isinstance(table, FormerNames)]
    present = {name for table in tables for name in table.fields.values()}
    former = {name for table in tables for name in table.fields if "_" in name} - present
    pages = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]
    spans = {
        (page.name, name)
        for page in pages
        if page.name not in PAGES_OF_FORMER_NAMES
        for span in re.findall(r"`([^`\n]+)`", page.read_text(encoding="utf-8"))
        for name in re.findall(r"[A-Za-z_]\w*", span)
    }
    assert len(pages) > 20 and len(former) > 20 and len(spans) > 500
    assert not {(page, name) for page, name in spans if name in RETIRED_NAMES | former}


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

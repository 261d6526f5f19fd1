"""Every paper that a docstring, a comment, an option or a document names is in docs/references.bib."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
ENTRY = re.compile(r"^@\w+\{([\w-]+),\n(.*?)^\}", re.MULTILINE | re.DOTALL)
FIELD = re.compile(r"^  (\w+) *= \{+(.*?)\}+,$", re.MULTILINE)
PAPER_LINK = re.compile(
    r"https?://(?:arxiv\.org/abs/|(?:dx\.)?doi\.org/|jcgt\.org/|blog\.selfshadow\.com/|media\.disney|extremelearning)[^\s)>\"'\],;]+"
)
AUTHORS_AND_YEAR = re.compile(
    r"\b((?:Van )?[A-Z][\w-]{2,}(?:,? (?:and |et al\.?)?(?:[A-Z][\w-]+)?)*?),? \(?((?:19|20)\d\d)\b(?!-)"
)
QUOTED_PAPER = re.compile(
    r"[\"“]([A-Z][^\"“”]{12,130})[\"”],? (?:\((?:https?:|[A-Z])|https?:|(?:19|20)\d\d\))"
)
NO_AUTHORS = {"June", "July", "May", "Eq", "Since", "January", "November", "Blender", "Python", "Embree"}


def sources() -> list[Path]:
    """Return the modules and pages in which papers are named."""
    modules = [path for name in ("engine", "workers", "service") for path in (ROOT / name).rglob("*.py")]
    package = list((ROOT / "src" / "octasplat").glob("*.py"))
    pages = [path for path in (ROOT / "docs").rglob("*.md") if path.parent.name != "notes"]
    return sorted([*modules, *package, *pages, ROOT / "README.md"])


def prose(path: Path) -> str:
    """Return a file's text in one line, pieces of strings joined and marks of comments left out."""
    text = re.sub(r"\s*\n\s*#?\s*", " ", path.read_text(encoding="utf-8"))
    return re.sub(r"(['\"]) (?:\1)", "", text)


@pytest.fixture(scope="module")
def entries() -> dict[str, dict[str, str]]:
    """The entries of docs/references.bib by key."""
    text = (ROOT / "docs" / "references.bib").read_text(encoding="utf-8")
    return {key: dict(FIELD.findall(body)) for key, body in ENTRY.findall(text)}


def test_entries_have_title_authors_year_and_link(entries: dict[str, dict[str, str]]) -> None:
    assert len(entries) > 35
    for key, entry in entries.items():
        assert {"title", "author", "year", "url", "note"} <= entry.keys(), key
        assert re.fullmatch(r"(19|20)\d\d", entry["year"]), key
        assert entry["url"].startswith("http"), key
        assert entry["year"] in key, key
        for place in re.findall(r"\b(?:engine|workers|service)/[\w/]+(?:\.py)?", entry["note"]):
            assert (ROOT / place).exists(), (
                f"{key}: {place} is gone; name the module that follows the paper now"
            )
    assert len({entry["title"].lower() for entry in entries.values()}) == len(entries)


def test_links_of_papers_are_in_the_bibliography(entries: dict[str, dict[str, str]]) -> None:
    known = {re.sub(r"/$", "", entry["url"]) for entry in entries.values()}
    named = {
        (path.relative_to(ROOT).as_posix(), link.rstrip("./"))
        for path in sources()
        for link in PAPER_LINK.findall(prose(path))
    }
    assert len(named) > 20
    missing = sorted((place, link) for place, link in named if link not in known)
    assert not missing


def test_authors_and_years_are_in_the_bibliography(entries: dict[str, dict[str, str]]) -> None:
    known = {
        (word, entry["year"])
        for entry in entries.values()
        for word in re.findall(r"\w[\w-]+", entry["author"])
    }
    missing, found = [], 0
    for path in sources():
        for authors, year in AUTHORS_AND_YEAR.findall(prose(path)):
            first = authors.removeprefix("Van ").split()[0].rstrip(",")
            if first in NO_AUTHORS:
                continue
            found += 1
            if (first, year) not in known:
                missing.append((path.relative_to(ROOT).as_posix(), authors, year))
    assert found > 12
    assert not missing


def test_titles_in_quotes_are_in_the_bibliography(entries: dict[str, dict[str, str]]) -> None:
    def plain(title: str) -> str:
        return re.sub(r"\W+", " ", title).lower().strip()

    known = [plain(entry["title"]) for entry in entries.values()]
    missing, found = [], 0
    for path in sources():
        for title in QUOTED_PAPER.findall(prose(path)):
            found += 1
            if not any(paper.startswith(plain(title)) for paper in known):
                missing.append((path.relative_to(ROOT).as_posix(), title))
    assert found > 20
    assert not missing

"""What the pages of the documentation hold: links, headings, and the commands of their code blocks."""

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from pymdownx.slugs import slugify

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
FENCE = re.compile(
    r"^(?P<indent> *)```(?P<language>\w*)[^\n]*\n(?P<text>.*?)^(?P=indent)```", re.MULTILINE | re.DOTALL
)
LINK = re.compile(r"!?\[(?:[^\[\]]|\[[^\]]*\])*\]\(([^)\s]+)\)")


@dataclass(frozen=True)
class DocumentedCommand:
    """A command of octasplat in a code block.

    Attributes:
        page: the page, from the root of the repository.
        words: the command and its arguments, without ``octasplat``.
    """

    page: str
    words: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.page}: octasplat {shlex.join(self.words)}"


def pages() -> list[Path]:
    """Return all pages for readers: those of docs/, of examples/ and at the root."""
    beside = [ROOT / "docker" / "README.md", *sorted((ROOT / "examples").rglob("README.md"))]
    return [*sorted(ROOT.glob("*.md")), *beside, *sorted(DOCS.rglob("*.md"))]


def blocks(page: Path, *languages: str) -> list[str]:
    """Return the code blocks of a page in the languages named, without their indent."""
    found = []
    for match in FENCE.finditer(page.read_text(encoding="utf-8")):
        if match["language"] in languages:
            indent = len(match["indent"])
            found.append("".join(line[indent:] or "\n" for line in match["text"].splitlines(keepends=True)))
    return found


def commands(page: Path) -> Iterator[DocumentedCommand]:
    """Yield the commands of octasplat in the shell blocks of a page."""
    name = page.relative_to(ROOT).as_posix()
    for block in blocks(page, "sh"):
        for words in _lines(block):
            for part in _commands_of_line(words):
                if part and part[0].removeprefix(".venv/bin/") == "octasplat":
                    yield DocumentedCommand(name, tuple(part[1:]))


def _lines(block: str) -> Iterator[list[str]]:
    """Yield the words of each line, with the lines that a quotation mark or a backslash joins to it."""
    begun = ""
    for line in block.replace("\\\n", " ").splitlines():
        # A comment begins where a word does, so that "albedo=#ffd060" is none.
        begun = f"{begun}\n{line}" if begun else re.sub(r"(?:^|\s)#.*$", "", line)
        try:
            words = shlex.split(begun)
        except ValueError:
            continue
        begun = ""
        yield words


def _commands_of_line(words: list[str]) -> Iterator[list[str]]:
    """Yield the simple commands of a line: what stands between operators of the shell."""
    part: list[str] = []
    for word in words:
        if word in ("&&", "||", ";", "|", "do", "done"):
            yield part
            part = []
        else:
            part.append(word)
    yield part


@cache
def anchors(page: Path) -> frozenset[str]:
    """Return the anchors of the headings of a page, as the site and code hosts make them."""
    slug = slugify(case="lower")
    text = FENCE.sub("", page.read_text(encoding="utf-8"))
    found: list[str] = []
    for title in re.findall(r"^#{1,6} +(.+?) *$", text, re.MULTILINE):
        plain = re.sub(r"\[([^\]]+)\]\([^)]*\)", r"\1", title)
        name = slug(re.sub(r"[`*]", "", plain), "-")
        count = sum(1 for other in found if other == name or re.fullmatch(rf"{re.escape(name)}_\d+", other))
        found.append(f"{name}_{count}" if count else name)
    return frozenset(found)


@cache
def headings(page: Path) -> frozenset[str]:
    """Return the headings of a page as they are written."""
    text = FENCE.sub("", page.read_text(encoding="utf-8"))
    return frozenset(
        re.sub(r"[`*]", "", title) for title in re.findall(r"^#{1,6} +(.+?) *$", text, re.MULTILINE)
    )

"""The pages of the documentation: up to date, linked, buildable, with commands that exist."""

import json
import re
import subprocess
import sys
from pathlib import Path
from urllib.parse import urlsplit

import click
import pytest

from benchmarks import reference
from octasplat.__main__ import cli
from octasplat.engine.core.errors import OctasplatError
from octasplat.engine.runs.settings_catalog import find_setting
from tests.support.documentation import (
    DOCS,
    FENCE,
    LINK,
    ROOT,
    DocumentedCommand,
    anchors,
    blocks,
    commands,
    headings,
    pages,
)

SOURCES = (
    "engine",
    "workers",
    "service",
    "src/octasplat",
    "benchmarks",
    "examples",
    "tests",
    "docker",
    ".ci",
)
README = ROOT / "README.md"
SECTIONS = [
    "What makes it different",
    "Install",
    "Five minutes",
    "Your own photographs",
    "Service",
    "Results",
    "Links",
    "Papers",
    "Licence",
]
COMMANDS = [command for page in pages() for command in commands(page)]


@pytest.fixture(scope="module")
def pages_from_the_code() -> dict[str, str]:
    """Pages by name, made in a process of its own: other tests register kinds of jobs in this one."""
    code = (
        "import json; from benchmarks import reference; "
        "print(json.dumps({name: make() for name, make in reference.PAGES.items()}))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    made: dict[str, str] = json.loads(done.stdout.splitlines()[-1])
    return made


@pytest.mark.parametrize("name", sorted(reference.PAGES))
def test_pages_made_from_the_code_are_up_to_date(name: str, pages_from_the_code: dict[str, str]) -> None:
    written = (DOCS / name).read_text(encoding="utf-8")
    assert written == pages_from_the_code[name], "python -m benchmarks.reference --write"


@pytest.mark.exhaustive
def test_site_builds_without_warnings(tmp_path: Path) -> None:
    command = (sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", tmp_path / "site")
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "site" / "index.html").is_file() and not list((tmp_path / "site").rglob("*.map"))


@pytest.mark.parametrize("page", pages(), ids=lambda page: page.relative_to(ROOT).as_posix())
def test_links_lead_to_files_and_headings(page: Path) -> None:
    broken = []
    for target in LINK.findall(FENCE.sub("", page.read_text(encoding="utf-8"))):
        address = urlsplit(target)
        if address.scheme:
            if address.scheme not in ("https", "http") or "." not in address.netloc:
                broken.append(target)
            continue
        path = (page.parent / address.path).resolve() if address.path else page
        if not path.exists() or (address.fragment and address.fragment not in anchors(path)):
            broken.append(target)
    assert not broken


def test_code_names_pages_and_sections_that_exist() -> None:
    wrong, count = [], 0
    files = [path for folder in SOURCES for path in (ROOT / folder).rglob("*") if path.is_file()]
    for path in (*files, *ROOT.glob("*.md"), *ROOT.glob("*.toml")):
        if path.suffix not in (".py", ".md", ".html", ".toml", ".yaml", ".js", ""):
            continue
        text = re.sub(r"\s*\n\s*#?\s*", " ", path.read_text(encoding="utf-8", errors="replace"))
        for name, section in re.findall(
            r"(?<![\w/.])docs/([\w/]+\.md)(?:[`)\]]*,\s*\"([^\"\n]{3,80}?),?\")?", text
        ):
            count += 1
            page = DOCS / name
            if not page.is_file() or (section and section not in headings(page)):
                wrong.append((path.relative_to(ROOT).as_posix(), name, section))
    assert count > 30 and not wrong


def test_programs_that_pages_name_exist() -> None:
    named = set()
    for page in pages():
        text = page.read_text(encoding="utf-8")
        named |= {
            f"{name.replace('.', '/')}.py" for name in re.findall(r"python3? -m (benchmarks\.\w+)", text)
        }
        named |= set(re.findall(r"python3? ((?:benchmarks|examples)/[\w/]+\.py)", text))
    missing = sorted(name for name in named if not (ROOT / name).is_file())
    assert len(named) > 10 and not missing


def test_readme_is_short_and_in_order() -> None:
    text = README.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 150
    assert re.findall(r"^## (.*)$", text, re.MULTILINE) == SECTIONS
    paragraphs = FENCE.sub("\n", text).split("\n\n")
    prose = [part for part in paragraphs if not part.lstrip().startswith(("|", "#", "!", "["))]
    assert prose and max(len(re.sub(r"\]\([^)]*\)", "", part).split()) for part in prose) <= 80


@pytest.mark.parametrize("page", pages(), ids=lambda page: page.relative_to(ROOT).as_posix())
def test_shell_blocks_are_shell(page: Path) -> None:
    for block in blocks(page, "sh"):
        done = subprocess.run(("bash", "-n"), input=block, capture_output=True, text=True, check=False)
        assert done.returncode == 0, f"{block}\n{done.stderr}"


def test_python_blocks_are_python() -> None:
    count = 0
    for page in pages():
        for block in blocks(page, "python"):
            if ">>>" not in block:  # those are run, by tests/api
                compile(block, str(page), "exec")
                count += 1
    assert count > 3


@pytest.mark.parametrize("command", COMMANDS, ids=str)
def test_commands_have_options_that_exist(command: DocumentedCommand) -> None:
    check_command(command.words)


def test_commands_are_found_and_checked() -> None:
    assert len(COMMANDS) > 100
    for words in (
        ("crop", "a.ply", "--nothing"),
        ("render", "OUT", "--fps", "many"),
        ("nothing",),
        ("merge",),
    ):
        with pytest.raises((click.ClickException, AssertionError)):
            check_command(words)


def check_command(words: tuple[str, ...]) -> None:
    """Parse a command without running it: its options exist and their values have the right types.

    Raises:
        click.ClickException: it cannot be parsed.
    """
    context, rest = click.Context(cli, info_name="octasplat"), list(words)
    if rest == ["--version"] or rest == ["--help"]:
        return
    command: click.Command = cli
    while isinstance(command, click.Group):
        name, found, rest = command.resolve_command(context, rest)
        assert found is not None, f"there is no command {words[0]}"
        command, context = found, click.Context(found, info_name=name, parent=context)
    values, left, _ = command.make_parser(context).parse_args(list(rest))
    assert not left, f"{left} is too much"
    for parameter in command.get_params(context):
        value = values.get(parameter.name or "")
        if value is None or value == () or type(value).__name__ == "Sentinel":
            needed = parameter.required and not parameter.is_eager
            assert not needed, f"{parameter.human_readable_name} is missing"
        elif not isinstance(parameter.type, click.Path | click.File):
            parameter.type_cast_value(context, value)
    if command.name in ("reconstruct", "estimate", "submit"):
        for assignment in re.findall(r"--set[= ]([\w.]+)=", " ".join(words)):
            try:
                find_setting(assignment)
            except OctasplatError as error:
                raise AssertionError(str(error)) from error


def test_named_tests_exist() -> None:
    """A name without a file is of the row's or an earlier one's; such names are looked for in all files."""
    names: dict[str, set[str]] = {}
    for file in (ROOT / "tests").rglob("test_*.py"):
        found = re.findall(r"^(?:async )?def (test_\w+)", file.read_text(encoding="utf-8"), re.MULTILINE)
        names[file.relative_to(ROOT).as_posix()] = set(found)
    missing = [
        f"{page.name}: {file}::{name}"
        for page in pages()
        for file, name in re.findall(r"`(tests/[\w/]+\.py)?::(test_\w+)", page.read_text(encoding="utf-8"))
        if not any(name in names[place] for place in ([file] if file else names))
    ]
    assert missing == []

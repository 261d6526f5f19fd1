"""A user's program is checked as strictly as they like."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
from platformdirs import user_cache_path

PROGRAM = Path(__file__).with_name("user_program.py")
PAGE = Path(__file__).parents[2] / "docs" / "python.md"
WRONG = """
import octasplat as osp

osp.crop("a.ply", "b.ply", wher="z < 0")
osp.render(osp.load("a.ply"), "b.png")
osp.reconstruct("photos", "out", preset="fastest")
osp.load("a.ply").means.nothing
"""
CONFIG = """[mypy]
strict = True
plugins = pydantic.mypy
[mypy-numba.*,pycolmap.*,embreex.*]
ignore_missing_imports = True
"""


CACHE = user_cache_path("octasplat") / "mypy"
"""Kept from run to run: reading torch takes most of the time, and mypy looks at the contents of files."""


def check(program: Path, folder: Path) -> tuple[int, str]:
    (folder / "mypy.ini").write_text(CONFIG)
    command = [
        sys.executable, "-m", "mypy", "--strict", "--follow-imports=silent", "--config-file", "mypy.ini",
        "--cache-dir", str(CACHE), str(program),
    ]  # fmt: skip
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    return done.returncode, done.stdout


def examples(page: Path) -> str:
    """The examples of a page, one after the other, as one program without what they print."""
    found = []
    for block in re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL):
        lines = block.splitlines()
        if block.startswith(">>>"):
            lines = [line[4:] for line in lines if line.startswith((">>> ", "... "))]
        found += [*lines, ""]
    return "\n".join(found)


@pytest.mark.exhaustive
def test_examples_of_the_page_on_python_pass_mypy_strict(tmp_path: Path) -> None:
    program = tmp_path / "examples.py"
    program.write_text(examples(PAGE))
    assert len(program.read_text().splitlines()) > 40
    assert check(program, tmp_path) == (0, "Success: no issues found in 1 source file\n")


@pytest.mark.exhaustive
def test_program_of_a_user_passes_mypy_strict_and_wrong_ones_do_not(tmp_path: Path) -> None:
    assert check(PROGRAM, tmp_path) == (0, "Success: no issues found in 1 source file\n")
    wrong = tmp_path / "wrong.py"
    wrong.write_text(WRONG)
    code, told = check(wrong, tmp_path)
    assert code == 1
    assert {int(line.split(":")[1]) for line in told.splitlines() if ": error:" in line} == {4, 5, 6, 7}

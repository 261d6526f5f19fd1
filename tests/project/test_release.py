"""A release is rehearsed: built, looked into and described, without a tag and without publishing."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[2]
VERSION = re.search(r'^__version__ = "(.*)"$', (ROOT / "engine" / "__init__.py").read_text(), re.MULTILINE)


def test_version_stands_in_one_place() -> None:
    assert VERSION
    for name in ("pyproject.toml", "packages/client/pyproject.toml"):
        settings = tomllib.loads((ROOT / name).read_text(encoding="utf-8"))
        assert "version" not in settings["project"] and settings["project"]["dynamic"] == ["version"], name
        assert settings["tool"]["setuptools"]["dynamic"]["version"] == {
            "attr": "octasplat.engine.__version__"
        }
    assert "version" not in yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))


def test_changelog_has_sections_of_unreleased_changes_and_of_the_version() -> None:
    assert VERSION
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    sections = re.findall(r"^## \[(.*?)\]", text, re.MULTILINE)
    assert sections[0] == "Unreleased" and VERSION[1] in sections and len(set(sections)) == len(sections)
    subsections = set(re.findall(r"^### (.*)$", text, re.MULTILINE))
    assert subsections <= {
        "Added", "Changed", "Deprecated", "Removed", "Fixed", "Security", "Renamed settings and options"
    }  # fmt: skip


@pytest.mark.exhaustive
@pytest.mark.heavy
def test_release_is_rehearsed(tmp_path: Path) -> None:
    def tags() -> str:
        return subprocess.run(
            ("git", "tag", "--list"), cwd=ROOT, capture_output=True, text=True, check=True
        ).stdout

    if not (ROOT / ".git").exists():
        pytest.skip("the sources are not in a git repository")
    before = tags()
    rehearsal = (sys.executable, ".ci/release", "--dry-run", "--allow-dirty", "--target", str(tmp_path))
    done = subprocess.run(rehearsal, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert VERSION
    assert {path.name for path in tmp_path.iterdir()} == {
        f"octasplat-{VERSION[1]}-py3-none-any.whl",
        f"octasplat-{VERSION[1]}.tar.gz",
        f"octasplat_client-{VERSION[1]}-py3-none-any.whl",
    }
    assert f"Notes of v{VERSION[1]}" in done.stdout and "no tag was made" in done.stdout
    assert tags() == before

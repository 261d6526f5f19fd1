"""The files by which a project is found and checked name programs and places that are there."""

import os
import re
import subprocess
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[2]
SETTINGS = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def load(name: str) -> Any:
    """Return what a YAML file holds."""
    return yaml.safe_load((ROOT / name).read_text(encoding="utf-8"))


def workflow_commands() -> list[str]:
    """Return the commands of the hosted checks."""
    jobs = load(".github/workflows/ci.yml")["jobs"]
    return [step["run"] for job in jobs.values() for step in job["steps"] if "run" in step]


def test_hosted_checks_cover_systems_and_processors() -> None:
    jobs = load(".github/workflows/ci.yml")["jobs"]
    systems = {entry["system"] for entry in jobs["checks"]["strategy"]["matrix"]["include"]}
    assert {"ubuntu-24.04", "ubuntu-24.04-arm"} <= systems
    [checks] = [step["run"] for step in jobs["checks"]["steps"] if step.get("run", "").startswith(".ci/run")]
    assert "github.event_name == 'schedule' && '--exhaustive'" in checks  # all tests, once a week
    assert {name.partition("-")[0] for name in jobs["client"]["strategy"]["matrix"]["system"]} >= {
        "windows",
        "macos",
    }
    text = "\n".join(workflow_commands())
    assert "--resolution lowest-direct" in text and "pip-audit" in text and ".ci/lock --check" in text


def test_programs_of_the_checks_are_there() -> None:
    named = {
        place for command in workflow_commands() for place in re.findall(r"(?<![\w/])\.ci/[\w-]+", command)
    }
    named |= set(re.findall(r"^\.ci/[\w-]+", (ROOT / ".ci" / "run").read_text(), re.MULTILINE))
    assert {".ci/run", ".ci/lock", ".ci/release", ".ci/licences", ".ci/dead-code"} <= named
    for place in named:
        assert os.access(ROOT / place, os.X_OK), place
        if (ROOT / place).read_text().startswith("#!/usr/bin/env bash"):
            subprocess.run(("bash", "-n", place), cwd=ROOT, check=True)


def test_modules_of_tests_have_names_of_their_own() -> None:
    # The folders are no packages, so pytest imports each module by its file name alone.
    names = [path.name for path in (ROOT / "tests").rglob("test_*.py")]
    assert len(names) > 100 and {name for name in names if names.count(name) > 1} == set()


def test_tools_of_the_checks_are_installed_with_the_extra_dev() -> None:
    tools = re.findall(r"^\.venv/bin/([\w-]+)", (ROOT / ".ci" / "run").read_text(), re.MULTILINE)
    tools += [hook["entry"].split()[0].removeprefix(".venv/bin/") for hook in hooks()]
    owners = {"lint-imports": "import-linter", "python": "pytest"}
    dev = {re.split(r"[\[<>=;]", line)[0] for line in SETTINGS["project"]["optional-dependencies"]["dev"]}
    assert {owners.get(tool, tool) for tool in tools} - {"pip"} <= dev


def hooks() -> list[dict[str, Any]]:
    """Return the hooks of pre-commit."""
    return [hook for repository in load(".pre-commit-config.yaml")["repos"] for hook in repository["hooks"]]


def test_hooks_run_what_the_checks_run() -> None:
    assert {hook["id"] for hook in hooks()} == {
        "ruff-check",
        "ruff-format",
        "spelling",
        "mypy",
        "import-contracts",
    }


def test_citation_names_title_authors_and_licence() -> None:
    citation = load("CITATION.cff")
    assert citation["cff-version"] == "1.2.0" and citation["title"] and citation["message"]
    assert citation["authors"] == SETTINGS["project"]["authors"] == [{"name": "octasplat contributors"}]
    assert citation["license"] == SETTINGS["project"]["license"]
    for reference in citation["references"]:
        assert reference["url"] in (ROOT / "docs" / "references.bib").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", ["fault", "wish"])
def test_issue_forms_have_fields_of_their_own(name: str) -> None:
    form = load(f".github/ISSUE_TEMPLATE/{name}.yml")
    ids = [field["id"] for field in form["body"]]
    assert form["name"] and form["description"] and len(set(ids)) == len(ids) > 1


@pytest.mark.parametrize("name", ["README.md", "CONTRIBUTING.md", ".ci/run"])
def test_commands_install_the_locked_versions(name: str) -> None:
    text = (ROOT / name).read_text(encoding="utf-8")
    assert re.search(r"pip install .*--no-deps --require-hashes -r requirements(-dev)?\.lock", text)
    for command in re.findall(r"pip install[^&\n]*", text):
        if re.search(r" (-e )?'?\.[\[' ]", f"{command} "):
            assert "--no-build-isolation -c constraints.txt" in command, command


@pytest.mark.parametrize(
    "name",
    [
        "README.md",
        "CONTRIBUTING.md",
        "CHANGELOG.md",
        "SECURITY.md",
        "docs/releasing.md",
        "docs/architecture.md",
    ],
)
def test_links_lead_to_files(name: str) -> None:
    page = ROOT / name
    for target in re.findall(r"\]\((?!https?:)([^)#]+)", page.read_text(encoding="utf-8")):
        assert (page.parent / target).exists(), target

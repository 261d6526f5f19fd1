"""The lock files hold what pyproject.toml asks for, with hashes, and name no index."""

import re
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

ROOT = Path(__file__).resolve().parents[2]
SETTINGS = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
EXTRAS = SETTINGS["optional-dependencies"]
WANTED = {
    "requirements.lock": [*SETTINGS["dependencies"], *EXTRAS["s3"]],
    "requirements-dev.lock": [
        *SETTINGS["dependencies"],
        *(line for extra in EXTRAS.values() for line in extra),
    ],
    "docker/front-end.lock": [
        line for line in (ROOT / "docker" / "front-end.txt").read_text().splitlines() if line[0] != "#"
    ],
}


def locked(name: str) -> dict[str, list[tuple[Version, int]]]:
    """Return the versions of each package, with the number of their hashes."""
    text = (ROOT / name).read_text(encoding="utf-8").replace("\\\n", " ")
    found: dict[str, list[tuple[Version, int]]] = {}
    for line in text.splitlines():
        if line and not line.startswith("#"):
            requirement, *hashes = line.split(" --hash=sha256:")
            (pin,) = Requirement(requirement.strip()).specifier
            assert pin.operator == "==", line
            assert all(re.fullmatch("[0-9a-f]{64}", value.strip()) for value in hashes), line
            package = canonicalize_name(Requirement(requirement.strip()).name)
            found.setdefault(package, []).append((Version(pin.version), len(hashes)))
    return found


@pytest.mark.parametrize("name", WANTED)
def test_lock_satisfies_what_is_asked_for(name: str) -> None:
    versions = locked(name)
    for line in (*WANTED[name], *(ROOT / ".ci" / "build.txt").read_text().splitlines()):
        requirement = Requirement(line)
        if requirement.name == "torch":  # by constraints.txt, as its builds differ
            continue
        found = versions.get(canonicalize_name(requirement.name))
        assert found, f"{requirement.name} is not in {name}; run .ci/lock"
        for version, hashes in found:
            assert requirement.specifier.contains(version), f"{line}: {name} has {version}; run .ci/lock"
            assert hashes, requirement.name


def test_lock_files_agree() -> None:
    whole = locked("requirements-dev.lock")
    for name in ("requirements.lock", "docker/front-end.lock"):
        for package, found in locked(name).items():
            assert {version for version, _ in found} <= {version for version, _ in whole[package]}, package


@pytest.mark.parametrize("name", WANTED)
def test_lock_names_no_index_and_no_cuda(name: str) -> None:
    text = (ROOT / name).read_text(encoding="utf-8")
    assert not re.search(r"://|--(?:extra-)?index|--find-links", text)
    assert not re.search(r"^(?:nvidia|cuda|triton)", text, re.MULTILINE)


def test_torch_is_fixed_by_the_constraints_alone() -> None:
    (fixed,) = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if line[0] != "#"]
    assert re.fullmatch(r"torch==\d+\.\d+\.\d+", fixed)
    (wanted,) = [Requirement(line) for line in SETTINGS["dependencies"] if Requirement(line).name == "torch"]
    assert wanted.specifier.contains(fixed.removeprefix("torch=="))
    assert not any("torch" in locked(name) for name in WANTED)


def test_each_dependency_says_what_for() -> None:
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    lists = text[text.index("\ndependencies = [") : text.index("[project.scripts]")]
    lines = [line for line in lists.splitlines() if re.match(r'\s+"|\w+ = \["', line)]
    assert len(lines) > 45
    previous = ""
    for line in lists.splitlines():
        if line in lines:
            assert "#" in line.rpartition('"')[2] or previous.strip().startswith("#"), line
        previous = line

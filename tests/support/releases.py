"""Environments of two releases of octasplat, each installed into one of its own, as an upgrade has them.

The libraries are those of the environment of the tests; octasplat itself is what was installed. The kind of
job ``toy`` is the module ``toy_kind`` in each.
"""

import io
import re
import shutil
import subprocess
import sys
import tarfile
import venv
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PINNED = "6f3bf281170c"
"""The commit that counts as the last release while no release has a tag."""
_SOURCES = ("engine", "workers", "service", "src", "pyproject.toml", "README.md", "LICENSE")
_TOYS = ("tests/support/toy_kind.py", "tests/work/toy_kind.py")
_VERSIONS = ("engine/core/versions.py", "engine/versions.py")


@dataclass(frozen=True)
class Release:
    """An installed release.

    Attributes:
        python: of its environment.
        results: the number of the results that it gives.
    """

    python: Path
    results: int


def install_current(folder: Path) -> Release:
    """Install the working tree."""
    source = folder / "source"
    ignored = shutil.ignore_patterns("__pycache__", "*.egg-info", "node_modules")
    for name in _SOURCES:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, source / name, symlinks=True, ignore=ignored)
        else:
            shutil.copy(ROOT / name, source / name)
    (source / "tests/support").mkdir(parents=True)
    shutil.copy(ROOT / _TOYS[0], source / _TOYS[0])
    return _install(source, folder)


def install_previous(folder: Path) -> Release:
    """Install the last release: that of the last tag of the form vX.Y.Z, or the pinned commit."""
    tag = _git("describe", "--tags", "--abbrev=0", "--match", "v[0-9]*", "HEAD^")
    commit = PINNED if tag is None else tag.decode().strip()
    names = _git("ls-tree", "-r", "--name-only", commit)
    if names is None:
        pytest.skip(f"the commit {commit} of the last release is not here; fetch the whole history")
    toys = set(_TOYS) & set(names.decode().splitlines())
    archive = _git("archive", commit, *_SOURCES, *toys)
    assert archive is not None
    source = folder / "source"
    with tarfile.open(fileobj=io.BytesIO(archive)) as opened:
        opened.extractall(source, filter="data")
    return _install(source, folder)


def _git(*arguments: str) -> bytes | None:
    """Return what git prints; None if it fails."""
    try:
        return subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        return None


def _install(source: Path, folder: Path) -> Release:
    environment = folder / "environment"
    venv.create(environment, symlinks=True)
    python = environment / "bin" / "python"
    asked = [python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"]
    site = Path(subprocess.run(asked, capture_output=True, text=True, check=True).stdout.strip())
    libraries = [entry for entry in sys.path if entry.endswith(("site-packages", "dist-packages"))]
    (site / "libraries.pth").write_text("\n".join(libraries))  # whose own .pth files are not read
    command = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "-q",
        "--no-deps",
        "--no-build-isolation",
        "--no-index",
    ]
    options = ["--disable-pip-version-check", "--no-compile", "--target", site, source]
    done = subprocess.run([*command, *options], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    [toy] = [source / name for name in _TOYS if (source / name).is_file()]
    (site / "toy_kind.py").write_text(toy.read_text().replace("tests.support.toy_kind", "toy_kind"))
    [versions] = [source / name for name in _VERSIONS if (source / name).is_file()]
    found = re.search(r"^RESULTS(?:_VERSION)? = (\d+)$", versions.read_text(), re.MULTILINE)
    assert found is not None
    origin = [python, "-c", "import octasplat; print(octasplat.__file__)"]
    where = subprocess.run(origin, cwd=folder, capture_output=True, text=True, check=True).stdout.strip()
    assert Path(where).is_relative_to(environment), where
    return Release(python, int(found[1]))

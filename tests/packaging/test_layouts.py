"""Every way to install the project works beside packages and folders that are called as our folders are."""

import re
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.support.environments import (
    ROOT,
    Environment,
    build_distribution,
    copy_project,
    empty_environment,
    foreign_wheel,
    run,
    share_packages,
)

VERSION = re.search(r'^__version__ = "(.*)"', (ROOT / "engine" / "__init__.py").read_text(), re.M)[1]  # type: ignore[index]
CODE = """
import sys
sys.path.remove("")
import engine, octasplat, octasplat.engine, octasplat.service.web, octasplat.workers.db, service, workers
from pathlib import Path
assert engine.OWNER == service.OWNER == workers.OWNER == "somebody else"
web = Path(octasplat.service.web.__file__).parent
assert (web / "templates" / "base.html").is_file() and (web / "static" / "viewer" / "page.js").is_file()
assert list((Path(octasplat.workers.db.__file__).parent / "migrations").glob("*.sql"))
print(Path(octasplat.__file__).parent)
"""


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the project to build."""
    return copy_project(tmp_path_factory.mktemp("built") / "project")


@pytest.fixture
def elsewhere(tmp_path: Path) -> Path:
    """A current folder with packages of somebody else's, which must never be imported."""
    folder = tmp_path / "elsewhere"
    for name in ("engine", "service", "workers", "click", "numpy"):
        (folder / name).mkdir(parents=True)
        for file in ("__init__.py", "__main__.py"):
            (folder / name / file).write_text(f"raise SystemExit('{name} of the current folder was run')\n")
    return folder


def install_wheel(environment: Environment, project: Path) -> None:
    environment.install(build_distribution(project, "wheel", project.parent / "wheels"), cwd=project)


def install_sdist(environment: Environment, project: Path) -> None:
    environment.install(build_distribution(project, "sdist", project.parent / "sdists"), cwd=project)


def install_editable(environment: Environment, project: Path) -> None:
    environment.install("-e", ".", cwd=project)


def install_as_docker_does(environment: Environment, project: Path) -> None:
    """Copy what the Dockerfile copies into an empty folder, and install from there."""
    dockerfile = (ROOT / "docker" / "Dockerfile").read_text().partition("AS front-end")[2]
    dockerfile = dockerfile.partition("FROM base")[0]
    assert "RUN pip install --no-deps --no-build-isolation ." in dockerfile
    folder = project.parent / "docker"
    folder.mkdir()
    copied = re.findall(r"^COPY (.*)$", dockerfile, re.M)
    assert copied
    for line in copied:
        *sources, _ = line.split()
        for source in sources:
            if (project / source).exists():  # but for what only lists dependencies
                target = folder / source
                target.symlink_to(project / source) if source != "src" else _copy_links(project, folder)
    environment.install(".", cwd=folder)


def _copy_links(project: Path, folder: Path) -> None:
    import shutil

    shutil.copytree(project / "src", folder / "src", symlinks=True)


WAYS: dict[str, Callable[[Environment, Path], None]] = {
    "wheel": install_wheel,
    "sdist": install_sdist,
    "editable": install_editable,
    "docker": install_as_docker_does,
}


@pytest.mark.exhaustive
@pytest.mark.parametrize("way", WAYS)
def test_installed_program_runs_beside_packages_of_the_same_names(
    way: str, project: Path, elsewhere: Path, tmp_path: Path
) -> None:
    environment = empty_environment(tmp_path / "environment")
    share_packages(environment)  # the builder needs setuptools, the program its dependencies
    environment.install(foreign_wheel(tmp_path), cwd=tmp_path)
    WAYS[way](environment, project)

    names = environment.own_files("octasplat")
    allowed = {"octasplat", f"octasplat-{VERSION}.dist-info"}
    if way == "editable":
        assert not names & {"engine", "service", "workers", "src"}
    else:
        assert names == allowed

    program = environment.folder / "bin" / "octasplat"
    assert run((program, "--version"), elsewhere).splitlines()[0] == f"octasplat, version {VERSION}"
    assert "Run the HTTP front end alone" in run((program, "api", "--help"), elsewhere)
    place = Path(run((environment.python, "-c", CODE), elsewhere).strip())
    expected = project / "src" / "octasplat" if way == "editable" else environment.packages / "octasplat"
    assert place == expected

"""Empty virtual environments, in which distributions of a copy of this project are installed."""

import importlib.metadata
import re
import shutil
import subprocess
import sys
import venv
import zipfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
FOLDERS = ("src", "engine", "workers", "service", "packages")
FILES = ("pyproject.toml", "README.md", "LICENSE")
_PIP = (sys.executable, "-m", "pip", "--disable-pip-version-check", "-q")
_INSTALL = ("install", "--no-deps", "--no-index", "--no-build-isolation", "--ignore-installed")


def run(command: Iterable[object], cwd: Path) -> str:
    """Run a command without variables that steer Python, and return what it printed."""
    import os

    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    done = subprocess.run(
        [str(part) for part in command], cwd=cwd, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def copy_project(target: Path) -> Path:
    """Return a copy of what distributions are built from, links as links."""
    target.mkdir()
    unwanted = shutil.ignore_patterns("__pycache__", "*.nbi", "*.nbc", "*.egg-info", "build")
    for name in FOLDERS:
        shutil.copytree(ROOT / name, target / name, symlinks=True, ignore=unwanted)
    for name in FILES:
        shutil.copy(ROOT / name, target / name)
    return target


def build_distribution(project: Path, kind: str, target: Path) -> Path:
    """Return a wheel or an sdist of a project, built without a network.

    Args:
        project: folder of its ``pyproject.toml``.
        kind: ``wheel`` or ``sdist``.
        target: folder for it.
    """
    target.mkdir(exist_ok=True)
    code = f"import sys, setuptools.build_meta as b; b.build_{kind}(sys.argv[1])"
    run((sys.executable, "-c", code, target), project)
    pattern = "*.whl" if kind == "wheel" else "*.tar.gz"
    return max(target.glob(pattern), key=lambda path: path.stat().st_mtime)


def foreign_wheel(folder: Path) -> Path:
    """Return a distribution as there are some on PyPI, which installs packages called as our folders are."""
    path = folder / "someone_elses-1.0-py3-none-any.whl"
    info = "someone_elses-1.0.dist-info"
    files = {
        f"{info}/METADATA": "Metadata-Version: 2.1\nName: someone-elses\nVersion: 1.0\n",
        f"{info}/WHEEL": "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
        **{f"{name}/__init__.py": "OWNER = 'somebody else'\n" for name in ("service", "workers", "engine")},
        **{f"{name}/__main__.py": "raise SystemExit(9)\n" for name in ("service", "workers", "engine")},
    }
    record = "".join(f"{name},,\n" for name in (*files, f"{info}/RECORD"))
    with zipfile.ZipFile(path, "w") as archive:
        for name, text in {**files, f"{info}/RECORD": record}.items():
            archive.writestr(name, text)
    return path


@dataclass(frozen=True)
class Environment:
    """A virtual environment."""

    folder: Path

    @property
    def python(self) -> Path:
        return self.folder / "bin" / "python"

    @property
    def packages(self) -> Path:
        return self.folder / "lib" / f"python{sys.version_info[0]}.{sys.version_info[1]}" / "site-packages"

    def install(self, *what: object, cwd: Path) -> None:
        """Install without dependencies and without a network."""
        run((*_PIP, "--python", self.python, *_INSTALL, *what), cwd)

    def own_files(self, distribution: str) -> set[str]:
        """Return the top-level names below site-packages that a distribution has installed."""
        (info,) = self.packages.glob(f"{distribution}-*.dist-info")
        lines = (info / "RECORD").read_text().splitlines()
        return {line.partition("/")[0] for line in lines if not line.startswith("..")}


def empty_environment(folder: Path) -> Environment:
    """Return a new environment without anything in it."""
    venv.create(folder, with_pip=False, symlinks=True)
    return Environment(folder)


def share_packages(environment: Environment) -> None:
    """Let an environment see the packages of this one, behind its own."""
    shared = [path for path in sys.path if path.endswith("-packages")]
    (environment.packages / "shared.pth").write_text("\n".join(shared) + "\n")


def link_packages(environment: Environment, names: Iterable[str]) -> set[str]:
    """Put the named distributions and what they need, and nothing else, into an environment.

    Returns:
        The names of all of them.
    """
    waiting, found = list(names), set[str]()
    while waiting:
        name = re.split(r"[^A-Za-z0-9._-]", waiting.pop(), maxsplit=1)[0].lower().replace("_", "-")
        if name in found:
            continue
        found.add(name)
        distribution = importlib.metadata.distribution(name)
        for top in {Path(str(file)).parts[0] for file in distribution.files or ()} - {"..", "__pycache__"}:
            target = environment.packages / top
            if not target.exists():
                target.symlink_to(Path(str(distribution.locate_file(top))))
        needs = (need for need in distribution.requires or () if "extra ==" not in need)
        waiting += [need.partition(";")[0] for need in needs if _applies(need)]
    return found


def _applies(requirement: str) -> bool:
    from packaging.requirements import Requirement

    marker = Requirement(requirement).marker
    return marker is None or marker.evaluate()

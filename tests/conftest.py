"""For all tests: array shapes are checked at run time, and the photographed scenes are found."""

import os
from pathlib import Path

import jaxtyping
import pytest

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # before OpenMP is loaded, as the command line does

ROOT = Path(__file__).resolve().parent.parent


def checked_modules() -> list[str]:
    """All modules of the engine but those with numba kernels, which numba reads itself.

    Only leaves: the import hook takes a package's name for everything below it. Found by their files, as
    importing anything here would be too early.
    """
    files = (path.relative_to(ROOT).with_suffix("") for path in sorted((ROOT / "engine").rglob("*.py")))
    return [".".join(file.parts) for file in files if not file.name.startswith(("__init__", "kernels"))]


jaxtyping.install_import_hook(checked_modules(), "shape_checks.check")


@pytest.fixture(scope="session")
def scenes_root() -> Path:
    """Folder of the photographed scenes."""
    root = os.environ.get("OCTASPLAT_SCENES")
    if not root:
        pytest.skip("OCTASPLAT_SCENES does not name a folder of photographed scenes")
    return Path(root)

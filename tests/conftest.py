"""For all tests: array shapes are checked at run time, and the photographed scenes are found."""

import compileall
import gc
import os
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.support import shape_checks
from tests.support.longest_first import LONGEST_FIRST

if TYPE_CHECKING:
    from octasplat.engine.gaussians.model import FlatGaussians

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # before OpenMP is loaded, as the command line does

ROOT = Path(__file__).resolve().parent.parent
# The memory of written files is that of the tests, not of whoever runs them.
os.environ["OCTASPLAT_WRITTEN"] = str(Path(tempfile.mkdtemp(prefix="octasplat-tests-")) / "written.sqlite")
# Hundreds of processes are started, each of which would compile hundreds of modules anew without this.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False


def checked_modules() -> list[str]:
    """All modules of the engine but those with numba kernels, which numba reads itself.

    Only leaves: the import hook takes a package's name for everything below it. Found by their files, as
    importing anything here would be too early.
    """
    files = (path.relative_to(ROOT).with_suffix("") for path in sorted((ROOT / "engine").rglob("*.py")))
    return [
        ".".join(("octasplat", *file.parts))
        for file in files
        if not file.name.startswith("__init__") and "kernels" not in file.parts
    ]


shape_checks.install(checked_modules())


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option for tests that the daily run leaves out."""
    parser.addoption(
        "--exhaustive",
        action="store_true",
        help="run the tests marked exhaustive, too, which a run of whole folders leaves out",
    )


def pytest_configure(config: pytest.Config) -> None:
    """Files are handed out in the order of the items; xdist would begin with those of the most tests.

    Modules are compiled before, as the processes of jobs, which may write nothing, only read them so.
    """
    names_files = any(".py" in argument for argument in config.args)
    config.option.exhaustive |= names_files or "exhaustive" in config.option.markexpr
    if not hasattr(config, "workerinput"):
        for package in ("engine", "workers", "service"):
            compileall.compile_dir(ROOT / package, quiet=1)
    if hasattr(config.option, "loadscopereorder"):
        config.option.loadscopereorder = False


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """What takes long comes first, so that no process is left with it when the others have nothing to do.

    Tests marked exhaustive are left out of a run of whole folders. They run with ``--exhaustive``, and where
    files or this marker are asked for.
    """
    if not config.option.exhaustive:
        left_out = [item for item in items if item.get_closest_marker("exhaustive")]
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if not item.get_closest_marker("exhaustive")]
    items.sort(key=lambda item: LONGEST_FIRST.get(item.path.name, len(LONGEST_FIRST)))


def pytest_collection_finish() -> None:
    """The collector of garbage leaves out what collecting the tests has made: a million objects that stay."""
    gc.collect()
    gc.freeze()


def pytest_sessionfinish() -> None:
    """At the end all is collected as ever."""
    gc.unfreeze()


def pytest_runtest_setup() -> None:
    """The first calls of each function are checked in each test."""
    shape_checks.begin_test()


@pytest.fixture(scope="session")
def anyio_backend() -> str:
    """Asynchronous tests run on asyncio, as the service does."""
    return "asyncio"


@pytest.fixture(scope="session")
def scenes_root() -> Path:
    """Folder of the photographed scenes."""
    root = os.environ.get("OCTASPLAT_SCENES")
    if not root:
        pytest.skip("OCTASPLAT_SCENES does not name a folder of photographed scenes")
    return Path(root)


@pytest.fixture
def make_gaussians() -> "Callable[..., FlatGaussians]":
    """Makes random flat Gaussians."""
    from octasplat.engine.gaussians.model import FlatGaussians  # after the hook

    def make(count: int, sh_degree: int = 0, seed: int = 0) -> FlatGaussians:
        random = np.random.default_rng(seed)

        def normal(*shape: int) -> np.ndarray:
            return random.standard_normal(shape, dtype=np.float32)

        return FlatGaussians(
            means_world=normal(count, 3),
            quats_wxyz=normal(count, 4) * 3,
            log_scales=normal(count, 2) - 3,
            opacity_logits=normal(count) + 1,
            sh=normal(count, (sh_degree + 1) ** 2, 3),
        )

    return make

"""Kernels are found again by the content of their sources, and work where no folder can be written."""

import os
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.core import compilation
from octasplat.engine.core.compilation import run_on_threads, run_ranges
from octasplat.engine.core.kernel_folder import source_digest
from octasplat.engine.trace.cpu.kernels.spherical_harmonics import eval_sh_basis
from tests.support.daily import some_daily


def run_python(code: str, **environment: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)],
        # Python's own cache goes by time stamps, which do not always tell here
        env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1", **environment},
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout + done.stderr


SORT = """
    import logging
    logging.basicConfig()
    import numpy as np
    from octasplat.engine.trace.cpu.kernels import radix_sort as kernels_sort
    order, keys = kernels_sort.stable_argsort(np.array([3, 1, 2], np.int32), 2, 1)
    print(order, kernels_sort._scatter.stats.cache_hits)
"""


def test_second_process_finds_the_code_of_the_first(tmp_path: Path) -> None:
    assert "[1 2 0] Counter()" in run_python(SORT, NUMBA_CACHE_DIR=str(tmp_path))
    assert "[1 2 0] Counter({" in run_python(SORT, NUMBA_CACHE_DIR=str(tmp_path))


@pytest.mark.exhaustive
def test_same_sources_in_other_checkout_share_cache(tmp_path: Path) -> None:
    root = Path(compilation.__file__).parents[2]
    for name in ("one", "two"):
        package = tmp_path / name / "octasplat"
        package.mkdir(parents=True)
        (package / "__init__.py").touch()
        (package / "engine").symlink_to(root / "engine")
    code = str(tmp_path / "code")
    first = run_python(SORT, NUMBA_CACHE_DIR=code, PYTHONPATH=str(tmp_path / "one"))
    second = run_python(SORT, NUMBA_CACHE_DIR=code, PYTHONPATH=str(tmp_path / "two"))
    assert "Counter()" in first
    assert "Counter({" in second


@pytest.mark.parametrize(
    ("imports", "called"),
    some_daily(
        [
            ("from octasplat.engine.inner import factor", "factor"),
            ("from octasplat.engine import inner", "inner.factor"),
        ],
        {("from octasplat.engine import inner", "inner.factor")},
    ),
)
def test_changed_inlined_source_is_recompiled(tmp_path: Path, imports: str, called: str) -> None:
    package = tmp_path / "octasplat"
    (package / "engine").mkdir(parents=True)
    for name in ("__init__.py", "engine/__init__.py"):
        (package / name).touch()
    (package / "engine" / "core").symlink_to(Path(compilation.__file__).parent)
    inner, outer = package / "engine" / "inner.py", package / "engine" / "outer.py"
    imported = "from octasplat.engine.core.compilation import device_function, kernel\n"
    body = f"{imports}\n\n@kernel()\ndef scaled(x):\n    return {called}() * x\n"
    outer.write_text(imported + body)
    say = "from octasplat.engine.outer import scaled\nprint(scaled(2.0))"
    environment = {"NUMBA_CACHE_DIR": str(tmp_path / "code"), "PYTHONPATH": str(tmp_path)}
    found = []
    for value in ("3.0", "5.0"):
        inner.write_text(imported + f"\n@device_function()\ndef factor():\n    return {value}\n")
        os.utime(inner, (1.0, 1.0))  # the time stamp tells nothing
        found.append(run_python(say, **environment).strip())
    assert found == ["6.0", "10.0"]


@pytest.mark.exhaustive
@pytest.mark.skipif(not hasattr(os, "getuid"), reason="needs users")
def test_unwritable_cache_folder_is_replaced(tmp_path: Path) -> None:
    occupied = tmp_path / "file"
    occupied.write_text("")
    said = run_python(SORT, NUMBA_CACHE_DIR=str(occupied / "kernels"), TMPDIR=str(tmp_path))
    assert "[1 2 0]" in said
    assert f"compiled kernels cannot be kept in {occupied / 'kernels'}" in said
    private = tmp_path / f"octasplat-kernels-{os.getuid()}"
    assert private.stat().st_mode & 0o077 == 0
    assert list(private.rglob("*.nbi"))


@pytest.mark.exhaustive
def test_code_in_unwritable_cache_folder_is_read_where_it_is(tmp_path: Path) -> None:
    """As by the processes of jobs, which would copy many megabytes each."""
    shared, private = tmp_path / "shared", tmp_path / f"octasplat-kernels-{os.getuid()}"
    assert "[1 2 0]" in run_python(SORT, NUMBA_CACHE_DIR=str(shared))
    refuse = (
        "import os, pathlib\n"
        "from octasplat.engine.core import kernel_folder\n"
        "usable, shared = kernel_folder._is_usable, pathlib.Path(os.environ['NUMBA_CACHE_DIR'])\n"
        "kernel_folder._is_usable = lambda folder: folder != shared and usable(folder)\n"
    )
    said = run_python(refuse + textwrap.dedent(SORT), NUMBA_CACHE_DIR=str(shared), TMPDIR=str(tmp_path))
    assert "[1 2 0]" in said and "cannot be kept" not in said
    assert not [path for path in private.rglob("*") if path.suffix in (".nbi", ".nbc")]


@pytest.mark.exhaustive
def test_world_writable_cache_folder_is_not_used(tmp_path: Path) -> None:
    shared = tmp_path / "shared"
    shared.mkdir()
    shared.chmod(0o777)
    said = run_python(SORT, NUMBA_CACHE_DIR=str(shared), TMPDIR=str(tmp_path))
    assert "cannot be kept in" in said
    assert not list(shared.rglob("*.nbi"))


def test_device_function_called_from_python_raises() -> None:
    with pytest.raises(KeyError, match="eval_sh_basis is called by kernels only"):
        eval_sh_basis(np.zeros(16), 16, 0.0, 0.0, 1.0)


def test_digest_follows_imports_and_is_stable() -> None:
    one = source_digest("octasplat.engine.trace.cpu.kernels.radix_sort")
    assert one == source_digest("octasplat.engine.trace.cpu.kernels.radix_sort")
    assert one != source_digest("octasplat.engine.trace.cpu.kernels.packet_bvh")


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_ranges_cover_each_element_once(threads: int) -> None:
    seen = np.zeros(1003, int)

    def count(first: int, last: int) -> None:
        seen[first:last] += 1

    run_ranges(count, threads, len(seen), grain=1)
    assert (seen == 1).all()


def test_error_of_another_thread_reaches_the_caller() -> None:
    calls = iter([None, ValueError("broken"), None])

    def fail() -> None:
        error = next(calls)
        if error is not None:
            raise error

    with pytest.raises(ValueError, match="broken"):
        run_on_threads(fail, 3)

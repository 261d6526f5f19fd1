"""Processes share the compilation of kernels, jobs only read its results, and progress tells of it."""

import gc
import importlib
import os
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from octasplat.engine.core import compilation
from octasplat.engine.core.compiling import MESSAGE, compilation_seconds, report_compilation
from octasplat.engine.core.events import Event, KernelsCompiled, Noted
from octasplat.engine.core.kernel_signatures import decode_type, encode_type
from octasplat.engine.operations.precompile import (
    kernel_groups,
    kernels_by_group,
    kernels_of,
    missing_kernels,
    request_groups,
)
from octasplat.engine.operations.registry import operation
from octasplat.engine.trace.kernels.native import NativeCallback
from octasplat.workers.reporting.event_lines import ProgressState
from octasplat.workers.reporting.events import decode_event
from octasplat.workers.reporting.time_left import TimeLeftEstimator
from octasplat.workers.sandbox.landlock import landlock_version

KERNEL = """
from octasplat.engine.core.compilation import kernel

@kernel()
def doubled(x):
    return 2 * x
"""


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """Return the folder of a package that has the engine's core and one kernel."""
    engine = tmp_path / "octasplat" / "engine"
    engine.mkdir(parents=True)
    (engine.parent / "__init__.py").touch()
    (engine / "__init__.py").touch()
    (engine / "core").symlink_to(Path(compilation.__file__).parent)
    (engine / "toy.py").write_text(KERNEL)
    return tmp_path


def start(package: Path, code: str, **environment: str) -> "subprocess.Popen[str]":
    return subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(code)],
        env={**os.environ, "PYTHONPATH": str(package), **environment},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def test_processes_that_need_a_kernel_at_once_compile_it_once(package: Path, tmp_path: Path) -> None:
    code = """
        import numba.core.dispatcher as dispatcher, time
        from octasplat.engine.toy import doubled
        compile_now = doubled._compiler.compile
        def slowly(*arguments):
            time.sleep(2)
            return compile_now(*arguments)
        doubled._compiler.compile = slowly
        print("ready", flush=True)
        input()
        assert doubled(21) == 42
        print(sum(doubled.stats.cache_misses.values()) - sum(doubled.stats.cache_hits.values()))
    """
    both = [
        subprocess.Popen(
            [sys.executable, "-c", textwrap.dedent(code)],
            env={**os.environ, "PYTHONPATH": str(package), "NUMBA_CACHE_DIR": str(tmp_path / "code")},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        for _ in range(2)
    ]
    for process in both:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
    for process in both:
        assert process.stdin is not None
        process.stdin.write("\n")
        process.stdin.flush()
    said = sorted(process.communicate()[0].strip() for process in both)
    assert said == ["-1", "1"]


@pytest.mark.exhaustive
@pytest.mark.skipif(not landlock_version(), reason="the kernel has no Landlock")
def test_confined_process_reads_code_that_it_cannot_write(package: Path, tmp_path: Path) -> None:
    code, mine = tmp_path / "code", tmp_path / "mine"
    mine.mkdir()
    compile_it = "from octasplat.engine.toy import doubled; print(doubled(21), doubled.stats.cache_hits)"
    first = start(package, compile_it, NUMBA_CACHE_DIR=str(code)).communicate()[0]
    assert first.strip() == "42 Counter()"
    before = {path: path.read_bytes() for path in code.rglob("*") if path.is_file()}
    confined = f"""
        import pathlib
        from octasplat.workers.sandbox.confinement import confine
        confine(hidden=[pathlib.Path({str(code)!r})], readable=[pathlib.Path({str(code)!r})],
                writable=[pathlib.Path({str(mine)!r})],
                may_start_processes=True)
        from octasplat.engine.toy import doubled
        print(doubled(21), sum(doubled.stats.cache_hits.values()), doubled(0.5))
        for path in pathlib.Path({str(code)!r}).rglob("*.nbc"):
            try:
                path.write_bytes(b"")
            except OSError as error:
                print(type(error).__name__)
    """
    (package / "octasplat" / "workers").symlink_to(Path(compilation.__file__).parents[2] / "workers")
    said = start(package, confined, NUMBA_CACHE_DIR=str(code), TMPDIR=str(mine)).communicate()[0]
    assert said.split() == ["42", "1", "1.0", "PermissionError"]
    assert {path: path.read_bytes() for path in code.rglob("*") if path.is_file()} == before


def test_compilation_is_told_once_with_its_times_and_without_the_collector(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Code that an earlier run of this test has kept would not be compiled again.
    monkeypatch.setattr("numba.core.config.CACHE_DIR", str(tmp_path))
    told: list[Event] = []
    collecting: list[bool] = []

    @compilation.kernel()
    def tripled(x: float) -> float:
        return 3 * x

    compile_now = tripled._compiler.compile

    def watched(*arguments: object) -> object:
        collecting.append(gc.isenabled())
        return compile_now(*arguments)

    tripled._compiler.compile = watched
    before = compilation_seconds()
    with report_compilation(told.append):
        assert tripled(2) == 6
        assert tripled(2.0) == 6.0
    assert [event for event in told if isinstance(event, Noted)] == [Noted(MESSAGE)]
    times = [event.seconds for event in told if isinstance(event, KernelsCompiled)]
    assert len(times) == 2
    assert compilation_seconds() - before == pytest.approx(sum(times))
    assert collecting == [False, False]
    assert gc.isenabled()


def test_time_left_leaves_compilation_out(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter([0.0, 102.0])
    monkeypatch.setattr("octasplat.workers.reporting.time_left.time.monotonic", lambda: next(clock))
    estimator = TimeLeftEstimator()
    assert estimator.seconds_left(0, 10) is None
    estimator.leave_out(100.0)
    assert estimator.seconds_left(1, 10) == 18.0


def test_displays_take_the_event_of_a_job() -> None:
    event = decode_event("kernels_compiled", {"seconds": 2.5})
    assert event == KernelsCompiled(2.5)
    ProgressState().update(event)


def test_each_kernel_of_the_table_is_one() -> None:
    found = kernels_of(kernel_groups())
    assert len(found) > 40
    for kernel in found:
        dispatcher = getattr(importlib.import_module(kernel.module), kernel.function)
        function = dispatcher.function if isinstance(dispatcher, NativeCallback) else dispatcher.py_func
        assert function.__name__ == kernel.function
        assert [encode_type(decode_type(one)) for one in kernel.arguments] == list(kernel.arguments)
    assert not missing_kernels(["no such command"])


def test_kernels_of_the_first_iterations_are_compiled_first() -> None:
    groups = request_groups("reconstruct", operation("reconstruct").options())
    early, late = kernels_by_group(groups)
    assert {found.function for found in early} >= {
        "gather_pixels",
        "adam_step",
        "backward_packets_shared_sort",
    }
    assert {found.function for found in late} >= {"backward_packets", "fuse_view"}
    assert sorted(map(repr, early + late)) == sorted(map(repr, kernels_of(["reconstruct"])))


def test_groups_of_requests() -> None:
    options = operation("render").options
    assert request_groups("render", options()) == ("render",)
    assert request_groups("render", options().model_copy(update={"stage": "stage.toml"})) == ("render-stage",)


@pytest.mark.exhaustive
@pytest.mark.heavy
def test_commands_call_no_kernels_beyond_the_table(tmp_path: Path) -> None:
    root = Path(__file__).parents[2]
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.kernel_signatures"], cwd=root, capture_output=True, text=True
    )
    assert done.stdout == ""
    assert done.returncode == 0

"""Threads that libraries take: as many as were asked for, everywhere."""

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numba
import numpy as np
import pytest
import torch

from octasplat.engine.core.threads import limit_torch_threads, use_threads
from octasplat.engine.dataset.images import resize
from octasplat.engine.dataset.synthetic import SyntheticDatasetConfig, write_synthetic_dataset


@pytest.fixture(autouse=True)
def _restore() -> Iterator[None]:
    before = numba.get_num_threads(), torch.get_num_threads()
    yield
    numba.set_num_threads(before[0])
    torch.set_num_threads(before[1])


@pytest.mark.parametrize("asked", [1, 2, 0, 10_000])
def test_numba_threads_are_capped_at_available(asked: int) -> None:
    most = numba.config.NUMBA_NUM_THREADS
    expected = most if asked in (0, 10_000) else min(asked, most)
    assert use_threads(asked) == expected == numba.get_num_threads()


def test_photographs_are_resized_on_the_calling_thread_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    torch.set_num_threads(2)
    seen = []
    interpolate = torch.nn.functional.interpolate

    def watched(*args: object, **named: object) -> torch.Tensor:
        seen.append(torch.get_num_threads())
        return interpolate(*args, **named)

    monkeypatch.setattr(torch.nn.functional, "interpolate", watched)
    small = resize(np.full((8, 8, 3), 7, np.uint8), 4, 4)
    assert small.shape == (4, 4, 3) and (small == 7).all()
    assert seen == [1] and torch.get_num_threads() == 2


def test_torch_gets_its_threads_back_after_a_failure() -> None:
    torch.set_num_threads(2)
    with pytest.raises(ValueError, match="no"), limit_torch_threads():
        assert torch.get_num_threads() == 1
        raise ValueError("no")
    assert torch.get_num_threads() == 2


@pytest.mark.exhaustive
@pytest.mark.heavy
def test_run_with_one_thread_uses_one(tmp_path: Path) -> None:
    """A whole command takes hardly more CPU time than time on the clock, whatever the environment says."""
    scene = tmp_path / "scene"
    write_synthetic_dataset(
        scene, SyntheticDatasetConfig(views=8, width_px=64, height_px=48, samples_per_side=1, points=500)
    )
    command = [
        sys.executable, "-m", "octasplat", "reconstruct", str(scene), "-o", str(tmp_path / "out"), "--quiet",
        "--threads", "1", "--max-side", "48", "--iterations", "100", "--rays-per-batch", "4096",
    ]  # fmt: skip
    began = time.perf_counter()
    program = subprocess.Popen(command, env={**os.environ, "OMP_NUM_THREADS": "4"})
    _, status, used = os.wait4(program.pid, 0)
    program.returncode = os.waitstatus_to_exitcode(status)
    assert program.returncode == 0
    assert used.ru_utime < 1.25 * (time.perf_counter() - began)


def test_single_thread_build_leaves_no_running_threads() -> None:
    script = """
import time
import numpy as np
from octasplat.engine.trace.embree import EmbreeDevice, EmbreeTriangleScene
corners = np.random.default_rng(0).normal(size=(3000, 3)).astype(np.float32)
faces = np.arange(3000, dtype=np.uint32).reshape(-1, 3)
scenes = [EmbreeTriangleScene(EmbreeDevice(1), corners, faces) for _ in range(4)]
before = time.process_time()
time.sleep(1)
print(time.process_time() - before)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert float(done.stdout) < 0.3

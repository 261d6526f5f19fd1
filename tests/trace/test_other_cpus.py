"""The same bytes on another type of CPU: a small training whose libraries believe to be on an older one."""

import hashlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
HASWELL = {
    # The first with AVX2 and fused multiply-adds, of 2013; every x86-64 server since has these.
    "NUMBA_CPU_NAME": "haswell",
    "NUMBA_CPU_FEATURES": "+avx,+avx2,+bmi,+bmi2,+cmov,+cx16,+f16c,+fma,+fsgsbase,+fxsr,+lzcnt,+mmx,+movbe,"
    "+pclmul,+popcnt,+sahf,+sse,+sse2,+sse3,+sse4.1,+sse4.2,+ssse3,+xsave,+xsaveopt",
    "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR",
    "OPENBLAS_CORETYPE": "Haswell",
    "ATEN_CPU_CAPABILITY": "avx2",
}
TRAINING = """
import sys, tempfile
from pathlib import Path
from tests.support.planar_dataset import PlanarDataset, small_config
from octasplat.engine.train.loop.state import initial_state
from octasplat.engine.train.loop.trainer import Trainer
world = PlanarDataset()
config = small_config(iterations=60, sh_degree_interval=30, loss={"ssim": 0.2})
with tempfile.TemporaryDirectory() as folder:
    trained = Trainer(
        world, config, initial_state(world.initial_gaussians(), 0),
        folder=Path(folder), fingerprint="", progress=lambda event: None, threads=1,
    ).run()
for name in ("means_world", "quats_wxyz", "log_scales", "opacity_logits", "sh"):
    sys.stdout.buffer.write(getattr(trained, name).tobytes())
"""


def trained(environment: dict[str, str]) -> str:
    """Digest of what a training in a process with these variables ends with."""
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", TRAINING],
        env={**os.environ, **environment},
        cwd=ROOT,
        capture_output=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr.decode()
    assert len(done.stdout) > 300 * 4 * 13
    return hashlib.sha256(done.stdout).hexdigest()


@pytest.mark.exhaustive
@pytest.mark.heavy
def test_training_is_bit_identical_on_older_cpu() -> None:
    flags = Path("/proc/cpuinfo").read_text().split() if Path("/proc/cpuinfo").exists() else []
    if not {"avx2", "fma"} <= set(flags):
        pytest.skip("this CPU has no AVX2 with fused multiply-adds")
    assert trained(HASWELL) == trained({})

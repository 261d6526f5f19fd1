"""Time, memory and size of writing and reading a million Gaussians in each splat format.

    python benchmarks/splat_formats.py [--count 1000000] [--sh-degree 0]

Each step runs in a process of its own, so that its peak memory is its own; the scene's arrays are part of it.
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from octasplat.engine.files import export_scene, read_scene
from octasplat.engine.gaussians.model import FlatGaussians

NAMES = ("scene.ply", "scene.splat", "scene.spz", "scene.splats.glb", "scene.usdc")


def random_scene(count: int, sh_degree: int) -> FlatGaussians:
    """Gaussians of plausible size, opacity and color, in no order."""
    random = np.random.default_rng(0)

    def normal(*shape: int) -> np.ndarray:
        return random.standard_normal(shape, dtype=np.float32)

    return FlatGaussians(
        normal(count, 3) * 3,
        normal(count, 4),
        normal(count, 2) * np.float32(0.5) - 4,
        normal(count) * 2,
        normal(count, (sh_degree + 1) ** 2, 3) * np.float32(0.3),
    )


def peak_megabytes() -> float:
    """Peak resident memory of this process."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1000


def step(action: str, path: Path, count: int, sh_degree: int) -> None:
    """Write or read once and print seconds, peak memory and the memory that was there before."""
    if action == "write":
        scene = random_scene(count, sh_degree)
        export_scene(scene.select(np.arange(10)), path.with_name("warm-" + path.name))
        before, began = peak_megabytes(), time.perf_counter()
        export_scene(scene, path)
    else:
        before, began = peak_megabytes(), time.perf_counter()
        scene, _ = read_scene(path)
        assert len(scene) == count
    seconds = time.perf_counter() - began
    print(json.dumps({"seconds": seconds, "peak": peak_megabytes(), "before": before}))


def main() -> None:
    """Run every step and print a table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--count", type=int, default=1_000_000)
    parser.add_argument("--sh-degree", type=int, default=0)
    parser.add_argument("--step", nargs=2, metavar=("ACTION", "PATH"))
    options = parser.parse_args()
    if options.step:
        step(options.step[0], Path(options.step[1]), options.count, options.sh_degree)
        return
    print(f"{options.count:,} Gaussians, harmonics of degree {options.sh_degree}")
    print("| file | MB | write s | peak MB | read s | peak MB |\n|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for name in NAMES:
            path = Path(folder) / name
            cells = []
            for action in ("write", "read"):
                if action == "read" and name.endswith(".usdc"):
                    cells += ["-", "-"]
                    continue
                command = [sys.executable, __file__, "--count", str(options.count)]
                command += ["--sh-degree", str(options.sh_degree), "--step", action, str(path)]
                done = subprocess.run(command, capture_output=True, text=True, check=True)
                found = json.loads(done.stdout.splitlines()[-1])
                cells += [f"{found['seconds']:.2f}", f"{found['peak']:.0f}"]
            print(f"| {name} | {path.stat().st_size / 1e6:.0f} | {' | '.join(cells)} |", flush=True)
            path.unlink()


if __name__ == "__main__":
    main()

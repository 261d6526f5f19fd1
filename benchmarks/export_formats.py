"""Time, memory and size of each export of a random scene.

    python benchmarks/export_formats.py [COUNT] [FORMAT ...]

Each format runs in a process of its own, whose peak of resident memory includes the scene. Without names, the
formats that need nothing but this package are measured.
"""

import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from octasplat.engine.files import export_scene
from octasplat.engine.gaussians.model import FlatGaussians

NAMES = {
    "mesh-ply": "scene.mesh.ply",
    "glb": "scene.glb",
    "obj": "scene.obj",
    "gaussians": "scene.ply",
    "splat": "scene.splat",
    "spz": "scene.spz",
    "khr-glb": "scene.splats.glb",
}


def random_scene(count: int) -> FlatGaussians:
    """Opaque enough that all have an octagon."""
    random = np.random.default_rng(0)

    def normal(*shape: int) -> np.ndarray:
        return random.standard_normal(shape, dtype=np.float32)

    return FlatGaussians(
        normal(count, 3), normal(count, 4), normal(count, 2) - 4, normal(count) + 1, normal(count, 1, 3)
    )


def measure(name: str, count: int) -> None:
    """One row of the table, for a process of its own."""
    scene = random_scene(count)
    with tempfile.TemporaryDirectory() as folder:
        start, worked = time.perf_counter(), time.process_time()
        files = export_scene(scene, Path(folder) / NAMES[name])
        seconds, worked = time.perf_counter() - start, time.process_time() - worked
        size = sum(path.stat().st_size for path in files)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    row = (seconds, worked, size / 1e6, size / count, peak / 1e6)
    print("| {} | {:.1f} | {:.1f} | {:.0f} | {:.0f} | {:.0f} |".format(name, *row))


def main() -> None:
    """Print the table."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 1_000_000
    print(f"{count:,} Gaussians\n")
    print(
        "| format | s | s of CPU | MB | B per Gaussian | peak memory, MB |\n|---|---|---|---|---|---|",
        flush=True,
    )
    for name in sys.argv[2:] or NAMES:
        subprocess.run([sys.executable, __file__, str(count), "--one", name], check=True)


if __name__ == "__main__":
    if "--one" in sys.argv:
        measure(sys.argv[-1], int(sys.argv[1]))
    else:
        main()

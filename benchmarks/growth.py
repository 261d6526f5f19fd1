"""How time and memory grow from 10,000 to 1,000,000 Gaussians.

    python benchmarks/growth.py [--largest 1000000]

At about ten hits a ray whatever the count: 65,536 rays of one camera image; as many rays of a window that
shrinks as the Gaussians do, so that neighbouring rays share as much as in a photograph of matching
resolution; whole training iterations on synthetic photographs; and what each further Gaussian takes of the
peak memory of such a training with harmonics of degree 2, from twice to four times the largest count.
"""

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from tracer_vs_mitsuba import SETTINGS, camera_rays, cloud

from octasplat.engine.core.rays import RayBatch
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.morton import morton_order
from octasplat.engine.trace.cpu.tracer import CpuTracer
from octasplat.engine.trace.protocol import TraceGradients
from octasplat.engine.train.config import McmcConfig, TrainConfig
from octasplat.engine.train.loop.state import initial_state
from octasplat.engine.train.loop.trainer import Trainer

SMALLEST = 10_000


def sorted_cloud(count: int) -> FlatGaussians:
    """The cloud in the memory order that training keeps."""
    gaussians = cloud(count)
    return gaussians.select(morton_order(gaussians.means_world))


def microseconds_a_ray(gaussians: FlatGaussians, zoom: float, repeats: int = 5) -> tuple[float, float, float]:
    """Median wall time of forward and backward, and hits a ray; ``zoom`` narrows the camera's view."""
    origins, directions = camera_rays(gaussians, zoom)
    tracer = CpuTracer(SETTINGS, threads=2)
    tracer.build(gaussians)
    gradient = TraceGradients(rgb_srgb=np.ones((len(origins), 3), np.float32))
    forward, backward = [], []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        seen = tracer.trace(RayBatch(origins, directions), record=True)
        middle = time.perf_counter()
        assert seen.recording is not None
        tracer.backward(seen.recording, gradient)
        forward.append(middle - start)
        backward.append(time.perf_counter() - middle)
    scale = 1e6 / len(origins)
    return (
        scale * float(np.median(forward[1:])),
        scale * float(np.median(backward[1:])),
        float(seen.hit_counts.mean()),
    )


class CloudPhotographs:
    """Views from a ring around the cloud whose pixels are noise: training's work without its photographs."""

    has_alpha = False
    extent = 2.0

    def __init__(self, count: int = 40, side_px: int = 512) -> None:
        from types import SimpleNamespace

        self.views = tuple(SimpleNamespace(width_px=side_px, height_px=side_px) for _ in range(count))
        self.train_indices = np.arange(count)
        self.test_indices = np.empty(0, np.int64)
        self._side = side_px
        angle = 2 * np.pi * np.arange(count) / count
        self._origins = 2.5 * np.stack([np.cos(angle), np.sin(angle), 0.3 * np.sin(3 * angle)], axis=1)

    def rays(self, view: np.ndarray, y: np.ndarray, x: np.ndarray) -> RayBatch:
        """Rays towards the middle of the cloud."""
        origins = self._origins[view]
        forward = -origins / np.linalg.norm(origins, axis=1, keepdims=True)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right, axis=1, keepdims=True)
        down = np.cross(forward, right)
        a, b = ((np.stack([x, y]) + 0.5) / self._side - 0.5) * 0.8
        directions = forward + a[:, None] * right + b[:, None] * down
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        return RayBatch(origins, directions)

    def pixels(
        self, view: np.ndarray, y: np.ndarray, x: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Grey noise that depends on the pixel alone."""
        grey = ((view * 7919 + y * 104729 + x * 1299709) % 256 / 255).astype(np.float32)
        return np.repeat(grey[:, None], 3, axis=1), np.ones_like(grey), np.ones_like(grey)


def milliseconds_an_iteration(gaussians: FlatGaussians, iterations: int = 50, sh_degree: int = 0) -> float:
    """Mean wall time of a training iteration, rebuilds of the hierarchy included, densification not."""
    config = TrainConfig(
        iterations=iterations, max_gaussians=len(gaussians), sh_degree=sh_degree, sh_degree_interval=1,
        checkpoint_every=10_000, probe_rays=256, densify=McmcConfig(start=10_000),
    )  # fmt: skip
    marks: list[tuple[int, float]] = []

    def listen(event: object) -> None:
        if type(event).__name__ == "TrainingProgress":
            marks.append((event.iteration, event.seconds))  # type: ignore[attr-defined]

    with tempfile.TemporaryDirectory() as folder:
        Trainer(
            CloudPhotographs(), config, initial_state(gaussians, 0),
            folder=Path(folder), fingerprint="growth", progress=listen, threads=2,
        ).run()  # fmt: skip
    (first, began), (last, ended) = marks[0], marks[-1]
    return 1e3 * (ended - began) / (last - first)


def peak_bytes(count: int) -> int:
    """Peak memory of a process that trains ``count`` Gaussians with harmonics of degree 2 50 times."""
    script = (
        "import resource, growth; growth.milliseconds_an_iteration(growth.sorted_cloud({}), 50, 2);"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024)"
    )
    done = subprocess.run(
        [sys.executable, "-c", script.format(count)],
        cwd=Path(__file__).parent, capture_output=True, text=True, check=True,
    )  # fmt: skip
    return int(done.stdout)


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--largest", type=int, default=1_000_000)
    parser.add_argument("--iterations", type=int, default=160)
    options = parser.parse_args()
    counts = [n for n in (SMALLEST, 100_000, 1_000_000) if n <= options.largest]
    print("Gaussians   image: fwd  bwd us/ray  hits   window: fwd  bwd us/ray  hits   iteration ms")
    for count in counts:
        gaussians = sorted_cloud(count)
        image = microseconds_a_ray(gaussians, 1.0)
        window = microseconds_a_ray(gaussians, 3.0 * (count / SMALLEST) ** 0.5)
        iteration = milliseconds_an_iteration(gaussians, options.iterations)
        print(
            f"{count:9d}        {image[0]:6.2f} {image[1]:5.2f}      {image[2]:5.1f}         {window[0]:6.2f}"
            f" {window[1]:5.2f}      {window[2]:5.1f}        {iteration:6.1f}",
            flush=True,
        )
    most = counts[-1]
    more = (peak_bytes(4 * most) - peak_bytes(2 * most)) / (2 * most)
    print(f"{more:.0f} bytes for each further Gaussian")


if __name__ == "__main__":
    main()

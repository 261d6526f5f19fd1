"""Our tracer against Mitsuba 3's differentiable splatting integrator: same Gaussians, rays and threads.

    pip install mitsuba==3.9.1        # and Debian's libllvm19
    export DRJIT_LIBLLVM_PATH=/usr/lib/x86_64-linux-gnu/libLLVM.so.19.1
    python benchmarks/tracer_vs_mitsuba.py [scene.ply ...]

Without a scene, a cloud of 100,000 flat Gaussians is made. Both sides trace 65,536 camera rays in turn, so
that a slow moment of the machine hits both; the medians and their ratio are printed. Threads
that wait are asleep, ours as in the command line, Mitsuba's after a pause.
"""

import argparse
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numpy as np

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # before OpenMP is loaded, as the command line does

from octasplat.engine.core.rays import RayBatch
from octasplat.engine.files import read_scene
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.octagon import CHI2_3_99, octagon_radii
from octasplat.engine.render.renderer import tile_order
from octasplat.engine.trace.cpu.tracer import CpuTracer
from octasplat.engine.trace.protocol import GaussianGradients, TraceGradients, TraceResult, TraceSettings

SIDE = 256
ENLARGE = 3.0
PAUSE_SECONDS = 0.1
"""Before each measurement, so that the other side's threads no longer wait at full speed."""
SETTINGS = TraceSettings(q=CHI2_3_99, transmittance_min=0.01, alpha_max=0.9999)


def cloud(count: int, seed: int = 0) -> FlatGaussians:
    """Flat Gaussians in a unit ball, of random orientation, about ten of them on a ray."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, 3))
    points *= rng.random((count, 1)) ** (1 / 3) / np.linalg.norm(points, axis=1, keepdims=True)
    size = 1.9 * count**-0.5
    return FlatGaussians(
        means_world=points.astype(np.float32),
        quats_wxyz=rng.normal(size=(count, 4)).astype(np.float32),
        log_scales=(np.log(size) + 0.3 * rng.normal(size=(count, 2))).astype(np.float32),
        opacity_logits=rng.uniform(-2.0, 1.0, count).astype(np.float32),
        sh=rng.uniform(-1.0, 1.0, (count, 1, 3)).astype(np.float32),
    )


def camera_rays(gaussians: FlatGaussians, zoom: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Rays of a square image that the scene's middle fills at zoom 1, tile after tile."""
    low, high = np.quantile(gaussians.means_world, [0.1, 0.9], axis=0)
    centre, size = (low + high) / 2, float(np.linalg.norm(high - low))
    origin = centre + size * np.array([0.3, -0.2, -1.5])
    forward = (centre - origin) / np.linalg.norm(centre - origin)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    steps = ((np.arange(SIDE) + 0.5) / SIDE - 0.5) * 0.7 / zoom
    y, x = np.meshgrid(steps, steps, indexing="ij")
    directions = forward + x.reshape(-1, 1) * right + y.reshape(-1, 1) * down
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    directions = directions.astype(np.float32)[tile_order(SIDE, SIDE)]
    return np.broadcast_to(origin.astype(np.float32), directions.shape).copy(), directions


class Mitsuba:
    """The same scene and rays in Mitsuba."""

    def __init__(self, gaussians: FlatGaussians, origins: np.ndarray, directions: np.ndarray) -> None:
        import drjit as dr
        import mitsuba as mi

        from tests.support.mitsuba_gaussians import ellipsoids

        mi.set_variant("llvm_ad_rgb")
        dr.set_thread_count(2)
        self.dr, self.mi = dr, mi
        self.scene = mi.load_dict({"type": "scene", "gaussians": ellipsoids(gaussians, CHI2_3_99**0.5)})
        self.integrator = mi.load_dict(
            {"type": "volprim_rf_basic", "max_depth": SETTINGS.max_hits, "srgb_primitives": False}
        )
        self.origins, self.directions = mi.Point3f(origins.T), mi.Vector3f(directions.T)
        self.sampler = mi.load_dict({"type": "independent"})
        self.parameters = mi.traverse(self.scene)
        self.keys = [key for key in self.parameters.keys() if key.split(".")[-1] in NAMES]  # noqa: SIM118

    def _sample(self, mode: object, gradient: object, state: object) -> tuple[object, object]:
        dr, mi = self.dr, self.mi
        rays = mi.Ray3f(self.origins, self.directions)
        out, _, _, state = self.integrator.sample(
            mode, self.scene, self.sampler, rays, gradient, state, mi.Bool(True)
        )
        dr.eval(out, state)
        return out, state

    def forward(self) -> np.ndarray:
        """Colors of all rays."""
        with self.dr.suspend_grad():
            out, _ = self._sample(self.dr.ADMode.Primal, None, None)
        return np.array(out).T

    def forward_backward(self, gradient: np.ndarray) -> dict[str, np.ndarray]:
        """Gradients of every parameter, by path replay: a primal pass and an adjoint one."""
        dr, mi = self.dr, self.mi
        for key in self.keys:
            dr.enable_grad(self.parameters[key])
        self.parameters.update()
        with dr.suspend_grad():
            _, state = self._sample(dr.ADMode.Primal, None, None)
            self._sample(dr.ADMode.Backward, mi.Spectrum(gradient.T), state)
        found = {key.split(".")[-1]: dr.grad(self.parameters[key]) for key in self.keys}
        dr.eval(found)
        dr.sync_thread()
        return {name: np.array(value) for name, value in found.items()}


NAMES = ("centers", "scales", "quaternions", "opacities", "sh_coeffs", "data")


def median_seconds(functions: list[Callable[[], object]], repeats: int) -> list[float]:
    """Median wall time of each function, run in turn after two rounds of warm-up."""
    times: list[list[float]] = [[] for _ in functions]
    for repeat in range(repeats + 2):
        for k, function in enumerate(functions):
            time.sleep(PAUSE_SECONDS)
            start = time.perf_counter()
            function()
            if repeat >= 2:
                times[k].append(time.perf_counter() - start)
    return [float(np.median(t)) for t in times]


def compare(name: str, gaussians: FlatGaussians, repeats: int, order: Literal["ray", "packet"]) -> None:
    """Print how long both sides take on one scene."""
    gaussians = gaussians.select(np.flatnonzero(octagon_radii(gaussians.opacities, SETTINGS.q) > 0))
    # Mitsuba steps 1e-4 beyond each hit: the scene is made large, so that it steps over nothing else.
    gaussians.means_world *= np.float32(ENLARGE)
    gaussians.log_scales += np.float32(np.log(ENLARGE))
    origins, directions = camera_rays(gaussians)
    theirs = Mitsuba(gaussians, origins, directions)
    ours = CpuTracer(SETTINGS.model_copy(update={"sort": order}), threads=2)
    ours.build(gaussians)
    gradient = np.random.default_rng(1).normal(size=(len(origins), 3)).astype(np.float32)

    def forward() -> TraceResult:
        return ours.trace(RayBatch(origins, directions))

    def forward_backward() -> GaussianGradients:
        hits = ours.trace(RayBatch(origins, directions), record=True).recording
        assert hits is not None
        return ours.backward(hits, TraceGradients(rgb_srgb=gradient))

    seen = forward()
    psnr = -10 * np.log10(np.mean((seen.rgb_srgb - theirs.forward()) ** 2))
    found = sorted(theirs.forward_backward(gradient))
    print(
        f"{name}: {len(gaussians)} Gaussians, {len(origins)} rays, {seen.hit_counts.mean():.1f} hits a ray; "
        f"pictures agree to {psnr:.1f} dB; Mitsuba's gradients: {', '.join(found)}"
    )
    for label, mine, other in (
        ("forward", forward, theirs.forward),
        ("forward + backward", forward_backward, lambda: theirs.forward_backward(gradient)),
    ):
        a, b = median_seconds([mine, other], repeats)
        print(f"  {label:18s} {1e3 * a:7.1f} ms, Mitsuba {1e3 * b:7.1f} ms: {b / a:.1f} times", flush=True)


def main() -> None:
    """Compare on every scene."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("scenes", nargs="*", type=Path)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--order", choices=["ray", "packet"], default="ray", help="packet: as trainings do")
    options = parser.parse_args()
    for name, gaussians in [(path.stem, read_scene(path)[0]) for path in options.scenes] or [
        ("generated cloud", cloud(100_000))
    ]:
        compare(name, gaussians, options.repeats, options.order)


if __name__ == "__main__":
    main()

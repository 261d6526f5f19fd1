"""How fast stages are rendered: milliseconds a frame and paths a second, beside Mitsuba 3 on the same meshes.

python benchmarks/light.py                        # 480 x 270 with 16 samples, without Gaussians
python benchmarks/light.py --gaussians 100000 --mitsuba none
"""

import argparse
import resource
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from engine.gaussians.model import SH_C0, FlatGaussians
from engine.light.integrator import LitScene, PathTracer
from engine.light.layers import stage_layers
from engine.light.stage import (
    Diffuse,
    Glass,
    Integrator,
    Metal,
    Mirror,
    RectangleLight,
    Stage,
    StageGaussians,
    StageMesh,
)
from engine.light.staging import stage_meshes
from engine.trace.protocol import TraceSettings

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "light"))
from light_scenes import camera

DEPTH = 5


def stage(samples: int) -> Stage:
    """A floor, four balls (mirror, glass, rough metal, matt) and a lamp."""
    balls = (
        Mirror(),
        Glass(),
        Metal(colour_srgb=(1, 1, 1), roughness=0.5, multiple_scattering=False),
        Diffuse(),
    )
    meshes = tuple(
        StageMesh(
            shape="sphere", position=(1.7 * k - 2.55, -0.8, 0), scale=0.8, smooth_degrees=180, material=m
        )
        for k, m in enumerate(balls)
    )
    floor = StageMesh(shape="plane", scale=6, material=Diffuse())
    lamp = RectangleLight(position=(0, -5, -1), direction=(0, 1, 0.2), width=3, height=3, radiance=8)
    numbers = Integrator(samples=samples, max_depth=DEPTH, roulette_depth=64)
    return Stage(
        gaussians=(StageGaussians(light="emissive"),),
        meshes=(floor, *meshes),
        lights=(lamp,),
        integrator=numbers,
    )


def cloud(count: int) -> FlatGaussians:
    """Gaussians on a wall behind and a dome around, about as many on a ray as a trained scene has."""
    rng = np.random.default_rng(0)
    way = rng.normal(size=(count, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    size = np.log(4.0 / np.sqrt(count) * 10)
    return FlatGaussians(
        (way * rng.uniform(9, 11, (count, 1))).astype(np.float32),
        rng.normal(size=(count, 4)).astype(np.float32),
        rng.normal(size, 0.3, (count, 2)).astype(np.float32),
        rng.uniform(-1, 3, count).astype(np.float32),
        ((rng.random((count, 1, 3)) - 0.5) / SH_C0).astype(np.float32),
    )


def mitsuba_scene(variant: str, size: tuple[int, int], folder: Path, lit: Any) -> Any:
    """The same triangles for Mitsuba."""
    import test_against_mitsuba as twin

    twin.mi.set_variant(variant)
    white = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": twin.linear(0.8, 0.8, 0.8)}}
    rough = {"type": "roughconductor", "material": "none", "distribution": "ggx", "alpha": 0.25}
    bsdfs = [
        white, {"type": "twosided", "bsdf": {"type": "conductor", "material": "none"}},
        {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}, {"type": "twosided", "bsdf": rough}, white,
        {"type": "area", "radiance": {"type": "rgb", "value": 8.0}},
    ]  # fmt: skip
    return twin.mitsuba_scene(lit, folder, bsdfs, {}, variant=variant, size=size, eye=EYE, depth=DEPTH)


EYE = ((0.0, -2.5, -7.0), (0.0, -0.7, 0.0))


def main() -> None:
    """Measure and print a line each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--width", type=int, default=480)
    parser.add_argument("--height", type=int, default=270)
    parser.add_argument("--samples", type=int, default=16)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--gaussians", type=int, default=0)
    parser.add_argument("--mitsuba", default="scalar_rgb", help="variant, or none")
    options = parser.parse_args()
    lit, size = stage(options.samples), (options.width, options.height)
    layers = None
    if options.gaussians:
        layers = stage_layers(
            lit, cloud(options.gaussians), lambda path: sys.exit(str(path)), Path(), TraceSettings(), size=1.0
        )
    tracer = PathTracer(LitScene(stage_meshes(lit, Path()), layers), lit.integrator)
    image = camera(*EYE, size, 40).rays()
    paths = options.width * options.height * options.samples
    report("ours", paths, lambda: tracer.render(image), options.repeats)
    if options.mitsuba != "none":
        with TemporaryDirectory() as folder:
            scene = mitsuba_scene(options.mitsuba, size, Path(folder), lit)
            import mitsuba as mi

            seeds = iter(range(1000))
            report(
                options.mitsuba, paths,
                lambda: np.array(mi.render(scene, spp=options.samples, seed=next(seeds))), options.repeats,
            )  # fmt: skip
    print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB")


def report(name: str, paths: int, work: Any, repeats: int) -> None:
    """The fastest of some repeats after one to warm up."""
    work()
    clock, cpu = [], []
    for _ in range(repeats):
        began, before = time.perf_counter(), time.process_time()
        work()
        clock.append(time.perf_counter() - began)
        cpu.append(time.process_time() - before)
    print(
        f"{name}: {1e3 * min(clock):.0f} ms a frame, {paths / min(clock) / 1e6:.2f} million paths a second; "
        f"{1e3 * min(cpu):.0f} ms of CPU"
    )


if __name__ == "__main__":
    main()

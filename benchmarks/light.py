"""How fast stages are rendered, beside Mitsuba 3 where it can do the same.

    python benchmarks/light.py                                # 480 x 270 with 16 samples, meshes alone
    python benchmarks/light.py --gaussians 100000             # the same stage in a dome of Gaussians
    python benchmarks/light.py --beside-mirror 100000         # Gaussians and a mirror
    python benchmarks/light.py --kinds 100000                 # rays a second, by kind of ray

Mitsuba's LLVM variants want DRJIT_LIBLLVM_PATH to name an LLVM of 19 or so. What is compared is run in turn,
so that a slow moment of the machine hits both; CPU time of all threads says more than the clock where others
work.
"""

import argparse
import resource
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from octasplat.engine.core.rays import RayBatch
from octasplat.engine.gaussians.model import SH_C0, FlatGaussians
from octasplat.engine.gaussians.octagon import CHI2_3_99
from octasplat.engine.pathtracing.compile_meshes import CompiledMeshes, compile_meshes
from octasplat.engine.pathtracing.gaussian_layers import GaussianLayers, build_gaussian_layers
from octasplat.engine.pathtracing.path_tracer import PathTracer, PathTracerScene
from octasplat.engine.pathtracing.stage.materials import Diffuse, Glass, Metal, Mirror
from octasplat.engine.pathtracing.stage.model import (
    Integrator,
    RectangleLight,
    Stage,
    StageGaussians,
    StageMesh,
)
from octasplat.engine.trace.protocol import TraceSettings
from tests.support.light_scenes import camera

DEPTH = 5


def stage(samples: int) -> Stage:
    """A floor, four balls (mirror, glass, rough metal, matt) and a lamp."""
    balls = (
        Mirror(),
        Glass(),
        Metal(color_srgb=(1, 1, 1), roughness=0.5, multiple_scattering=False),
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
    from tests.pathtracing import test_against_mitsuba as twin

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
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--width", type=int, default=480)
    parser.add_argument("--height", type=int, default=270)
    parser.add_argument("--samples", type=int, default=16)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--gaussians", type=int, default=0)
    parser.add_argument("--beside-mirror", type=int, default=0, metavar="GAUSSIANS")
    parser.add_argument("--kinds", type=int, default=0, metavar="GAUSSIANS")
    parser.add_argument("--mitsuba", nargs="*", default=["scalar_rgb"], help="variants, or none")
    options = parser.parse_args()
    size = (options.width, options.height)
    if options.kinds:
        kinds(options.kinds)
    elif options.beside_mirror:
        beside_mirror(options.beside_mirror, size, options.repeats)
    else:
        frames(size, options.samples, options.gaussians, options.mitsuba, options.repeats)
    print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB")


def frames(size: tuple[int, int], samples: int, gaussians: int, variants: list[str], repeats: int) -> None:
    """Frames of the stage; Mitsuba takes part where there are no Gaussians."""
    lit = stage(samples)
    layers = None if gaussians == 0 else gaussian_layers(lit, cloud(gaussians), TraceSettings())
    tracer = PathTracer(PathTracerScene(compile_meshes(lit, Path()), layers), lit.integrator)
    image = camera(*EYE, size, 40).rays()
    works = {"ours": lambda: tracer.render(image)}
    with TemporaryDirectory() as folder:
        for variant in variants if gaussians == 0 else []:
            works[variant] = mitsuba_work(variant, size, Path(folder), lit)
        report(works, size[0] * size[1] * samples, "path", repeats)


def mitsuba_work(variant: str, size: tuple[int, int], folder: Path, lit: Stage) -> Callable[[], object]:
    """What renders a frame in Mitsuba."""
    import drjit as dr
    import mitsuba as mi

    scene, seeds = mitsuba_scene(variant, size, folder, lit), iter(range(1000))
    if variant.startswith("llvm"):
        dr.set_thread_count(2)

    def work() -> object:
        mi.set_variant(variant)
        return np.array(mi.render(scene, spp=lit.integrator.samples, seed=next(seeds)))

    return work


def beside_mirror(count: int, size: tuple[int, int], repeats: int) -> None:
    """Gaussians and their mirror image, one ray a pixel."""
    from tests.support.mitsuba_gaussians import GaussiansBesideMirror

    # Both end a ray where less than a hundredth of it is left, and cut Gaussians off at the same ellipse.
    settings = TraceSettings(q=CHI2_3_99, transmittance_min=0.01, alpha_max=0.9999)
    numbers = Integrator(samples=1, max_depth=2, roulette_depth=64, anti_aliasing=False)
    floor = StageMesh(shape="plane", scale=6, material=Mirror())
    lit = Stage(gaussians=(StageGaussians(light="emissive"),), meshes=(floor,), integrator=numbers)
    dome, meshes = cloud(count), compile_meshes(lit, Path())
    tracer = PathTracer(PathTracerScene(meshes, gaussian_layers(lit, dome, settings)), numbers)
    image = camera(*EYE, size, 40).rays()
    theirs = GaussiansBesideMirror(dome, meshes.surfaces.corners_world, settings)
    far = image.origin_world, image.rays.directions_world
    shown = [tracer.render(image).image().rgb_srgb, theirs.trace(*far).reshape(size[1], size[0], 3)]
    error = np.mean((np.clip(shown[0], 0, 1) - np.clip(shown[1], 0, 1)) ** 2)
    print(f"{count} Gaussians beside a mirror: pictures agree to {-10 * np.log10(error):.1f} dB")
    works = {"ours": lambda: tracer.render(image), "llvm_ad_rgb": lambda: theirs.follow(*far)}
    report(works, size[0] * size[1], "pixel", repeats)


def kinds(count: int) -> None:
    """Rays a second by what they are: those of a frame of 240 x 135 with 16 samples."""
    lit = stage(16)
    layers = gaussian_layers(lit, cloud(count), TraceSettings())
    balls = {"mirror": Mirror(), "refracted": Glass(), "rough": Metal(roughness=0.5), "diffuse": Diffuse()}
    for name, material in balls.items():
        meshes = tuple(
            ball.model_copy(update={"material": material})
            for ball in lit.meshes
            if ball.shape == "sphere" or name != "refracted"
        )
        some = compile_meshes(lit.model_copy(update={"meshes": meshes}), Path())
        first, second, shadow = watched(some, layers, lit.integrator)
        if name == "mirror":
            rates("camera", first, some, layers, count)
        rates(name, second, some, layers, count)
        if name == "diffuse":
            rates("shadow", shadow, some, layers, count)


def rates(name: str, rays: RayBatch, meshes: CompiledMeshes, layers: GaussianLayers, count: int) -> None:
    """How fast rays go through meshes, and through Gaussians."""
    shadow = name == "shadow"
    ask = meshes.triangles.occluded if shadow else meshes.triangles.closest
    see = layers.tracer.transmittance if shadow else layers.tracer.trace
    report({f"{name}, meshes": lambda: ask(rays)}, len(rays), "ray", 3)
    report({f"{name}, {count} Gaussians": lambda: see(rays)}, len(rays), "ray", 3)


class Watched:
    """Passes everything on and keeps the rays that it is asked about."""

    def __init__(self, inner: Any) -> None:
        self._inner, self.seen = inner, []  # type: ignore[var-annotated]

    def closest(self, rays: RayBatch) -> Any:
        """See :class:`octasplat.engine.trace.triangle_bvh.TriangleBvh`."""
        hits = self._inner.closest(rays)
        self.seen.append(RayBatch(rays.origins_world, rays.directions_world, rays.t_min, hits.distances))
        return hits

    def transmittance(self, rays: RayBatch) -> Any:
        """See :class:`octasplat.engine.trace.protocol.Tracer`."""
        self.seen.append(rays)
        return self._inner.transmittance(rays)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._inner, name)


def watched(meshes: CompiledMeshes, layers: GaussianLayers, numbers: Integrator) -> tuple[RayBatch, ...]:
    """Camera rays, those from the first surfaces on, and those from there to lights, up to what they meet."""
    triangles, casters = Watched(meshes.triangles), Watched(layers.tracer)
    scene = PathTracerScene(replace(meshes, triangles=triangles), replace(layers, on_meshes=casters))
    once = numbers.model_copy(update={"max_depth": 1})
    PathTracer(scene, once).render(camera(*EYE, (240, 135), 40).rays())
    batch = 1 << 17
    nothing = triangles.seen[1][:0]
    return tuple(rays[:batch] for rays in (*triangles.seen[:2], (casters.seen or [nothing])[0]))


def gaussian_layers(lit: Stage, gaussians: FlatGaussians, settings: TraceSettings) -> GaussianLayers:
    """The layers of a stage with one scene of Gaussians."""
    layers = build_gaussian_layers(
        lit, gaussians, lambda path: sys.exit(str(path)), Path(), settings, size=1.0
    )
    assert layers is not None
    return layers


def report(works: dict[str, Callable[[], object]], count: int, what: str, repeats: int) -> None:
    """Medians of repeats in turn, after one to warm up where it is not just one; and ratios of CPU times."""
    clock: dict[str, list[float]] = {name: [] for name in works}
    cpu: dict[str, list[float]] = {name: [] for name in works}
    for repeat in range(1 if repeats == 1 else 0, repeats + 1):
        for name, work in works.items():
            began, before = time.perf_counter(), time.process_time()
            work()
            if repeat:
                clock[name].append(time.perf_counter() - began)
                cpu[name].append(time.process_time() - before)
    first = float(np.median(cpu[next(iter(works))]))
    for name in works:
        took = float(np.median(cpu[name]))
        print(
            f"{name}: {1e3 * took:.0f} ms of CPU ({1e3 * np.median(clock[name]):.0f} by the clock), "
            f"{1e6 * took / count:.3f} us a {what}, {count / took / 1e6:.2f} million a second of one core; "
            f"{took / first:.2f} times the first",
            flush=True,
        )


if __name__ == "__main__":
    main()

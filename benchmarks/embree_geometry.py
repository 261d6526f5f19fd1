"""Ways to give flat Gaussians to Embree, and colors of half the size, on the same rays.

    python benchmarks/embree_geometry.py [scene.ply]

The tracer gives Embree one box a Gaussian and tests the octagon in a callback. Here the same callback is
reached through one instance a Gaussian of a single unit box, and the hierarchy is refitted to moved Gaussians
instead of built anew. Then packets read their harmonics as 16-bit numbers instead of float32, as storage of
half the size would have them. Forward passes of 65,536 rays, two threads, in turn; medians are printed.
"""

import argparse
import ctypes
import gc
import resource
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numba import carray, cfunc, njit, types
from tracer_vs_mitsuba import SETTINGS, camera_rays, cloud

from octasplat.engine.core.rays import RayBatch
from octasplat.engine.files import read_scene
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.morton import morton_order
from octasplat.engine.gaussians.octagon import octagon_radii
from octasplat.engine.trace.cpu.kernels.kernel_args import (
    ForwardPass,
    GaussianParameters,
    HitArrays,
    PackedScene,
    RayArrays,
    TraceLimits,
)
from octasplat.engine.trace.cpu.kernels.octagon_hit import CONTEXT_WORDS, PRIMITIVE_WORDS, intersect_octagon
from octasplat.engine.trace.cpu.kernels.packed_primitives import pack_primitives, write_boxes
from octasplat.engine.trace.cpu.memory import ArrayPool, aligned_empty, empty_result, output_arrays
from octasplat.engine.trace.cpu.packets import PacketTracer, find_packets
from octasplat.engine.trace.cpu.single_rays import SingleRayTracer
from octasplat.engine.trace.embree import Handle
from octasplat.engine.trace.kernels.native import int32_pointer
from octasplat.engine.trace.protocol import TraceResult

THREADS, REPEATS = 2, 7
INSTANCE, REFIT, FLOAT3X4_COLUMN_MAJOR = 121, 3, 0x9234
SH_STEP = 1 / 4096
THICKNESS = 1e-6

meet = njit(intersect_octagon.function, fastmath={"contract"})


@cfunc(types.void(types.CPointer(types.uint64)), fastmath={"contract"})
def intersect_instance(arguments):
    """The octagon's callback, with the instance's number in place of the primitive's."""
    words = carray(arguments, 6)
    words[2] = np.uint64(carray(int32_pointer(words[3]), CONTEXT_WORDS)[0])
    meet(arguments)


@dataclass
class Boxes:
    """The scene as the tracer takes it."""

    gaussians: FlatGaussians
    records: np.ndarray
    boxes: np.ndarray


def prepare(gaussians: FlatGaussians) -> Boxes:
    """Records and boxes of the Gaussians."""
    parameters = GaussianParameters.from_gaussians(gaussians)
    records = aligned_empty((len(gaussians), PRIMITIVE_WORDS))
    boxes = np.empty((len(gaussians), 6), np.float32)
    pack_primitives(0, len(gaussians), records, parameters, SETTINGS.q)
    write_boxes(0, len(gaussians), boxes, parameters, SETTINGS.q, 0.0)
    return Boxes(gaussians, records, boxes)


def prepared(
    scene: Boxes, harmonics: np.ndarray, origins: np.ndarray, directions: np.ndarray
) -> tuple[TraceResult, ForwardPass]:
    """Room for the outputs of the rays, and a pass that records nothing."""
    count = len(origins)
    result = empty_result(count, 0)
    no_hits = HitArrays(
        np.empty(0, np.int64), np.empty(0, np.int32), np.empty(0, np.float32), np.empty(0, np.float32),
        np.empty((0, 3), np.float32),
    )  # fmt: skip
    features = np.empty((len(scene.gaussians), 0), np.float32)
    forward = ForwardPass(
        RayArrays.from_batch(RayBatch(origins, directions)), PackedScene(scene.records, harmonics, features),
        TraceLimits.from_settings(SETTINGS), output_arrays(result), no_hits, False,
    )  # fmt: skip
    return result, forward


class Instances(SingleRayTracer):
    """Single rays through one instance a Gaussian of the box around a unit octagon."""

    def build_instances(self, gaussians: FlatGaussians) -> None:
        """Build both levels."""
        self._unit = np.array([[-1, -1, -1, 1, 1, 1]], np.float32)
        self.build(self._unit)
        assert self._bvh is not None
        lib, device = self._device._lib, self._device
        lib.rtcSetGeometryInstancedScene.argtypes = [Handle, Handle]
        lib.rtcSetGeometryTransform.argtypes = [Handle, ctypes.c_uint, ctypes.c_int, ctypes.c_void_p]
        lib.rtcGetGeometry.restype, lib.rtcGetGeometry.argtypes = Handle, [Handle, ctypes.c_uint]
        inner = lib.rtcGetGeometry(self._bvh.handle, 0)
        lib.rtcSetGeometryIntersectFunction(inner, intersect_instance.address)
        lib.rtcCommitGeometry(inner)
        lib.rtcJoinCommitScene(self._bvh.handle)
        radius = octagon_radii(gaussians.opacities, SETTINGS.q)[:, None]
        axes = gaussians.rotations.astype(np.float64)  # columns: normal, u, v
        half = np.concatenate([np.full((len(gaussians), 1), THICKNESS), radius * gaussians.scales], axis=1)
        columns = (axes * half[:, None, :]).transpose(0, 2, 1)
        transforms = np.concatenate([columns, gaussians.means_world[:, None, :]], axis=1)
        transforms = np.ascontiguousarray(transforms, np.float32)
        top = lib.rtcNewScene(device.handle)
        lib.rtcSetSceneBuildQuality(top, 1)
        for row in range(len(gaussians)):
            geometry = lib.rtcNewGeometry(device.handle, INSTANCE)
            lib.rtcSetGeometryInstancedScene(geometry, self._bvh.handle)
            address = transforms.ctypes.data + row * transforms.strides[0]
            lib.rtcSetGeometryTransform(geometry, 0, FLOAT3X4_COLUMN_MAJOR, address)
            lib.rtcCommitGeometry(geometry)
            lib.rtcAttachGeometry(top, geometry)
            lib.rtcReleaseGeometry(geometry)
        self.commit_ms = 1e3 * seconds(lambda: lib.rtcJoinCommitScene(top))
        device.check("building the instances")
        self._bottom, self._bvh.handle = self._bvh.handle, top


def seconds(work: Callable[[], object]) -> float:
    """Wall time of one call."""
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def medians(works: dict[str, Callable[[], object]]) -> dict[str, float]:
    """Median milliseconds of each, taken in turn after one warm-up."""
    for work in works.values():
        work()
    taken = {name: [] for name in works}
    for _ in range(REPEATS):
        for name, work in works.items():
            taken[name].append(1e3 * seconds(work))
    return {name: float(np.median(values)) for name, values in taken.items()}


def resident_mb() -> float:
    """Memory of this process now."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


def geometry(scene: Boxes, origins: np.ndarray, directions: np.ndarray) -> None:
    """Boxes against instances; a new hierarchy against a refitted one."""
    count = len(scene.gaussians)
    boxes = SingleRayTracer(TraceLimits.from_settings(SETTINGS), threads=THREADS, build_quality=1)
    instances = Instances(TraceLimits.from_settings(SETTINGS), threads=THREADS, build_quality=1)
    gc.collect()
    before = resident_mb()
    build_boxes = 1e3 * seconds(lambda: boxes.build(scene.boxes))
    between = resident_mb()
    build_instances = 1e3 * seconds(lambda: instances.build_instances(scene.gaussians))
    after = resident_mb()

    everything = np.arange(len(origins))

    def trace(tracer: SingleRayTracer) -> Callable[[], TraceResult]:
        def work() -> TraceResult:
            result, forward = prepared(scene, scene.gaussians.sh, origins, directions)
            tracer.trace(forward, everything)
            return result

        return work

    same, other = trace(boxes)(), trace(instances)()
    apart = float(np.abs(same.rgb_srgb - other.rgb_srgb).max())
    print(f"{count} Gaussians, {same.hit_counts.mean():.1f} hits a ray; pictures apart by {apart:.1e}")
    took = medians({"boxes": trace(boxes), "instances": trace(instances)})
    for name, build, memory in (
        ("boxes", build_boxes, between - before),
        ("instances", build_instances, after - between),
    ):
        print(f"  {name:10s} forward {took[name]:7.1f} ms  build {build:7.1f} ms  {memory:6.1f} MB")
    print(
        f"  of the instances' build, Embree's commit {instances.commit_ms:.1f} ms, the rest calls from Python"
    )

    lib, handle = boxes._device._lib, boxes._bvh.handle
    inner = lib.rtcGetGeometry(handle, 0)
    lib.rtcSetGeometryBuildQuality(inner, REFIT)

    def refit() -> None:
        lib.rtcCommitGeometry(inner)
        lib.rtcJoinCommitScene(handle)

    rng = np.random.default_rng(0)
    size = np.exp(scene.gaussians.log_scales).mean()
    anew = SingleRayTracer(TraceLimits.from_settings(SETTINGS), threads=THREADS, build_quality=1)
    for moved in (0.1, 0.5, 2.0):
        scene.gaussians.means_world += moved * size * rng.normal(size=(count, 3)).astype(np.float32)
        fresh = prepare(scene.gaussians)
        scene.boxes[:], scene.records[:] = fresh.boxes, fresh.records
        refitted, rebuilt = 1e3 * seconds(refit), 1e3 * seconds(partial(anew.build, scene.boxes))
        took = medians({"refitted": trace(boxes), "rebuilt": trace(anew)})
        print(
            f"  moved by {moved} of their size: refit {refitted:.1f} ms, forward {took['refitted']:.1f} ms;"
            f" rebuilt {rebuilt:.1f} ms, forward {took['rebuilt']:.1f} ms"
        )


def storage(scene: Boxes, origins: np.ndarray, directions: np.ndarray) -> None:
    """Packets whose harmonics are float32 or 16-bit integers; the kernels take both.

    The integers are not scaled back, so that their colors mean nothing: a multiplication a basis function.
    """
    g = scene.gaussians
    rng = np.random.default_rng(0)
    sh = (0.1 * rng.normal(size=(len(g), 9, 3))).astype(np.float32)
    sh[:, 0] = g.sh[:, 0]
    small = np.round(sh / SH_STEP).astype(np.int16)
    tracer = PacketTracer(TraceLimits.from_settings(SETTINGS), threads=THREADS, pool=ArrayPool())
    tracer.build(scene.records)
    packets, _ = find_packets(RayBatch(origins, directions), "always")
    kept = tracer.allocate_hits(packets, len(origins), is_recording=False)

    def trace(harmonics: np.ndarray) -> Callable[[], object]:
        return lambda: tracer.trace(prepared(scene, harmonics, origins, directions)[1], packets, kept)

    took = medians({"float32": trace(sh), "int16": trace(small)})
    print(f"  packets, harmonics as float32 {took['float32']:.1f} ms, as 16 bits {took['int16']:.1f} ms")


def main() -> None:
    """Measure a generated cloud of 100,000 and one of 1,000,000, or a scene."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("scene", nargs="?", type=Path)
    options = parser.parse_args()
    scenes = [read_scene(options.scene)[0]] if options.scene else [cloud(100_000), cloud(1_000_000)]
    for gaussians in scenes:
        ordered = gaussians.select(morton_order(gaussians.means_world))
        origins, directions = camera_rays(ordered)
        storage(prepare(ordered), origins, directions)
        if len(ordered) <= 200_000:
            geometry(prepare(ordered), origins, directions)


if __name__ == "__main__":
    main()

"""Hits by kind of material, and the random samples that the shading of a kind begins with."""

import numpy as np
from jaxtyping import Float64, Int32

from octasplat.engine.pathtracing.kernels.kernel_args import LightArrays, MaterialArrays, MeshScene, Vec3
from octasplat.engine.pathtracing.kernels.lights import is_only_rectangle
from octasplat.engine.pathtracing.kernels.path_args import (
    CAMERA_SAMPLE_PAIRS,
    LAMP_ROW,
    SAMPLE_PAIRS_PER_BOUNCE,
    WAY_ROW,
    Bounce,
    PathSamples,
    PathScratch,
)
from octasplat.engine.pathtracing.kernels.rough_dielectric import MIN_GLASS_ROUGHNESS
from octasplat.engine.pathtracing.kernels.sampler import fill_pair
from octasplat.engine.pathtracing.kernels.scatter import (
    DIRECTION_SAMPLE,
    LIGHT_CHOICE_SAMPLE,
    LIGHT_POSITION_SAMPLE,
    LOBE_SAMPLE,
    LightSample,
    draw_light,
)
from octasplat.engine.pathtracing.kernels.scatter_vectors import write_diffuse_ways8, write_lamp_samples8
from octasplat.engine.pathtracing.kernels.surface import DIFFUSE, EMITTER, GLASS, MIRROR, PRINCIPLED
from octasplat.engine.trace.cpu.kernels.simd_vector import LANES
from octasplat.engine.trace.kernels.native import njit_no_refcount, prefetch

_NOTHING = 7
"""In place of a kind of material: the ray meets nothing. It has all bits of any kind."""
_AHEAD = 16
"""Rows by which the materials of faces are asked for before they are needed."""


@njit_no_refcount(forceinline=True)
def find_kinds(
    scratch: PathScratch, scene: MeshScene, faces: Int32[np.ndarray, " n"], first: int, last: int
) -> int:
    """Note the kind of material that each of the rows ``first`` to ``last``, at most a block, meets.

    Returns a bit for each kind that is met, and :data:`_NOTHING`.
    """
    materials, material_ids, kinds = scene.materials, scene.surfaces.material_ids, scratch.faces
    if len(material_ids) == 0:
        return 0
    found = 0
    for k in range(first, last):
        ahead = max(faces[np.uintp(min(k + _AHEAD, last - 1))], 0)
        prefetch(material_ids.ctypes.data + material_ids.itemsize * ahead)
        # no branch: which ray meets anything is not to be foreseen
        face = np.int64(faces[np.uintp(k)])
        misses = face >> 63  # all bits set, or none
        kind = materials.kinds[np.uintp(material_ids[np.uintp(face & ~misses)])] | (misses & _NOTHING)
        kinds[np.uintp(k - first)] = kind
        found |= 1 << kind
    return found


@njit_no_refcount(forceinline=True)
def select_kind(scratch: PathScratch, kind: int, first: int, last: int) -> int:
    """Write those of the rows ``first`` to ``last`` that meet a kind of material.

    Returns how many there are; behind them the last one is repeated to fill a vector.
    """
    kinds, rows = scratch.faces, scratch.rows
    count = 0
    for k in range(first, last):
        # no branch: which kind comes next is not to be foreseen
        rows[np.uintp(count)] = k
        count += kinds[np.uintp(k - first)] == kind
    for i in range(count, count + LANES - 1):
        rows[i] = rows[count - 1]
    return count


@njit_no_refcount(forceinline=True)
def any_rough_glass(materials: MaterialArrays) -> bool:
    """Return whether glass may ask for light."""
    for m in range(len(materials.kinds)):
        if materials.kinds[m] == GLASS and materials.roughness[m] >= MIN_GLASS_ROUGHNESS:
            return True
    return False


@njit_no_refcount(forceinline=True)
def _needs_pair(kind: int, pair: int, plays_roulette: bool, asks_in_glass: bool, lights: int) -> bool:
    """Return whether the shading of a kind of material needs a pair of the uniform numbers of a surface."""
    if pair == LOBE_SAMPLE and plays_roulette:
        return True
    if kind in (MIRROR, EMITTER):
        return False
    if kind == GLASS and not asks_in_glass:
        return pair == LOBE_SAMPLE
    if pair == LIGHT_CHOICE_SAMPLE:
        return lights > 1
    return pair != LOBE_SAMPLE or kind != DIFFUSE


@njit_no_refcount(forceinline=True)
def fill_samples(
    scratch: PathScratch, bounce: Bounce, kind: int, begin: int, stop: int, asks_in_glass: bool
) -> None:
    """Fill in the numbers that the rows at the places ``begin`` to ``stop`` need, from column 0 on."""
    paths, integrator, depth = bounce.paths, bounce.integrator, bounce.depth
    if depth >= integrator.max_depth:
        return
    for i in range(begin, stop):
        p = np.uintp(bounce.active[np.uintp(scratch.rows[i])])
        scratch.keys[i - begin], scratch.samples[i - begin] = paths.keys[p], paths.samples[p]
    first_pair = CAMERA_SAMPLE_PAIRS + depth * SAMPLE_PAIRS_PER_BOUNCE
    lights, plays_roulette = len(bounce.scene.lights.kinds), depth >= integrator.roulette_depth
    for pair in range(len(scratch.random_numbers)):
        if _needs_pair(kind, pair, plays_roulette, asks_in_glass, lights):
            fill_pair(
                scratch.keys, scratch.samples, stop - begin, first_pair + pair, scratch.random_numbers[pair]
            )  # fmt: skip


@njit_no_refcount(forceinline=True)
def write_scatter_samples(scratch: PathScratch, lights: LightArrays, kind: int, count: int) -> None:
    """Write samples of the only lamp and ways on from diffuse surfaces, of ``count`` points of surfaces."""
    points, numbers = scratch.surface_points, scratch.random_numbers
    row_bytes = points.shape[1] * points.itemsize
    u, v = numbers[LIGHT_POSITION_SAMPLE, 0].ctypes.data, numbers[LIGHT_POSITION_SAMPLE, 1].ctypes.data
    if is_only_rectangle(lights) and kind in (DIFFUSE, PRINCIPLED):
        for i in range(0, count, LANES):
            write_lamp_samples8(
                points.ctypes.data + 8 * i, row_bytes, u + 8 * i, v + 8 * i,
                lights.positions_world.ctypes.data, lights.sides_u.ctypes.data, lights.sides_v.ctypes.data,
                lights.axes.ctypes.data, lights.areas.ctypes.data, points[LAMP_ROW].ctypes.data + 8 * i,
            )  # fmt: skip
    u, v = numbers[DIRECTION_SAMPLE, 0].ctypes.data, numbers[DIRECTION_SAMPLE, 1].ctypes.data
    if kind == DIFFUSE:
        for i in range(0, count, LANES):
            write_diffuse_ways8(
                points.ctypes.data + 8 * i, row_bytes, u + 8 * i, v + 8 * i,
                points[WAY_ROW].ctypes.data + 8 * i,
            )  # fmt: skip


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def light_of_row(
    lights: LightArrays, origin: Vec3, samples: PathSamples, at: Float64[np.ndarray, "23 s"]
) -> LightSample:
    """Return the sample of a light for a point, the only lamp's from its row."""
    if not is_only_rectangle(lights):
        return draw_light(lights, origin, samples)
    n, pdf = samples.n, at[LAMP_ROW + 7, samples.n]
    way = at[LAMP_ROW + 3, n], at[LAMP_ROW + 4, n], at[LAMP_ROW + 5, n]
    shines = 1.0 if pdf > 0.0 else 0.0
    rgb = (
        shines * lights.rgb_linear[0, 0],
        shines * lights.rgb_linear[0, 1],
        shines * lights.rgb_linear[0, 2],
    )
    return LightSample(0, 1.0, way, at[LAMP_ROW + 6, n], rgb, pdf)

"""Paths at surfaces: light that reaches the point from lights, and the way on by the surface's material.

The radiance that is carried is basic radiance (over the square of the index of refraction), so that nothing
changes by entering glass and coming out again. Each kernel does the rows ``first`` to ``last``, so that
several threads can share the work.
"""

import math

import numpy as np
from jaxtyping import Int32

from octasplat.engine.core.compilation import kernel
from octasplat.engine.pathtracing.kernels.glass import (
    glass_surface,
    scatter_mirror,
    scatter_rough_glass,
    scatter_smooth_glass,
)
from octasplat.engine.pathtracing.kernels.kernel_args import (
    AlbedoTables,
    Bsdf,
    MeshScene,
    SurfaceArrays,
    SurfacePoint,
    Vec3,
)
from octasplat.engine.pathtracing.kernels.nested_glass import copy_media
from octasplat.engine.pathtracing.kernels.path_args import (
    BLOCK_SIZE,
    CAMERA_SAMPLE_PAIRS,
    PATH_ENDED,
    SAMPLE_PAIRS_PER_BOUNCE,
    Bounce,
    LightQuery,
    PathArrays,
    PathSamples,
    PathScratch,
)
from octasplat.engine.pathtracing.kernels.path_radiance import shade_emitter, shade_miss
from octasplat.engine.pathtracing.kernels.rough_dielectric import MIN_GLASS_ROUGHNESS
from octasplat.engine.pathtracing.kernels.sampler import fill_pair
from octasplat.engine.pathtracing.kernels.scatter import (
    FLAG_CAMERA_RAY,
    LIGHT_CHOICE_SAMPLE,
    LOBE_SAMPLE,
    sample_pair,
    scatter_path,
    survives_roulette,
)
from octasplat.engine.pathtracing.kernels.surface import (
    DIFFUSE,
    EMITTER,
    GLASS,
    MIRROR,
    eval_clear_coat,
    eval_material,
    eval_normal_map,
    eval_vertex_color,
    face_normal,
    has_textures,
    interpolate_corners,
    interpolate_uv,
    offset_ray_origin,
    shading_normal,
)
from octasplat.engine.trace.kernels.native import njit_no_refcount, prefetch

PREFETCH_ROWS = 16
"""How far ahead of their use the rows of faces are asked for."""
_LAST_WORD = 4 * 8
"""Bytes before the last number of three corners."""


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def _fill_samples(
    scratch: PathScratch,
    paths: PathArrays,
    active: Int32[np.ndarray, " n"],
    faces: Int32[np.ndarray, " n"],
    first: int,
    last: int,
    first_pair: int,
    light_count: int,
) -> None:
    """Fill in the numbers of those of the rows ``first`` to ``last``, at most a block, that meet a face.

    Where there is no choice of lights there are no numbers for it.
    """
    count = 0
    for k in range(first, last):
        if faces[k] >= 0:
            p = active[k]
            scratch.keys[count], scratch.samples[count] = paths.keys[p], paths.samples[p]
            count += 1
    for pair in range(len(scratch.random_numbers)):
        if pair != LIGHT_CHOICE_SAMPLE or light_count > 1:
            fill_pair(
                scratch.keys, scratch.samples, count, first_pair + pair, scratch.random_numbers[pair]
            )  # fmt: skip


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def _prefetch_face(surfaces: SurfaceArrays, face: int) -> None:
    """Ask for what is read of a face; a ray's face is rarely in a near cache."""
    if face >= 0:
        # three corners lie in one or two lines
        corners, normals = surfaces.corners_world[face].ctypes.data, surfaces.corner_normals[face].ctypes.data
        prefetch(corners)
        prefetch(corners + _LAST_WORD)
        prefetch(normals)
        prefetch(normals + _LAST_WORD)


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def _write_denoiser_guides(
    paths: PathArrays, p: int, red: float, green: float, blue: float, n_x: float, n_y: float, n_z: float
) -> None:
    """Write color and normal of the first mesh that the camera's ray hits, weighted by visibility."""
    share = paths.mesh_visibility[p]
    paths.albedo_linear[p, 0] = share * red
    paths.albedo_linear[p, 1] = share * green
    paths.albedo_linear[p, 2] = share * blue
    paths.normals_world[p, 0] = share * n_x
    paths.normals_world[p, 1] = share * n_y
    paths.normals_world[p, 2] = share * n_z


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def _scatter_at_material(
    paths: PathArrays,
    p: int,
    scene: MeshScene,
    face: int,
    weights: Vec3,
    is_front: bool,
    point: SurfacePoint,
    is_guide: bool,
    samples: PathSamples,
    query: LightQuery,
) -> None:
    """Scatter a path by the material of a face, with a light query where the material scatters.

    ``weights`` are those of the corners; ``is_guide`` tells whether color and normal guide the denoiser.
    """
    surfaces, materials = scene.surfaces, scene.materials
    a, b, c = weights
    m = surfaces.material_ids[face]
    kind = materials.kinds[m]
    # --- glass ---
    if kind == GLASS:
        glass = glass_surface(materials, m, is_front, paths.media[p])
        if materials.roughness[m] >= MIN_GLASS_ROUGHNESS and glass.eta != 1.0:
            scatter_rough_glass(paths, p, glass, point, samples, query)
        else:
            scatter_smooth_glass(paths, p, glass, point, sample_pair(samples, LOBE_SAMPLE)[0])
        return
    # --- the material's numbers, textures looked up ---
    uv = surfaces.corner_uv[face]
    u_t, v_t = interpolate_uv(uv, a, b, c) if has_textures(materials, m) else (0.0, 0.0)
    red, green, blue, metallic, roughness = eval_material(materials, m, u_t, v_t)
    if materials.uses_vertex_color[m]:
        t_r, t_g, t_b = eval_vertex_color(surfaces, face, a, b, c)
        red, green, blue = red * t_r, green * t_g, blue * t_b
    if kind == MIRROR:
        scatter_mirror(paths, p, point, (red, green, blue))
        return
    d = paths.directions_world[p]
    (x, y, z), (n_x, n_y, n_z) = point.position, point.normal
    origin = offset_ray_origin(x, y, z, n_x, n_y, n_z)
    s_x, s_y, s_z = eval_normal_map(
        materials, m, surfaces.corners_world[face], uv, (u_t, v_t), point.normal, point.shading_normal,
        (float(d[0]), float(d[1]), float(d[2])),
    )  # fmt: skip
    if is_guide:
        _write_denoiser_guides(paths, p, red, green, blue, s_x, s_y, s_z)
    table = materials.coat_tables[m]
    coat, coat_roughness = eval_clear_coat(materials, m, u_t, v_t)
    bsdf = Bsdf(
        (red, green, blue), metallic, roughness,
        materials.iors[m], materials.substrates[m], materials.energy_compensation[m] != 0,
        coat, coat_roughness,
    )  # fmt: skip
    tables = AlbedoTables(
        materials.ggx_albedo, materials.coat_albedo[table], materials.coat_mean_albedo[table],
        materials.coat_albedo[0],
    )  # fmt: skip
    off_surface = SurfacePoint(origin, point.normal, (s_x, s_y, s_z))
    scatter_path(p, samples, paths, kind == DIFFUSE, off_surface, bsdf, tables, query)


@kernel(_nrt=False, error_model="numpy", fastmath={"contract"})
def shade_surfaces(first: int, last: int, scratch: PathScratch, bounce: Bounce) -> None:
    """Shade what paths find at the end of their rays.

    Adds light that they run into, turns them to where they go on, and writes what they ask of lights into
    the shadow rays. Paths that end are not alive any more.
    """
    paths, active, depth, hits, scene, integrator, shadows = bounce
    surfaces, materials, lights = scene.surfaces, scene.materials, scene.lights
    first_pair = CAMERA_SAMPLE_PAIRS + depth * SAMPLE_PAIRS_PER_BOUNCE
    n = 0
    for k in range(first, last):
        if (k - first) % BLOCK_SIZE == 0:
            end = min(k + BLOCK_SIZE, last)
            _fill_samples(scratch, paths, active, hits.faces, k, end, first_pair, len(lights.kinds))
            n = -1
        if k + PREFETCH_ROWS < last:
            _prefetch_face(surfaces, hits.faces[k + PREFETCH_ROWS])
        p, face = active[k], hits.faces[k]
        shadows.radiance_linear[k, 0] = shadows.radiance_linear[k, 1] = shadows.radiance_linear[k, 2] = 0.0
        if face == PATH_ENDED:
            continue
        # what lies behind a passed surface of glass is found by this path alone: it shadows light queries
        if scene.any_nested and copy_media(hits.media[k], paths.media[p]):
            paths.pdf[p] = 0.0
        # --- nothing was met ---
        if face < 0:
            shade_miss(paths, p, lights, scene.environment, integrator)
            paths.is_alive[p] = False
            continue
        n += 1
        # --- the point: weights a, b, c of the corners, the face's normal, the medium up to there ---
        d = paths.directions_world[p]
        b, c = float(hits.barycentrics[k, 0]), float(hits.barycentrics[k, 1])
        a = 1.0 - b - c
        n_x, n_y, n_z = face_normal(surfaces.corners_world[face])
        facing = -(d[0] * n_x + d[1] * n_y + d[2] * n_z)
        m = surfaces.material_ids[face]
        kind = materials.kinds[m]
        # Beer's law, on the way inside of glass up to this hit
        if paths.medium_ids[p] >= 0:
            medium = materials.absorption[paths.medium_ids[p]]
            for channel in range(3):
                paths.throughput[p, channel] *= math.exp(-medium[channel] * hits.distances[k])
        is_guide = paths.flags[p] & FLAG_CAMERA_RAY != 0 and paths.mesh_visibility[p] == 0.0
        if is_guide:
            paths.mesh_visibility[p] = paths.transmittance[p]
            # white until the material is known; mirrors and glass stay so
            _write_denoiser_guides(paths, p, 1.0, 1.0, 1.0, n_x, n_y, n_z)
        # --- light that the surface sends by itself ---
        l = materials.light_ids[m]
        if kind == EMITTER:
            shade_emitter(paths, p, lights, l, hits.distances[k], facing, 0.0, 0.0, integrator)
        elif l >= 0:
            u_t, v_t = interpolate_uv(surfaces.corner_uv[face], a, b, c)
            # meshes shine on both sides
            shade_emitter(paths, p, lights, l, hits.distances[k], abs(facing), u_t, v_t, integrator)
        if kind == EMITTER or depth >= integrator.max_depth:
            paths.is_alive[p] = False
            continue
        # --- the way on ---
        point = interpolate_corners(surfaces.corners_world[face], a, b, c)
        # from here on the normal is on the viewer's side
        if facing < 0.0:
            n_x, n_y, n_z = -n_x, -n_y, -n_z
        s_x, s_y, s_z = shading_normal(
            surfaces.corner_normals[face], a, b, c, n_x, n_y, n_z, d[0], d[1], d[2]
        )
        if is_guide:
            _write_denoiser_guides(paths, p, 1.0, 1.0, 1.0, s_x, s_y, s_z)
        samples = PathSamples(scratch.random_numbers, n)
        if depth >= integrator.roulette_depth and not survives_roulette(
            paths, p, sample_pair(samples, LOBE_SAMPLE)[1]
        ):
            continue
        query = LightQuery(lights, integrator, shadows, k)
        shadows.medium_ids[k] = paths.medium_ids[p]
        if scene.any_nested:
            copy_media(paths.media[p], shadows.media[k])
        _scatter_at_material(
            paths, p, scene, face, (a, b, c), facing >= 0.0,
            SurfacePoint(point, (n_x, n_y, n_z), (s_x, s_y, s_z)), is_guide, samples, query,
        )  # fmt: skip

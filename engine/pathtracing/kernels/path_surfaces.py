"""Paths at surfaces: light that reaches the point from lights, and the way on by the surface's material.

The radiance that is carried is basic radiance (over the square of the index of refraction), so that nothing
changes by entering glass and coming out again. Each kernel does the rows ``first`` to ``last``, so that
several threads can share the work.
"""

import math

import numpy as np
from jaxtyping import Float64

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
    Rgb,
    SurfaceArrays,
    SurfacePoint,
    Vec3,
)
from octasplat.engine.pathtracing.kernels.nested_glass import copy_media
from octasplat.engine.pathtracing.kernels.path_args import (
    BLOCK_SIZE,
    PATH_ENDED,
    SHADING_ROWS,
    WAY_ROW,
    Bounce,
    LightQuery,
    PathArrays,
    PathSamples,
    PathScratch,
)
from octasplat.engine.pathtracing.kernels.path_radiance import shade_emitter, shade_miss
from octasplat.engine.pathtracing.kernels.rough_dielectric import MIN_GLASS_ROUGHNESS
from octasplat.engine.pathtracing.kernels.scatter import (
    FLAG_CAMERA_RAY,
    FLAG_THROUGH_GLASS,
    LOBE_SAMPLE,
    sample_pair,
    scatter_diffuse,
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
    has_textures,
    interpolate_uv,
    offset_ray_origin,
)
from octasplat.engine.pathtracing.kernels.surface_point_vectors import RAY_STEP_ROW, write_surface_points8
from octasplat.engine.pathtracing.kernels.surface_samples import (
    any_rough_glass,
    fill_samples,
    find_kinds,
    light_of_row,
    select_kind,
    write_scatter_samples,
)
from octasplat.engine.trace.cpu.kernels.simd_vector import LANES
from octasplat.engine.trace.kernels.native import njit_no_refcount, prefetch

_LAST_WORD = 4 * 8
"""Bytes before the last number of three corners."""


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
def _write_denoiser_guides(paths: PathArrays, p: int, albedo: Rgb, normal: Vec3) -> None:
    """Write color and normal of the first mesh that the camera's ray hits, weighted by visibility."""
    share = paths.mesh_visibility[p]
    for channel in range(3):
        paths.albedo_linear[p, channel] = share * albedo[channel]
        paths.normals_world[p, channel] = share * normal[channel]


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def _scatter_at_material(
    paths: PathArrays,
    p: int,
    scene: MeshScene,
    face: int,
    kind: int,
    weights: Vec3,
    is_front: bool,
    point: SurfacePoint,
    is_guide: bool,
    samples: PathSamples,
    at: Float64[np.ndarray, "23 s"],
    query: LightQuery,
) -> None:
    """Scatter a path by the material of a face, with a light query where the material scatters.

    ``weights`` are those of the corners; ``is_guide`` tells whether color and normal guide the denoiser;
    ``at`` has the samples of :func:`write_scatter_samples`, in the column of the others.
    """
    surfaces, materials = scene.surfaces, scene.materials
    a, b, c = weights
    m = surfaces.material_ids[face]
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
    origin = offset_ray_origin(x, y, z, n_x, n_y, n_z, point.ray_step)
    s_x, s_y, s_z = eval_normal_map(
        materials, m, surfaces.corners_world[face], uv, (u_t, v_t), point.normal, point.shading_normal,
        (float(d[0]), float(d[1]), float(d[2])),
    )  # fmt: skip
    if is_guide:
        _write_denoiser_guides(paths, p, (red, green, blue), (s_x, s_y, s_z))
    off_surface = SurfacePoint(origin, point.normal, (s_x, s_y, s_z), 0.0)
    light = light_of_row(query.lights, origin, samples, at)
    if kind == DIFFUSE and materials.normal_textures[m] < 0:
        n = samples.n
        way = at[WAY_ROW, n], at[WAY_ROW + 1, n], at[WAY_ROW + 2, n]
        scatter_diffuse(p, paths, off_surface, (red, green, blue), light, way, at[WAY_ROW + 3, n], query)
        return
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
    scatter_path(p, samples, paths, kind == DIFFUSE, off_surface, bsdf, tables, light, query)


@njit_no_refcount(forceinline=True)
def _write_surface_points(scratch: PathScratch, first: int, last: int, bounce: Bounce) -> None:
    """Write what the shading of the rows at the places ``first`` to ``last`` begins with.

    Nothing here depends on materials.
    """
    surfaces, points = bounce.scene.surfaces, scratch.surface_points
    row_bytes = points.shape[1] * points.itemsize
    for i in range(first, last, LANES):
        write_surface_points8(
            scratch.rows.ctypes.data + i * scratch.rows.itemsize,
            bounce.active.ctypes.data, bounce.hits.faces.ctypes.data, bounce.hits.barycentrics.ctypes.data,
            bounce.paths.directions_world.ctypes.data,
            surfaces.corners_world.ctypes.data, surfaces.corner_normals.ctypes.data,
            points.ctypes.data + (i - first) * points.itemsize, row_bytes,
        )  # fmt: skip


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def _shade_hit(scratch: PathScratch, bounce: Bounce, kind: int, k: int, place: int) -> None:
    """Shade row ``k``, of a kind of material; what was worked out for it before is that at ``place``."""
    paths, active, depth, hits, scene, integrator, shadows = bounce
    surfaces, materials, lights = scene.surfaces, scene.materials, scene.lights
    # unsigned: no place is counted from the end of an array
    p, face, at = np.uintp(active[k]), np.uintp(hits.faces[k]), scratch.surface_points
    position = at[0, place], at[1, place], at[2, place]
    normal = at[3, place], at[4, place], at[5, place]
    shading_normal = at[6, place], at[7, place], at[8, place]
    facing = at[9, place]
    b, c = float(hits.barycentrics[k, 0]), float(hits.barycentrics[k, 1])
    a = 1.0 - b - c
    m = surfaces.material_ids[face]
    # Beer's law, on the way inside of glass up to this hit
    if paths.medium_ids[p] >= 0:
        medium = materials.absorption[paths.medium_ids[p]]
        for channel in range(3):
            paths.throughput[p, channel] *= math.exp(-medium[channel] * hits.distances[k])
    is_guide = paths.flags[p] & FLAG_CAMERA_RAY != 0 and paths.mesh_visibility[p] == 0.0
    continues = kind != EMITTER and depth < integrator.max_depth
    if is_guide:
        paths.mesh_visibility[p] = paths.transmittance[p]
        # white until the material is known; mirrors and glass stay so
        if continues:
            _write_denoiser_guides(paths, p, (1.0, 1.0, 1.0), shading_normal)
        else:
            side = 1.0 if facing >= 0.0 else -1.0
            n_x, n_y, n_z = normal
            _write_denoiser_guides(paths, p, (1.0, 1.0, 1.0), (side * n_x, side * n_y, side * n_z))
    # --- light that the surface sends by itself ---
    l = materials.light_ids[m]
    if kind == EMITTER:
        shade_emitter(paths, p, lights, l, hits.distances[k], facing, 0.0, 0.0, integrator)
    elif l >= 0:
        u_t, v_t = interpolate_uv(surfaces.corner_uv[face], a, b, c)
        # meshes shine on both sides
        shade_emitter(paths, p, lights, l, hits.distances[k], abs(facing), u_t, v_t, integrator)
    if not continues:
        paths.is_alive[p] = False
        return
    # --- the way on ---
    samples = PathSamples(scratch.random_numbers, place)
    if depth >= integrator.roulette_depth and not survives_roulette(
        paths, p, sample_pair(samples, LOBE_SAMPLE)[1]
    ):
        return
    query = LightQuery(lights, integrator, shadows, k)
    shadows.medium_ids[k] = paths.medium_ids[p]
    if scene.any_nested:
        copy_media(paths.media[p], shadows.media[k])
    point = SurfacePoint(position, normal, shading_normal, at[RAY_STEP_ROW, place])
    _scatter_at_material(
        paths, p, scene, face, kind, (a, b, c), facing >= 0.0, point, is_guide, samples, at, query
    )  # fmt: skip


@kernel(_nrt=False, error_model="numpy", fastmath={"contract"})
def shade_surfaces(first: int, last: int, scratch: PathScratch, bounce: Bounce) -> None:
    """Shade what paths find at the end of their rays.

    Adds light that they run into, turns them to where they go on, and writes what they ask of lights into
    the shadow rays. Paths that end are not alive any more.
    """
    paths, active, depth, hits, scene, integrator, shadows = bounce
    surfaces, lights = scene.surfaces, scene.lights
    asks_in_glass = any_rough_glass(scene.materials)
    for start in range(first, last, BLOCK_SIZE):
        end = min(start + BLOCK_SIZE, last)
        # --- rays that meet nothing ---
        for row in range(start, end):
            k = np.uintp(row)  # unsigned: no place is counted from the end of an array
            face = hits.faces[k]
            for channel in range(3):
                shadows.radiance_linear[k, channel] = 0.0
            if face == PATH_ENDED:
                continue
            p = np.uintp(active[k])
            # what lies behind a passed surface of glass is found by this path alone: it shadows light queries
            if scene.any_nested and copy_media(hits.media[k], paths.media[p]):
                if paths.pdf[p] > 0.0:
                    paths.flags[p] |= FLAG_THROUGH_GLASS
                paths.pdf[p] = 0.0
            if face < 0:
                shade_miss(paths, p, lights, scene.environment, integrator)
                paths.is_alive[p] = False
        # --- rays that meet a face, a kind of material after the other: neighbors take the same way ---
        found = find_kinds(scratch, scene, hits.faces, start, end)
        for kind in range(EMITTER + 1):
            if found >> kind & 1 == 0:
                continue
            count = select_kind(scratch, kind, start, end)
            for begin in range(0, count, SHADING_ROWS):
                stop = min(begin + SHADING_ROWS, count)
                # those of the first rows, and of the next while these are shaded
                for i in range(stop if begin > 0 else 0, min(stop + SHADING_ROWS, count)):
                    _prefetch_face(surfaces, hits.faces[np.uintp(scratch.rows[i])])
                fill_samples(scratch, bounce, kind, begin, stop, asks_in_glass)
                _write_surface_points(scratch, begin, stop, bounce)
                if depth < integrator.max_depth:
                    write_scatter_samples(scratch, lights, kind, stop - begin)
                for i in range(begin, stop):
                    _shade_hit(scratch, bounce, kind, np.uintp(scratch.rows[i]), i - begin)

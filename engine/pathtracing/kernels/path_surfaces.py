"""Paths at surfaces: light that reaches the point from lights, and the way on by the surface's material.

The radiance that is carried is basic radiance (over the square of the index of refraction), so that nothing
changes by entering glass and coming out again. Each kernel does the rows ``first`` to ``last``, so that
several threads can share the work.
"""

import math

import numpy as np
from jaxtyping import Float32, Int32

from octasplat.engine.core.compilation import kernel
from octasplat.engine.pathtracing.kernels.kernel_args import (
    BLOCK_SIZE,
    SAMPLE_PAIRS_PER_BOUNCE,
    AlbedoTables,
    Bsdf,
    IntegratorParameters,
    LightArrays,
    LightQuery,
    MaterialArrays,
    MeshHits,
    MeshScene,
    PathArrays,
    PathSamples,
    PathScratch,
    PathStart,
    Rgb,
    ShadowRayArrays,
    Vec3,
)
from octasplat.engine.pathtracing.kernels.lights import (
    emitter_hit_pdf,
    environment_pdf,
    eval_emission,
    eval_environment,
    light_probability,
    sample_light,
    sample_light_index,
)
from octasplat.engine.pathtracing.kernels.principled_bsdf import fresnel_dielectric, orthonormal_basis
from octasplat.engine.pathtracing.kernels.rough_dielectric import (
    MIN_GLASS_ROUGHNESS,
    rough_dielectric_eval,
    rough_dielectric_sample,
)
from octasplat.engine.pathtracing.kernels.sampler import fill_pairs, pixel_key
from octasplat.engine.pathtracing.kernels.scatter import (
    DIRECTION_SAMPLE,
    FLAG_CAMERA_RAY,
    FLAG_LOSSLESS,
    FLAG_SCATTERED,
    LIGHT_CHOICE_SAMPLE,
    LIGHT_POSITION_SAMPLE,
    LOBE_SAMPLE,
    queue_shadow_ray,
    sample_pair,
    scatter_path,
    spawn_ray,
)
from octasplat.engine.pathtracing.kernels.surface import (
    DIFFUSE,
    EMITTER,
    GLASS,
    MIRROR,
    eval_material,
    eval_normal_map,
    eval_vertex_color,
    face_normal,
    interpolate_corners,
    interpolate_uv,
    normalize,
    offset_ray_origin,
    reflect,
    shading_normal,
)
from octasplat.engine.shading.kernels.microfacets import table_value
from octasplat.engine.trace.kernels.native import njit_no_refcount

PATH_ENDED = -2
"""In place of a face: the ray ended in front of what it would have met."""
CAMERA_SAMPLE_PAIRS = 2


@njit_no_refcount(forceinline=True)
def _fill_camera_samples(
    scratch: PathScratch, seed: int, start: PathStart, place: int, number: int, count: int
) -> None:
    """Write keys, sample numbers and the camera's uniform numbers of ``count`` paths, at most a block.

    The first of them is number ``number`` of the pixel at ``place``.
    """
    count = min(count, BLOCK_SIZE)
    key = pixel_key(seed, start.pixel_order[start.first_pixel + place])
    for n in range(count):
        if number == start.paths_per_pixel:
            place, number = place + 1, 0
            key = pixel_key(seed, start.pixel_order[start.first_pixel + place])
        scratch.keys[n], scratch.samples[n] = key, start.first_sample + number
        number += 1
    fill_pairs(scratch.keys, scratch.samples, count, 0, scratch.random_numbers[:CAMERA_SAMPLE_PAIRS])


@njit_no_refcount(forceinline=True)
def _pixel_direction(directions: Float32[np.ndarray, "h w 3"], y: int, x: int, u: float, v: float) -> Vec3:
    """Return the direction through (u, v) of a pixel, by the slopes between its neighbours."""
    height, width, _ = directions.shape
    centre = directions[y, x]
    left, right = max(x - 1, 0), min(x + 1, width - 1)
    high, low = max(y - 1, 0), min(y + 1, height - 1)
    along = (u - 0.5) / max(right - left, 1)
    down = (v - 0.5) / max(low - high, 1)
    a, b = directions[y, left], directions[y, right]
    c, d = directions[high, x], directions[low, x]
    d_x, d_y, d_z = float(centre[0]), float(centre[1]), float(centre[2])
    d_x += along * (b[0] - a[0]) + down * (d[0] - c[0])
    d_y += along * (b[1] - a[1]) + down * (d[1] - c[1])
    d_z += along * (b[2] - a[2]) + down * (d[2] - c[2])
    return normalize(d_x, d_y, d_z)


@njit_no_refcount(forceinline=True)
def _reset_path(paths: PathArrays, k: int, origin: Vec3, direction: Vec3) -> None:
    """Start a path at the camera."""
    paths.origins_world[k, 0], paths.origins_world[k, 1], paths.origins_world[k, 2] = origin
    paths.directions_world[k, 0], paths.directions_world[k, 1], paths.directions_world[k, 2] = direction
    for channel in range(3):
        paths.throughput[k, channel], paths.radiance_linear[k, channel] = 1.0, 0.0
        paths.layer_srgb[k, channel], paths.shading_factor[k, channel] = 0.0, 0.0
        paths.albedo_linear[k, channel], paths.normals_world[k, channel] = 0.0, 0.0
    paths.transmittance[k], paths.coverage[k], paths.mesh_visibility[k] = 1.0, 1.0, 0.0
    paths.pdf[k], paths.t_view_origin[k], paths.medium_ids[k] = 0.0, 0.0, -1
    paths.flags[k], paths.is_alive[k] = FLAG_LOSSLESS | FLAG_CAMERA_RAY, True


@kernel(_nrt=False, error_model="numpy")
def start_paths(
    first: int,
    last: int,
    scratch: PathScratch,
    integrator: IntegratorParameters,
    start: PathStart,
    paths: PathArrays,
) -> None:
    """Start the paths ``first`` to ``last`` of those that ``start`` describes.

    Beside a pixel's centre the direction follows the slopes between the neighbours, which is right for any
    lens to the second order in a pixel.
    """
    camera, numbers = start.camera_rays, scratch.random_numbers
    directions, axis = camera.directions_world, camera.axis
    width = directions.shape[1]
    across_x, across_y, across_z, up_x, up_y, up_z = orthonormal_basis(axis[0], axis[1], axis[2])
    # --- the pixel: its place in the order, the number of the path in it, row and column ---
    place, number = first // start.paths_per_pixel, first % start.paths_per_pixel - 1
    pixel = start.pixel_order[start.first_pixel + place]
    y, x = pixel // width, pixel % width
    for k in range(first, last):
        n = (k - first) % BLOCK_SIZE
        number += 1
        if number == start.paths_per_pixel:
            place, number = place + 1, 0
        if n == 0:
            _fill_camera_samples(scratch, integrator.seed, start, place, number, last - k)
        if n == 0 or number == 0:
            pixel = start.pixel_order[start.first_pixel + place]
            y, x = pixel // width, pixel % width
        paths.keys[k], paths.samples[k] = scratch.keys[n], scratch.samples[n]
        # --- a place in the pixel ---
        centre = directions[y, x]
        d_x, d_y, d_z = float(centre[0]), float(centre[1]), float(centre[2])
        if integrator.anti_aliasing:
            d_x, d_y, d_z = _pixel_direction(directions, y, x, numbers[0, 0, n], numbers[0, 1, n])
        # --- a place on the lens ---
        o_x, o_y, o_z = camera.origin_world[0], camera.origin_world[1], camera.origin_world[2]
        if camera.aperture > 0.0:
            u, v = numbers[1, 0, n], numbers[1, 1, n]
            radius, angle = 0.5 * camera.aperture * math.sqrt(u), 2.0 * math.pi * v
            a, b = radius * math.cos(angle), radius * math.sin(angle)
            l_x, l_y, l_z = a * across_x + b * up_x, a * across_y + b * up_y, a * across_z + b * up_z
            forward = d_x * axis[0] + d_y * axis[1] + d_z * axis[2]
            t = camera.focus_distance / max(forward, 1e-6)
            o_x, o_y, o_z = o_x + l_x, o_y + l_y, o_z + l_z
            d_x, d_y, d_z = normalize(t * d_x - l_x, t * d_y - l_y, t * d_z - l_z)
        _reset_path(paths, k, (o_x, o_y, o_z), (d_x, d_y, d_z))


@njit_no_refcount(forceinline=True)
def eval_background(
    lights: LightArrays,
    environment: int,
    integrator: IntegratorParameters,
    flags: int,
    d_x: float,
    d_y: float,
    d_z: float,
) -> tuple[float, float, float]:
    """Return linear radiance from behind everything; ``environment`` is the number of that light or -1."""
    if environment >= 0 and (integrator.environment_visible or not flags & FLAG_CAMERA_RAY):
        return eval_environment(lights, d_x, d_y, d_z)
    background = integrator.background_linear
    return background[0], background[1], background[2]


@njit_no_refcount(forceinline=True)
def add_radiance(paths: PathArrays, p: int, red: float, green: float, blue: float, clamp: float) -> None:
    """Add light to a path, no more than ``clamp`` of it where it comes by way of scattering."""
    if paths.flags[p] & FLAG_SCATTERED:
        most = max(red, green, blue)
        if most > clamp:
            red, green, blue = red * clamp / most, green * clamp / most, blue * clamp / most
    paths.radiance_linear[p, 0] += red
    paths.radiance_linear[p, 1] += green
    paths.radiance_linear[p, 2] += blue


@njit_no_refcount(forceinline=True)
def _shade_miss(
    paths: PathArrays, p: int, lights: LightArrays, environment: int, integrator: IntegratorParameters
) -> None:
    """Terminate a path that leaves the scene, with the light of the background."""
    d = paths.directions_world[p]
    red, green, blue = eval_background(lights, environment, integrator, paths.flags[p], d[0], d[1], d[2])
    share = 1.0
    if environment >= 0 and paths.pdf[p] > 0.0:
        o = paths.origins_world[p]
        pdf = light_probability(lights, environment, o[0], o[1], o[2]) * environment_pdf(
            lights, d[0], d[1], d[2]
        )
        share = paths.pdf[p] / (paths.pdf[p] + pdf)
    if paths.flags[p] & FLAG_CAMERA_RAY and not (environment >= 0 and integrator.environment_visible):
        paths.coverage[p] = 1.0 - paths.transmittance[p]
    w = paths.throughput[p]
    add_radiance(paths, p, share * w[0] * red, share * w[1] * green, share * w[2] * blue, integrator.clamp)


@njit_no_refcount(forceinline=True)
def _shade_emitter(
    paths: PathArrays,
    p: int,
    lights: LightArrays,
    l: int,
    distance: float,
    cosine: float,
    u: float,
    v: float,
    integrator: IntegratorParameters,
) -> None:
    """Add the light of a shining surface; ``cosine`` is that to its front, (u, v) the place on a mesh."""
    if cosine <= 0.0:
        return
    share = 1.0
    if paths.pdf[p] > 0.0:
        o = paths.origins_world[p]
        pdf = light_probability(lights, l, o[0], o[1], o[2]) * emitter_hit_pdf(lights, l, o, distance, cosine)
        share = paths.pdf[p] / (paths.pdf[p] + pdf)
    w = paths.throughput[p]
    red, green, blue = eval_emission(lights, l, u, v)
    add_radiance(paths, p, share * w[0] * red, share * w[1] * green, share * w[2] * blue, integrator.clamp)


@njit_no_refcount(forceinline=True)
def _scatter_mirror(
    paths: PathArrays, p: int, point: Vec3, normal: Vec3, shading_normal: Vec3, reflectance: Rgb
) -> None:
    """Reflect a path at a mirror and multiply its throughput by ``reflectance``."""
    (x, y, z), (n_x, n_y, n_z), (s_x, s_y, s_z) = point, normal, shading_normal
    red, green, blue = reflectance
    d = paths.directions_world[p]
    r_x, r_y, r_z = reflect(d[0], d[1], d[2], s_x, s_y, s_z)
    if r_x * n_x + r_y * n_y + r_z * n_z <= 0.0:
        r_x, r_y, r_z = reflect(d[0], d[1], d[2], n_x, n_y, n_z)
    if red != 1.0 or green != 1.0 or blue != 1.0:
        paths.flags[p] &= ~FLAG_LOSSLESS
    paths.flags[p] &= ~FLAG_CAMERA_RAY
    paths.throughput[p, 0] *= red
    paths.throughput[p, 1] *= green
    paths.throughput[p, 2] *= blue
    x, y, z = offset_ray_origin(x, y, z, n_x, n_y, n_z)
    spawn_ray(paths, p, x, y, z, r_x, r_y, r_z, 0.0)


@njit_no_refcount(forceinline=True)
def _scatter_smooth_glass(
    paths: PathArrays,
    p: int,
    materials: MaterialArrays,
    m: int,
    is_entering: bool,
    point: Vec3,
    normal: Vec3,
    shading_normal: Vec3,
    choice: float,
) -> None:
    """Reflect a path at glass or let it through, by chance as Fresnel says."""
    (x, y, z), (n_x, n_y, n_z), (s_x, s_y, s_z) = point, normal, shading_normal
    d = paths.directions_world[p]
    eta = materials.iors[m] if is_entering else 1.0 / materials.iors[m]
    cosine = -(d[0] * s_x + d[1] * s_y + d[2] * s_z)
    share, cos_t = fresnel_dielectric(min(cosine, 1.0), eta)
    if share < 1.0 and eta != 1.0:
        paths.flags[p] &= ~FLAG_LOSSLESS
    if eta != 1.0 and choice < share:
        _scatter_mirror(paths, p, point, normal, shading_normal, (1.0, 1.0, 1.0))
        return
    tint = materials.colours_linear[m]
    plain = tint[0] == 1.0 and tint[1] == 1.0 and tint[2] == 1.0
    absorbs = materials.absorption[m, 0] + materials.absorption[m, 1] + materials.absorption[m, 2] > 0.0
    if not plain or absorbs:
        paths.flags[p] &= ~FLAG_LOSSLESS
    for channel in range(3):
        paths.throughput[p, channel] *= tint[channel]
    t_x, t_y, t_z = float(d[0]), float(d[1]), float(d[2])
    if eta != 1.0:
        paths.flags[p] &= ~FLAG_CAMERA_RAY
        along = cosine / eta - cos_t
        t_x, t_y, t_z = normalize(t_x / eta + along * s_x, t_y / eta + along * s_y, t_z / eta + along * s_z)
    paths.medium_ids[p] = m if is_entering else -1
    x, y, z = offset_ray_origin(x, y, z, -n_x, -n_y, -n_z)
    spawn_ray(paths, p, x, y, z, t_x, t_y, t_z, 0.0)


@njit_no_refcount(forceinline=True)
def _fill_samples(
    scratch: PathScratch,
    paths: PathArrays,
    active: Int32[np.ndarray, " n"],
    faces: Int32[np.ndarray, " n"],
    first: int,
    last: int,
    first_pair: int,
) -> None:
    """Fill in the numbers of those of the rows ``first`` to ``last``, at most a block, that meet a face."""
    count = 0
    for k in range(first, last):
        if faces[k] >= 0:
            p = active[k]
            scratch.keys[count], scratch.samples[count] = paths.keys[p], paths.samples[p]
            count += 1
    fill_pairs(scratch.keys, scratch.samples, count, first_pair, scratch.random_numbers)


@njit_no_refcount(forceinline=True)
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


@njit_no_refcount(forceinline=True)
def _rough_glass_gain(materials: MaterialArrays, m: int, is_entering: bool, o_z: float) -> float:
    """Return the factor that makes up for the light that one bounce loses."""
    if not materials.energy_compensation[m]:
        return 1.0
    table = materials.coat_tables[m] + (0 if is_entering else 1)
    return 1.0 / table_value(materials.coat_albedo[table], o_z, materials.roughness[m])


@njit_no_refcount()
def _scatter_rough_glass(
    paths: PathArrays,
    p: int,
    materials: MaterialArrays,
    m: int,
    is_entering: bool,
    point: Vec3,
    normal: Vec3,
    shading_normal: Vec3,
    samples: PathSamples,
    query: LightQuery,
) -> None:
    """Queue a light query at rough glass, and reflect or refract the path at a microfacet."""
    (x, y, z), (n_x, n_y, n_z), (s_x, s_y, s_z) = point, normal, shading_normal
    lights, shadows, k = query.lights, query.shadows, query.k
    d = paths.directions_world[p]
    eta = materials.iors[m] if is_entering else 1.0 / materials.iors[m]
    tint, roughness = materials.colours_linear[m], materials.roughness[m]
    alpha = roughness * roughness
    # --- the direction to the viewer, in the frame of the shading normal ---
    a_x, a_y, a_z, b_x, b_y, b_z = orthonormal_basis(s_x, s_y, s_z)
    o_x = -(d[0] * a_x + d[1] * a_y + d[2] * a_z)
    o_y = -(d[0] * b_x + d[1] * b_y + d[2] * b_z)
    o_z = -(d[0] * s_x + d[1] * s_y + d[2] * s_z)
    gain = _rough_glass_gain(materials, m, is_entering, o_z)
    front = offset_ray_origin(x, y, z, n_x, n_y, n_z)
    back = offset_ray_origin(x, y, z, -n_x, -n_y, -n_z)
    # --- a sample of a light ---
    w = paths.throughput[p]
    clamp = query.integrator.clamp if paths.flags[p] & FLAG_SCATTERED else math.inf
    if len(lights.kinds):
        l, share = sample_light_index(lights, x, y, z, sample_pair(samples, LIGHT_CHOICE_SAMPLE)[0])
        if l >= 0:
            u, v = sample_pair(samples, LIGHT_POSITION_SAMPLE)
            w_x, w_y, w_z, distance, l_r, l_g, l_b, l_pdf = sample_light(lights, l, x, y, z, u, v)
            i_z = w_x * s_x + w_y * s_y + w_z * s_z
            if i_z * (w_x * n_x + w_y * n_y + w_z * n_z) > 0.0 and l_r + l_g + l_b > 0.0:
                value, pdf = rough_dielectric_eval(
                    o_x, o_y, o_z,
                    w_x * a_x + w_y * a_y + w_z * a_z, w_x * b_x + w_y * b_y + w_z * b_z, i_z, eta, alpha,
                )  # fmt: skip
                factor = gain * value / share
                shadows.passes_glass[k] = l_pdf == 0.0
                if l_pdf > 0.0:
                    l_pdf *= share
                    factor = gain * value / (l_pdf + pdf if lights.is_hittable[l] else l_pdf)
                if value > 0.0:
                    through = i_z < 0.0
                    radiance = (
                        w[0] * l_r * factor * (tint[0] if through else 1.0),
                        w[1] * l_g * factor * (tint[1] if through else 1.0),
                        w[2] * l_b * factor * (tint[2] if through else 1.0),
                    )
                    queue_shadow_ray(
                        shadows, k, back if through else front, (w_x, w_y, w_z), distance, radiance, clamp
                    )
    # --- a sample of the BSDF ---
    u, v = sample_pair(samples, DIRECTION_SAMPLE)
    choice = sample_pair(samples, LOBE_SAMPLE)[0]
    i_x, i_y, i_z = rough_dielectric_sample(o_x, o_y, o_z, eta, alpha, choice, u, v)
    value, pdf = rough_dielectric_eval(o_x, o_y, o_z, i_x, i_y, i_z, eta, alpha)
    w_x = i_x * a_x + i_y * b_x + i_z * s_x
    w_y = i_x * a_y + i_y * b_y + i_z * s_y
    w_z = i_x * a_z + i_y * b_z + i_z * s_z
    if not pdf > 0.0 or i_z * (w_x * n_x + w_y * n_y + w_z * n_z) <= 0.0:
        paths.is_alive[p] = False
        return
    # --- the path goes on ---
    through = i_z < 0.0
    for channel in range(3):
        paths.throughput[p, channel] *= gain * value / pdf * (tint[channel] if through else 1.0)
    paths.flags[p] = (paths.flags[p] | FLAG_SCATTERED) & ~(FLAG_LOSSLESS | FLAG_CAMERA_RAY)
    w_x, w_y, w_z = normalize(w_x, w_y, w_z)
    if through:
        paths.medium_ids[p] = m if is_entering else -1
    x, y, z = back if through else front
    spawn_ray(paths, p, x, y, z, w_x, w_y, w_z, pdf)


@njit_no_refcount(forceinline=True)
def survives_roulette(paths: PathArrays, p: int, roulette: float) -> bool:
    """Play russian roulette: terminate a path by its throughput; returns whether it continues."""
    w = paths.throughput[p]
    stay = min(max(w[0], w[1], w[2]), 0.95)
    if roulette >= stay:
        paths.is_alive[p] = False
        return False
    for channel in range(3):
        paths.throughput[p, channel] /= stay
    return True


@njit_no_refcount(forceinline=True)
def _scatter_at_material(
    paths: PathArrays,
    p: int,
    scene: MeshScene,
    face: int,
    weights: Vec3,
    is_front: bool,
    point: Vec3,
    normal: Vec3,
    shading_normal: Vec3,
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
    if kind == GLASS and materials.roughness[m] >= MIN_GLASS_ROUGHNESS and materials.iors[m] != 1.0:
        _scatter_rough_glass(paths, p, materials, m, is_front, point, normal, shading_normal, samples, query)
        return
    if kind == GLASS:
        choice = sample_pair(samples, LOBE_SAMPLE)[0]
        _scatter_smooth_glass(paths, p, materials, m, is_front, point, normal, shading_normal, choice)
        return
    # --- the material's numbers, textures looked up ---
    uv = surfaces.corner_uv[face]
    u_t, v_t = interpolate_uv(uv, a, b, c)
    red, green, blue, metallic, roughness = eval_material(materials, m, u_t, v_t)
    if materials.uses_vertex_color[m]:
        t_r, t_g, t_b = eval_vertex_color(surfaces, face, a, b, c)
        red, green, blue = red * t_r, green * t_g, blue * t_b
    if kind == MIRROR:
        _scatter_mirror(paths, p, point, normal, shading_normal, (red, green, blue))
        return
    d = paths.directions_world[p]
    (x, y, z), (n_x, n_y, n_z) = point, normal
    origin = offset_ray_origin(x, y, z, n_x, n_y, n_z)
    s_x, s_y, s_z = eval_normal_map(
        materials, m, surfaces.corners_world[face], uv, (u_t, v_t), normal, shading_normal,
        (float(d[0]), float(d[1]), float(d[2])),
    )  # fmt: skip
    if is_guide:
        _write_denoiser_guides(paths, p, red, green, blue, s_x, s_y, s_z)
    table = materials.coat_tables[m]
    bsdf = Bsdf(
        (red, green, blue), metallic, roughness,
        materials.iors[m], materials.substrates[m], materials.energy_compensation[m] != 0,
    )  # fmt: skip
    tables = AlbedoTables(
        materials.ggx_albedo, materials.coat_albedo[table], materials.coat_mean_albedo[table]
    )
    scatter_path(p, samples, paths, kind == DIFFUSE, origin, normal, (s_x, s_y, s_z), bsdf, tables, query)


@kernel(_nrt=False, error_model="numpy")
def shade_surfaces(
    first: int,
    last: int,
    scratch: PathScratch,
    paths: PathArrays,
    active: Int32[np.ndarray, " n"],
    depth: int,
    hits: MeshHits,
    scene: MeshScene,
    integrator: IntegratorParameters,
    shadows: ShadowRayArrays,
) -> None:
    """Shade what the paths ``active`` find at the end of their rays; ``depth`` surfaces were met before.

    Adds light that they run into, turns them to where they go on, and writes what they ask of lights into
    ``shadows``, a row a ray. Paths that end are not alive any more.
    """
    surfaces, materials, lights = scene.surfaces, scene.materials, scene.lights
    first_pair = CAMERA_SAMPLE_PAIRS + depth * SAMPLE_PAIRS_PER_BOUNCE
    n = 0
    for k in range(first, last):
        if (k - first) % BLOCK_SIZE == 0:
            _fill_samples(scratch, paths, active, hits.faces, k, min(k + BLOCK_SIZE, last), first_pair)
            n = -1
        p, face = active[k], hits.faces[k]
        shadows.radiance_linear[k, 0] = shadows.radiance_linear[k, 1] = shadows.radiance_linear[k, 2] = 0.0
        # --- nothing was met ---
        if face == PATH_ENDED:
            continue
        if face < 0:
            _shade_miss(paths, p, lights, scene.environment, integrator)
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
        if paths.medium_ids[p] >= 0:
            medium = materials.absorption[paths.medium_ids[p]]
            for channel in range(3):
                paths.throughput[p, channel] *= math.exp(-medium[channel] * hits.distances[k])
        is_guide = paths.flags[p] & FLAG_CAMERA_RAY != 0 and paths.mesh_visibility[p] == 0.0
        if is_guide:
            paths.mesh_visibility[p] = paths.transmittance[p]
            _write_denoiser_guides(paths, p, 1.0, 1.0, 1.0, n_x, n_y, n_z)
        # --- light that the surface sends by itself ---
        l = materials.light_ids[m]
        if kind == EMITTER:
            _shade_emitter(paths, p, lights, l, hits.distances[k], facing, 0.0, 0.0, integrator)
        elif l >= 0:
            u_t, v_t = interpolate_uv(surfaces.corner_uv[face], a, b, c)
            _shade_emitter(paths, p, lights, l, hits.distances[k], abs(facing), u_t, v_t, integrator)
        if kind == EMITTER or depth >= integrator.max_depth:
            paths.is_alive[p] = False
            continue
        # --- the way on ---
        point = interpolate_corners(surfaces.corners_world[face], a, b, c)
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
        _scatter_at_material(
            paths, p, scene, face, (a, b, c), facing >= 0.0, point, (n_x, n_y, n_z), (s_x, s_y, s_z),
            is_guide, samples, query,
        )  # fmt: skip


@kernel(_nrt=False, error_model="numpy")
def add_direct_light(
    first: int,
    last: int,
    scratch: PathScratch,
    paths: PathArrays,
    active: Int32[np.ndarray, " n"],
    radiance: Float32[np.ndarray, "n 3"],
    transmittance: Float32[np.ndarray, "n 3"],
) -> None:
    """Add what shadow rays brought: ``radiance`` times the share of it that got through."""
    for k in range(first, last):
        if transmittance[k, 0] + transmittance[k, 1] + transmittance[k, 2] > 0.0:
            for channel in range(3):
                paths.radiance_linear[active[k], channel] += radiance[k, channel] * transmittance[k, channel]

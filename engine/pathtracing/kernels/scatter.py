"""A path at a surface that scatters: what one light sends to it, and the direction in which it goes on.

The two ways in which light is found are joined by multiple importance sampling with the balance heuristic
("Optimally Combining Sampling Techniques for Monte Carlo Rendering", Veach and Guibas 1995).
"""

import math
from typing import NamedTuple

import numpy as np

from octasplat.engine.core.rays import AT_INFINITY
from octasplat.engine.pathtracing.kernels.kernel_args import (
    AlbedoTables,
    Bsdf,
    LightArrays,
    Rgb,
    SurfacePoint,
    Vec3,
)
from octasplat.engine.pathtracing.kernels.lights import INFINITE_DISTANCE, sample_light, sample_light_index
from octasplat.engine.pathtracing.kernels.path_args import (
    LightQuery,
    PathArrays,
    PathSamples,
    ShadowRayArrays,
)
from octasplat.engine.pathtracing.kernels.principled_bsdf import (
    orthonormal_basis,
    principled_eval,
    principled_sample,
    sample_cosine,
)
from octasplat.engine.pathtracing.kernels.surface import normalize
from octasplat.engine.trace.kernels.native import njit_no_refcount

FLAG_CLEAR = 1
"""Mark: every surface so far sent all that it passed on in one direction; the first layer goes on."""
FLAG_SCATTERED = 2
"""Mark: the path has left a matt or rough surface."""
FLAG_CAMERA_RAY = 4
"""Mark: the path is still the camera's own ray."""
FLAG_GAUSSIAN_SURFACE = 8
"""Mark: what the camera sees in this place is a surface of Gaussians with materials."""
FLAG_THROUGH_GLASS = 16
"""Mark: since it scattered, the path has gone through glass, and was reflected nowhere."""

LOBE_SAMPLE, DIRECTION_SAMPLE, LIGHT_CHOICE_SAMPLE, LIGHT_POSITION_SAMPLE, LAYER_LIGHT_SAMPLE = 0, 1, 2, 3, 4
"""Pairs of uniform numbers of a surface."""
SHADOW_RAY_SCALE = 1.0 - 1e-4


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def spawn_ray(
    paths: PathArrays, p: int, x: float, y: float, z: float, d_x: float, d_y: float, d_z: float, pdf: float
) -> None:
    """Start the next ray of a path; its viewer stays behind, and is lost once the path has scattered."""
    o = paths.origins_world[p]
    # scattered light is seen from no single place, from which harmonics could be evaluated
    if pdf > 0.0:
        paths.t_view_origin[p] = AT_INFINITY
    else:
        paths.t_view_origin[p] -= math.sqrt((x - o[0]) ** 2 + (y - o[1]) ** 2 + (z - o[2]) ** 2)
    paths.origins_world[p, 0], paths.origins_world[p, 1], paths.origins_world[p, 2] = x, y, z
    paths.directions_world[p, 0], paths.directions_world[p, 1], paths.directions_world[p, 2] = d_x, d_y, d_z
    paths.pdf[p] = pdf


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def queue_shadow_ray(
    shadows: ShadowRayArrays,
    k: int,
    origin: Vec3,
    direction: Vec3,
    distance: float,
    radiance: Rgb,
    clamp: float,
) -> None:
    """Queue a shadow ray with the light's contribution, clamped to ``clamp``."""
    (x, y, z), (w_x, w_y, w_z), (red, green, blue) = origin, direction, radiance
    most = max(red, green, blue)
    if most > clamp:
        red, green, blue = red * clamp / most, green * clamp / most, blue * clamp / most
    shadows.radiance_linear[k, 0], shadows.radiance_linear[k, 1], shadows.radiance_linear[k, 2] = (
        red,
        green,
        blue,
    )
    shadows.origins_world[k, 0], shadows.origins_world[k, 1], shadows.origins_world[k, 2] = x, y, z
    shadows.directions_world[k, 0] = w_x
    shadows.directions_world[k, 1] = w_y
    shadows.directions_world[k, 2] = w_z
    # short of the light's own surface
    shadows.t_max[k] = distance * SHADOW_RAY_SCALE if distance < INFINITE_DISTANCE else np.inf


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def sample_pair(samples: PathSamples, pair: int) -> tuple[float, float]:
    """Return a pair of uniform numbers of a path."""
    return samples.random_numbers[pair, 0, samples.n], samples.random_numbers[pair, 1, samples.n]


class LightSample(NamedTuple):
    """A place on a light, drawn for a point.

    Attributes:
        id: number of the light, -1 where there is none for the point; all else is 0 then.
        share: probability that this light was chosen.
        direction: to the place, a unit vector.
        distance: to the place.
        rgb: linear radiance from there, or what a light without extent sends.
        pdf: density of the direction, 0 for a light without extent.
    """

    id: int
    share: float
    direction: Vec3
    distance: float
    rgb: Rgb
    pdf: float


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def draw_light(lights: LightArrays, point: Vec3, samples: PathSamples) -> LightSample:
    """Choose a light for a point, and a place on it."""
    x, y, z = point
    if len(lights.kinds):
        l, share = sample_light_index(lights, x, y, z, sample_pair(samples, LIGHT_CHOICE_SAMPLE)[0], True)
        if l >= 0:
            u, v = sample_pair(samples, LIGHT_POSITION_SAMPLE)
            w_x, w_y, w_z, distance, red, green, blue, pdf = sample_light(lights, l, x, y, z, u, v)
            return LightSample(l, share, (w_x, w_y, w_z), distance, (red, green, blue), pdf)
    return LightSample(-1, 0.0, (0.0, 0.0, 0.0), 0.0, (0.0, 0.0, 0.0), 0.0)


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def survives_roulette(paths: PathArrays, p: int, roulette: float) -> bool:
    """Play russian roulette: terminate a path by its throughput; returns whether it continues.

    Clear paths continue: what they see is composited in display values, in which a mean of some is not that
    of all.
    """
    if paths.flags[p] & FLAG_CLEAR != 0:
        return True
    w = paths.throughput[p]
    # some end always, or paths between white walls would go on to the last bounce
    stay = min(max(w[0], w[1], w[2]), 0.95)
    if roulette >= stay:
        paths.is_alive[p] = False
        return False
    for channel in range(3):
        paths.throughput[p, channel] /= stay
    return True


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def surface_eval(
    o: Vec3, i: Vec3, is_diffuse: bool, bsdf: Bsdf, tables: AlbedoTables
) -> tuple[float, float, float, float]:
    """Return value times cosine and density of a surface that scatters."""
    if is_diffuse:
        red, green, blue = bsdf.rgb
        pdf = i[2] / math.pi
        return red * pdf, green * pdf, blue * pdf, pdf
    return principled_eval(o, i, bsdf, tables)


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def _is_lit(light: LightSample, point: SurfacePoint) -> bool:
    """Return whether a sample of a light brings anything to a point, on the side of both its normals."""
    (w_x, w_y, w_z), (red, green, blue) = light.direction, light.rgb
    (n_x, n_y, n_z), (s_x, s_y, s_z) = point.normal, point.shading_normal
    return (
        w_x * s_x + w_y * s_y + w_z * s_z > 0.0
        and w_x * n_x + w_y * n_y + w_z * n_z > 0.0
        and red + green + blue > 0.0
    )


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def _query_light(
    p: int, paths: PathArrays, light: LightSample, origin: Vec3, value: Rgb, pdf: float, query: LightQuery
) -> None:
    """Queue the light of a sample; ``value`` is the surface's, times cosine, ``pdf`` its density."""
    lights, shadows, k, l, l_pdf = query.lights, query.shadows, query.k, light.id, light.pdf
    factor = 1.0 / light.share
    # a light without extent is found by no other path, so that glass must let it through
    shadows.passes_glass[k] = l_pdf == 0.0
    if l_pdf > 0.0:
        l_pdf *= light.share
        # balance heuristic, where both ways can find the light
        factor = 1.0 / (l_pdf + pdf) if lights.is_hittable[l] else 1.0 / l_pdf
    # nothing is in the way of what casts no shadows
    distance = light.distance if lights.casts_shadows[l] else 0.0
    w, (f_r, f_g, f_b), (l_r, l_g, l_b) = paths.throughput[p], value, light.rgb
    radiance = w[0] * f_r * l_r * factor, w[1] * f_g * l_g * factor, w[2] * f_b * l_b * factor
    clamp = query.integrator.clamp if paths.flags[p] & FLAG_SCATTERED else np.inf
    queue_shadow_ray(shadows, k, origin, light.direction, distance, radiance, clamp)


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def _leave_surface(
    p: int, paths: PathArrays, point: SurfacePoint, direction: Vec3, factor: Rgb, pdf: float
) -> bool:
    """Multiply the throughput of a path that goes on by ``factor``; return whether it goes on at all."""
    (w_x, w_y, w_z), (n_x, n_y, n_z), (red, green, blue) = direction, point.normal, factor
    if not pdf > 0.0 or w_x * n_x + w_y * n_y + w_z * n_z <= 0.0 or red + green + blue <= 0.0:
        paths.is_alive[p] = False
        return False
    paths.throughput[p, 0] *= red
    paths.throughput[p, 1] *= green
    paths.throughput[p, 2] *= blue
    paths.flags[p] = (paths.flags[p] | FLAG_SCATTERED) & ~(FLAG_CLEAR | FLAG_CAMERA_RAY | FLAG_THROUGH_GLASS)
    return True


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def scatter_diffuse(
    p: int,
    paths: PathArrays,
    point: SurfacePoint,
    rgb: Rgb,
    light: LightSample,
    way: Vec3,
    pdf: float,
    query: LightQuery,
) -> None:
    """Queue a light query at a diffuse surface, and continue path ``p`` from a point off it.

    Its ``way`` on, with the density ``pdf``, was drawn before, as was the light's sample.
    """
    if _is_lit(light, point):
        (w_x, w_y, w_z), (s_x, s_y, s_z) = light.direction, point.shading_normal
        share = (w_x * s_x + w_y * s_y + w_z * s_z) / math.pi
        value = rgb[0] * share, rgb[1] * share, rgb[2] * share
        _query_light(p, paths, light, point.position, value, share, query)
    # as dense as the value: the color is what is left
    if _leave_surface(p, paths, point, way, rgb, pdf):
        (x, y, z), (w_x, w_y, w_z) = point.position, way
        spawn_ray(paths, p, x, y, z, w_x, w_y, w_z, pdf)


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def scatter_path(
    p: int,
    samples: PathSamples,
    paths: PathArrays,
    is_diffuse: bool,
    point: SurfacePoint,
    bsdf: Bsdf,
    tables: AlbedoTables,
    light: LightSample,
    query: LightQuery,
) -> None:
    """Queue a query of the light that was drawn, and continue path ``p`` from a point off its surface.

    A surface that ``is_diffuse`` has a color alone.
    """
    (x, y, z), _, (s_x, s_y, s_z), _ = point
    d = paths.directions_world[p]
    # --- the direction to the viewer, in the frame of the shading normal ---
    a_x, a_y, a_z, b_x, b_y, b_z = orthonormal_basis(s_x, s_y, s_z)
    o = (
        -(d[0] * a_x + d[1] * a_y + d[2] * a_z),
        -(d[0] * b_x + d[1] * b_y + d[2] * b_z),
        -(d[0] * s_x + d[1] * s_y + d[2] * s_z),
    )
    # --- the sample of a light ---
    if _is_lit(light, point):
        w_x, w_y, w_z = light.direction
        i = (
            w_x * a_x + w_y * a_y + w_z * a_z,
            w_x * b_x + w_y * b_y + w_z * b_z,
            w_x * s_x + w_y * s_y + w_z * s_z,
        )
        f_r, f_g, f_b, pdf = surface_eval(o, i, is_diffuse, bsdf, tables)
        _query_light(p, paths, light, point.position, (f_r, f_g, f_b), pdf, query)
    # --- a sample of the BSDF ---
    u, v = sample_pair(samples, DIRECTION_SAMPLE)
    if is_diffuse:
        i_x, i_y, i_z = sample_cosine(u, v)
        (f_r, f_g, f_b), pdf = bsdf.rgb, i_z / math.pi  # as dense as the value: the color is what is left
    else:
        choice = sample_pair(samples, LOBE_SAMPLE)[0]
        i_x, i_y, i_z = principled_sample(o, bsdf, tables, choice, u, v)
        f_r, f_g, f_b, pdf = principled_eval(o, (i_x, i_y, i_z), bsdf, tables)
        inverse = 1.0 / pdf if pdf > 0.0 else 0.0
        f_r, f_g, f_b = inverse * f_r, inverse * f_g, inverse * f_b
    w_x = i_x * a_x + i_y * b_x + i_z * s_x
    w_y = i_x * a_y + i_y * b_y + i_z * s_y
    w_z = i_x * a_z + i_y * b_z + i_z * s_z
    # --- the path goes on ---
    if _leave_surface(p, paths, point, (w_x, w_y, w_z), (f_r, f_g, f_b), pdf):
        if not is_diffuse:
            w_x, w_y, w_z = normalize(w_x, w_y, w_z)
        spawn_ray(paths, p, x, y, z, w_x, w_y, w_z, pdf)

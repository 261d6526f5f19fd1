"""Paths at mirrors, and at glass, smooth and rough."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Int32

from octasplat.engine.pathtracing.kernels.kernel_args import MaterialArrays, Rgb, SurfacePoint
from octasplat.engine.pathtracing.kernels.nested_glass import (
    AIR,
    cross_surface,
    index_of,
    is_nested,
    medium_of,
)
from octasplat.engine.pathtracing.kernels.path_args import LightQuery, PathArrays, PathSamples
from octasplat.engine.pathtracing.kernels.principled_bsdf import fresnel_dielectric, orthonormal_basis
from octasplat.engine.pathtracing.kernels.rough_dielectric import (
    rough_dielectric_eval,
    rough_dielectric_sample,
)
from octasplat.engine.pathtracing.kernels.scatter import (
    DIRECTION_SAMPLE,
    FLAG_CAMERA_RAY,
    FLAG_CLEAR,
    FLAG_SCATTERED,
    FLAG_THROUGH_GLASS,
    LOBE_SAMPLE,
    draw_light,
    queue_shadow_ray,
    sample_pair,
    spawn_ray,
)
from octasplat.engine.pathtracing.kernels.surface import normalize, offset_ray_origin, reflect
from octasplat.engine.shading.kernels.microfacets import table_value
from octasplat.engine.trace.kernels.native import njit_no_refcount


class Glass(NamedTuple):
    """A surface of glass that a path meets.

    Attributes:
        materials: of the stage.
        m: row of the glass in them.
        is_entering: whether the path comes from outside.
        eta: index of refraction on the far side over that on the viewer's.
        medium: on the far side, -1 for air.
        is_in_air: whether there is air on one side.
    """

    materials: MaterialArrays
    m: int
    is_entering: bool
    eta: float
    medium: int
    is_in_air: bool


@njit_no_refcount(forceinline=True)
def glass_surface(
    materials: MaterialArrays, m: int, is_entering: bool, media: Int32[np.ndarray, " d"]
) -> Glass:
    """Return the surface of glass ``m`` for a path that is inside ``media``."""
    other = AIR
    if is_nested(materials, m):
        if is_entering:
            other = medium_of(materials, media)
        else:
            # what is left once this one is taken out
            cross_surface(media, m, False)
            other = medium_of(materials, media)
            cross_surface(media, m, True)
    ior, around = materials.iors[m], index_of(materials, other)
    eta = ior / around if is_entering else around / ior
    medium = int(m) if is_entering else other
    return Glass(materials, m, is_entering, eta, medium, other < 0)


@njit_no_refcount(forceinline=True)
def _enter_far_side(paths: PathArrays, p: int, glass: Glass) -> None:
    """Note that a path goes through a surface of glass."""
    paths.medium_ids[p] = glass.medium
    if is_nested(glass.materials, glass.m):
        cross_surface(paths.media[p], glass.m, glass.is_entering)


@njit_no_refcount(forceinline=True)
def scatter_mirror(paths: PathArrays, p: int, point: SurfacePoint, reflectance: Rgb) -> None:
    """Reflect a path at a mirror and multiply its throughput by ``reflectance``."""
    (x, y, z), (n_x, n_y, n_z), (s_x, s_y, s_z), step = point
    red, green, blue = reflectance
    d = paths.directions_world[p]
    r_x, r_y, r_z = reflect(d[0], d[1], d[2], s_x, s_y, s_z)
    # an interpolated normal may send it into the surface: the face's own then
    if r_x * n_x + r_y * n_y + r_z * n_z <= 0.0:
        r_x, r_y, r_z = reflect(d[0], d[1], d[2], n_x, n_y, n_z)
    paths.flags[p] &= ~(FLAG_CAMERA_RAY | FLAG_THROUGH_GLASS)
    paths.throughput[p, 0] *= red
    paths.throughput[p, 1] *= green
    paths.throughput[p, 2] *= blue
    x, y, z = offset_ray_origin(x, y, z, n_x, n_y, n_z, step)
    spawn_ray(paths, p, x, y, z, r_x, r_y, r_z, 0.0)


@njit_no_refcount(forceinline=True)
def scatter_smooth_glass(
    paths: PathArrays,
    p: int,
    glass: Glass,
    point: SurfacePoint,
    choice: float,
) -> None:
    """Reflect a path at glass or let it through, by chance as Fresnel says."""
    (x, y, z), (n_x, n_y, n_z), (s_x, s_y, s_z), step = point
    d = paths.directions_world[p]
    materials, m, eta = glass.materials, glass.m, glass.eta
    cosine = -(d[0] * s_x + d[1] * s_y + d[2] * s_z)
    share, cos_t = fresnel_dielectric(min(cosine, 1.0), eta)
    # two ways on: what is behind is no longer one direction
    if share < 1.0 and eta != 1.0:
        paths.flags[p] &= ~FLAG_CLEAR
    if eta != 1.0 and choice < share:
        scatter_mirror(paths, p, point, (1.0, 1.0, 1.0))
        return
    tint = materials.colors_linear[m]
    plain = tint[0] == 1.0 and tint[1] == 1.0 and tint[2] == 1.0
    absorbs = materials.absorption[m, 0] + materials.absorption[m, 1] + materials.absorption[m, 2] > 0.0
    if not plain or absorbs:
        paths.flags[p] &= ~FLAG_CLEAR
    for channel in range(3):
        paths.throughput[p, channel] *= tint[channel]
    t_x, t_y, t_z = float(d[0]), float(d[1]), float(d[2])
    if eta != 1.0:
        paths.flags[p] &= ~FLAG_CAMERA_RAY
        along = cosine / eta - cos_t
        t_x, t_y, t_z = normalize(t_x / eta + along * s_x, t_y / eta + along * s_y, t_z / eta + along * s_z)
    if paths.pdf[p] > 0.0:
        paths.flags[p] |= FLAG_THROUGH_GLASS
    _enter_far_side(paths, p, glass)
    x, y, z = offset_ray_origin(x, y, z, -n_x, -n_y, -n_z, step)
    spawn_ray(paths, p, x, y, z, t_x, t_y, t_z, 0.0)


@njit_no_refcount(forceinline=True)
def _rough_glass_gain(glass: Glass, o_z: float) -> float:
    """Return the factor that makes up for the light that one bounce loses; between two glasses it is lost."""
    materials, m = glass.materials, glass.m
    if not (materials.energy_compensation[m] and glass.is_in_air):
        return 1.0
    table = materials.coat_tables[m] + (0 if glass.is_entering else 1)
    # the directional albedo of one bounce, scaled up to 1
    return 1.0 / table_value(materials.coat_albedo[table], o_z, materials.roughness[m])


@njit_no_refcount()
def scatter_rough_glass(
    paths: PathArrays,
    p: int,
    glass: Glass,
    point: SurfacePoint,
    samples: PathSamples,
    query: LightQuery,
) -> None:
    """Queue a light query at rough glass, and reflect or refract the path at a microfacet."""
    (x, y, z), (n_x, n_y, n_z), (s_x, s_y, s_z), step = point
    lights, shadows, k = query.lights, query.shadows, query.k
    d = paths.directions_world[p]
    materials, m, eta = glass.materials, glass.m, glass.eta
    tint, roughness = materials.colors_linear[m], materials.roughness[m]
    alpha = roughness * roughness
    # --- the direction to the viewer, in the frame of the shading normal ---
    a_x, a_y, a_z, b_x, b_y, b_z = orthonormal_basis(s_x, s_y, s_z)
    o_x = -(d[0] * a_x + d[1] * a_y + d[2] * a_z)
    o_y = -(d[0] * b_x + d[1] * b_y + d[2] * b_z)
    o_z = -(d[0] * s_x + d[1] * s_y + d[2] * s_z)
    gain = _rough_glass_gain(glass, o_z)
    front = offset_ray_origin(x, y, z, n_x, n_y, n_z, step)
    back = offset_ray_origin(x, y, z, -n_x, -n_y, -n_z, step)
    # --- a sample of a light ---
    w = paths.throughput[p]
    # directly seen light is not cut off
    clamp = query.integrator.clamp if paths.flags[p] & FLAG_SCATTERED else math.inf
    l, share, (w_x, w_y, w_z), distance, (l_r, l_g, l_b), l_pdf = draw_light(lights, point.position, samples)
    i_z = w_x * s_x + w_y * s_y + w_z * s_z
    # both normals must agree on the side, or light would leak through
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
            if through:
                shadows.medium_ids[k] = glass.medium
                if is_nested(materials, m):
                    cross_surface(shadows.media[k], m, glass.is_entering)
            # nothing is in the way of what casts no shadows
            distance = distance if lights.casts_shadows[l] else 0.0
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
    paths.flags[p] = (paths.flags[p] | FLAG_SCATTERED) & ~(FLAG_CLEAR | FLAG_CAMERA_RAY | FLAG_THROUGH_GLASS)
    w_x, w_y, w_z = normalize(w_x, w_y, w_z)
    if through:
        _enter_far_side(paths, p, glass)
    x, y, z = back if through else front
    spawn_ray(paths, p, x, y, z, w_x, w_y, w_z, pdf)

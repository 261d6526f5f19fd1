"""Compiled functions of lights: which one to ask, a direction to it, and how likely that direction was.

p is the point that is lit. Weights of lights at a point are what they would bring to a surface that faces
them, so that the nearest and strongest is asked most.
"""

import math

import numpy as np
from jaxtyping import Float32, Float64, Int64

from octasplat.engine.core.compilation import kernel
from octasplat.engine.pathtracing.kernels.cutouts import eval_opacity, has_holes
from octasplat.engine.pathtracing.kernels.environment_light import (
    eval_environment,
    sample_cdf,
    sample_environment,
)
from octasplat.engine.pathtracing.kernels.kernel_args import (
    DIRECTIONAL,
    ENVIRONMENT,
    MESH,
    RECTANGLE,
    SPHERE,
    SPOT,
    LightArrays,
)
from octasplat.engine.pathtracing.kernels.principled_bsdf import orthonormal_basis
from octasplat.engine.pathtracing.kernels.surface import interpolate_uv
from octasplat.engine.pathtracing.kernels.texture import eval_texture
from octasplat.engine.trace.kernels.native import njit_no_refcount

INFINITE_DISTANCE = 1e30


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def luminance(red: float, green: float, blue: float) -> float:
    """Return the luminance of linear Rec. 709 values."""
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def _spot_falloff(lights: LightArrays, l: int, way_x: float, way_y: float, way_z: float) -> float:
    """Return how much of a spot's intensity goes a way (a unit vector from the light)."""
    axis = lights.axes[l]
    cosine = axis[0] * way_x + axis[1] * way_y + axis[2] * way_z
    outer, inner = lights.cosines[l, 0], lights.cosines[l, 1]
    share = min(max((cosine - outer) / (inner - outer), 0.0), 1.0)  # soft edge between both angles
    return share * share


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def light_importance(lights: LightArrays, l: int, p_x: float, p_y: float, p_z: float) -> float:
    """Estimate the irradiance of a light at a surface at p that faces it; 0 only where it is exactly 0."""
    power = luminance(lights.rgb_linear[l, 0], lights.rgb_linear[l, 1], lights.rgb_linear[l, 2])
    kind = lights.kinds[l]
    if kind in (DIRECTIONAL, ENVIRONMENT):
        return power
    way_x = p_x - lights.positions_world[l, 0]
    way_y = p_y - lights.positions_world[l, 1]
    way_z = p_z - lights.positions_world[l, 2]
    # no division by zero at the light itself
    squared = max(way_x * way_x + way_y * way_y + way_z * way_z, 1e-20)
    if kind == RECTANGLE:
        axis = lights.axes[l]
        if axis[0] * way_x + axis[1] * way_y + axis[2] * way_z <= 0.0:
            return 0.0
        # near it at most pi times the radiance, as under an infinite plane
        return power * lights.areas[l] / (squared + lights.areas[l] / math.pi)
    if kind == SPHERE:
        return power * lights.areas[l] / squared
    if kind == MESH:
        # a quarter: the mean projected area of a convex body (Cauchy)
        return 0.25 * power * lights.areas[l] / (squared + lights.areas[l] / math.pi)
    if kind == SPOT:
        distance = math.sqrt(squared)
        power *= _spot_falloff(lights, l, way_x / distance, way_y / distance, way_z / distance)
    return power / squared


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def _light_weight(lights: LightArrays, l: int, p_x: float, p_y: float, p_z: float, is_mesh: bool) -> float:
    """Return :func:`light_importance`, or 0 of a light that does not light meshes where p lies on one."""
    if is_mesh and not lights.lights_meshes[l]:
        return 0.0
    return light_importance(lights, l, p_x, p_y, p_z)


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def sample_light_index(
    lights: LightArrays, p_x: float, p_y: float, p_z: float, u: float, is_mesh: bool
) -> tuple[int, float]:
    """Return a light and the probability with which it is asked at p; -1 where none shines.

    ``is_mesh`` tells whether p lies on a mesh, or on Gaussians with materials.
    """
    count = len(lights.kinds)
    if count == 1:
        # where a light does not shine its sample brings nothing to a mesh
        shines = lights.lights_meshes[0] != 0 if is_mesh else light_importance(lights, 0, p_x, p_y, p_z) > 0.0
        return (0, 1.0) if shines else (-1, 0.0)
    total = 0.0
    for l in range(count):
        total += _light_weight(lights, l, p_x, p_y, p_z, is_mesh)
    if not total > 0.0:
        return -1, 0.0
    left, found, share = u * total, -1, 0.0
    for l in range(count):
        weight = _light_weight(lights, l, p_x, p_y, p_z, is_mesh)
        if weight > 0.0:
            found, share = l, weight / total  # the last one that shines, should rounding leave a rest
            left -= weight
            if left < 0.0:
                break
    return found, share


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def light_probability(lights: LightArrays, light_id: int, p_x: float, p_y: float, p_z: float) -> float:
    """Return the probability with which :func:`sample_light_index` asks a light at p, on a mesh."""
    if len(lights.kinds) == 1:
        return 1.0 if lights.lights_meshes[0] else 0.0
    total, own = 0.0, 0.0
    for l in range(len(lights.kinds)):
        weight = _light_weight(lights, l, p_x, p_y, p_z, True)
        total += weight
        if l == light_id:
            own = weight
    return own / total if total > 0.0 else 0.0


@njit_no_refcount(forceinline=True)
def is_only_rectangle(lights: LightArrays) -> bool:
    """Return whether a rectangle that lights meshes is the only light."""
    return len(lights.kinds) == 1 and lights.kinds[0] == RECTANGLE and lights.lights_meshes[0] != 0


@njit_no_refcount(fastmath={"contract"})
def no_shadow_probability(lights: LightArrays, p_x: float, p_y: float, p_z: float) -> float:
    """Return the probability with which a light is asked at p whose shadows take nothing."""
    if not lights.any_takes_nothing:
        return 0.0
    total, idle = 0.0, 0.0
    for l in range(len(lights.kinds)):
        weight = light_importance(lights, l, p_x, p_y, p_z)
        total += weight
        if not lights.takes_light[l]:
            idle += weight
    return idle / total if total > 0.0 else 0.0


@njit_no_refcount(fastmath={"contract"})
def eval_emission(lights: LightArrays, l: int, u: float, v: float) -> tuple[float, float, float]:
    """Return linear radiance of a shining surface at texture coordinates."""
    rgb = lights.rgb_linear[l]
    if lights.textures[l] < 0:
        return rgb[0], rgb[1], rgb[2]
    red, green, blue = eval_texture(lights, lights.textures[l], u, v)
    return rgb[0] * red, rgb[1] * green, rgb[2] * blue


@njit_no_refcount(fastmath={"contract"})
def emitter_hit_pdf(
    lights: LightArrays, l: int, o: Float32[np.ndarray, "3"], distance: float, cosine: float
) -> float:
    """Return density over solid angle with which :func:`sample_light` gives from o the place that a ray met.

    ``distance`` is that of the place and ``cosine`` the cosine there.
    """
    if lights.kinds[l] == SPHERE:
        # a ball is sampled by solid angle, all others by area
        x, y, z = (
            lights.positions_world[l, 0] - o[0],
            lights.positions_world[l, 1] - o[1],
            lights.positions_world[l, 2] - o[2],
        )
        return 1.0 / (
            2.0 * math.pi * _one_minus_cosine(lights.areas[l] / math.pi / max(x * x + y * y + z * z, 1e-20))
        )
    return distance * distance / (max(cosine, 1e-9) * lights.areas[l])


@njit_no_refcount(fastmath={"contract"})
def _one_minus_cosine(squared_sine: float) -> float:
    """Return 1 - cos of an angle below 90 degrees, without cancellation where it is small."""
    squared_sine = min(squared_sine, 1.0)
    # only what cannot be divided by is kept off: a ball may be as far and as small as it likes
    return max(squared_sine / (1.0 + math.sqrt(1.0 - squared_sine)), 1e-60)


@njit_no_refcount(fastmath={"contract"})
def _sample_sphere(
    lights: LightArrays, l: int, p_x: float, p_y: float, p_z: float, u: float, v: float
) -> tuple[float, float, float, float, float, float, float, float]:
    """Return a way from p to a ball of light, evenly over the solid angle that it fills."""
    way_x = lights.positions_world[l, 0] - p_x
    way_y = lights.positions_world[l, 1] - p_y
    way_z = lights.positions_world[l, 2] - p_z
    # squared radius of the ball
    squared, of_ball = way_x * way_x + way_y * way_y + way_z * way_z, lights.areas[l] / math.pi
    if squared <= of_ball:
        return 0.0, 0.0, 1.0, INFINITE_DISTANCE, 0.0, 0.0, 0.0, 1.0
    distance = math.sqrt(squared)
    inverse = 1.0 / distance
    way_x, way_y, way_z = inverse * way_x, inverse * way_y, inverse * way_z
    cap = _one_minus_cosine(of_ball / squared)
    cosine = 1.0 - u * cap
    sine = math.sqrt(max(1.0 - cosine * cosine, 0.0))
    a_x, a_y, a_z, b_x, b_y, b_z = orthonormal_basis(way_x, way_y, way_z)
    a, b = sine * math.cos(2.0 * math.pi * v), sine * math.sin(2.0 * math.pi * v)
    # to the near side of the ball
    reach = distance * cosine - math.sqrt(max(of_ball - squared * sine * sine, 0.0))
    rgb = lights.rgb_linear[l]
    return (
        a * a_x + b * b_x + cosine * way_x,
        a * a_y + b * b_y + cosine * way_y,
        a * a_z + b * b_z + cosine * way_z,
        reach,
        rgb[0],
        rgb[1],
        rgb[2],
        1.0 / (2.0 * math.pi * cap),
    )


@njit_no_refcount(fastmath={"contract"})
def _sample_mesh(
    lights: LightArrays, l: int, p_x: float, p_y: float, p_z: float, u: float, v: float
) -> tuple[float, float, float, float, float, float, float, float]:
    """Return a way from p to a shining mesh, evenly over its area."""
    first, last = lights.mesh_rows[l, 0], lights.mesh_rows[l, 1]
    row, u = sample_cdf(lights.mesh_cdf[first : last + 1], u)
    face = lights.mesh_rows[l, 2] + row
    corners, uv = lights.mesh_corners_world[face], lights.mesh_uv[face]
    root = math.sqrt(u)  # square root: evenly over a triangle
    a, b, c = 1.0 - root, root * (1.0 - v), root * v
    way_x = a * corners[0, 0] + b * corners[1, 0] + c * corners[2, 0] - p_x
    way_y = a * corners[0, 1] + b * corners[1, 1] + c * corners[2, 1] - p_y
    way_z = a * corners[0, 2] + b * corners[1, 2] + c * corners[2, 2] - p_z
    squared = max(way_x * way_x + way_y * way_y + way_z * way_z, 1e-20)
    distance = math.sqrt(squared)
    inverse = 1.0 / distance
    way_x, way_y, way_z = inverse * way_x, inverse * way_y, inverse * way_z
    s_x, s_y, s_z = (
        corners[1, 0] - corners[0, 0],
        corners[1, 1] - corners[0, 1],
        corners[1, 2] - corners[0, 2],
    )
    t_x, t_y, t_z = (
        corners[2, 0] - corners[0, 0],
        corners[2, 1] - corners[0, 1],
        corners[2, 2] - corners[0, 2],
    )
    n_x, n_y, n_z = s_y * t_z - s_z * t_y, s_z * t_x - s_x * t_z, s_x * t_y - s_y * t_x
    length = max(math.sqrt(n_x * n_x + n_y * n_y + n_z * n_z), 1e-30)
    cosine = abs(n_x * way_x + n_y * way_y + n_z * way_z) / length
    if cosine <= 1e-9:  # seen edge on it sends nothing, and its density would be infinite
        return way_x, way_y, way_z, distance, 0.0, 0.0, 0.0, 1.0
    t_u, t_v = interpolate_uv(uv, a, b, c)
    red, green, blue = eval_emission(lights, l, t_u, t_v)
    if has_holes(lights, l):
        alpha = lights.mesh_alpha[face]
        share = eval_opacity(lights, l, t_u, t_v, a * alpha[0] + b * alpha[1] + c * alpha[2])
        red, green, blue = share * red, share * green, share * blue
    return way_x, way_y, way_z, distance, red, green, blue, squared / (cosine * lights.areas[l])


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def sample_light(
    lights: LightArrays, l: int, p_x: float, p_y: float, p_z: float, u: float, v: float
) -> tuple[float, float, float, float, float, float, float, float]:
    """Return a way from p to a light: unit direction, distance, linear radiance, density over solid angle.

    A density of 0 marks light that comes from one direction only: in place of radiance there is irradiance.
    """
    kind = lights.kinds[l]
    rgb = lights.rgb_linear[l]
    if kind == ENVIRONMENT:
        d_x, d_y, d_z, pdf = sample_environment(lights, u, v)
        red, green, blue = eval_environment(lights, d_x, d_y, d_z)
        return d_x, d_y, d_z, INFINITE_DISTANCE, red, green, blue, pdf
    if kind == SPHERE:
        return _sample_sphere(lights, l, p_x, p_y, p_z, u, v)
    if kind == MESH:
        return _sample_mesh(lights, l, p_x, p_y, p_z, u, v)
    axis = lights.axes[l]
    if kind == DIRECTIONAL:
        return -axis[0], -axis[1], -axis[2], INFINITE_DISTANCE, rgb[0], rgb[1], rgb[2], 0.0
    way_x = lights.positions_world[l, 0] - p_x
    way_y = lights.positions_world[l, 1] - p_y
    way_z = lights.positions_world[l, 2] - p_z
    if kind == RECTANGLE:
        a, b = u - 0.5, v - 0.5
        way_x += a * lights.sides_u[l, 0] + b * lights.sides_v[l, 0]
        way_y += a * lights.sides_u[l, 1] + b * lights.sides_v[l, 1]
        way_z += a * lights.sides_u[l, 2] + b * lights.sides_v[l, 2]
    squared = max(way_x * way_x + way_y * way_y + way_z * way_z, 1e-20)
    along = -(axis[0] * way_x + axis[1] * way_y + axis[2] * way_z)  # distance times cosine at a rectangle
    distance = math.sqrt(squared)
    inverse = 1.0 / distance
    way_x, way_y, way_z = inverse * way_x, inverse * way_y, inverse * way_z
    if kind == RECTANGLE:
        if along <= 1e-9 * distance:
            return way_x, way_y, way_z, distance, 0.0, 0.0, 0.0, 1.0
        pdf = squared * distance / (along * lights.areas[l])
        return way_x, way_y, way_z, distance, rgb[0], rgb[1], rgb[2], pdf
    falloff = 1.0 / squared
    if kind == SPOT:
        falloff *= _spot_falloff(lights, l, -way_x, -way_y, -way_z)
    return way_x, way_y, way_z, distance, rgb[0] * falloff, rgb[1] * falloff, rgb[2] * falloff, 0.0


@kernel(error_model="numpy")
def light_samples(
    lights: LightArrays,
    points: Float64[np.ndarray, "n 3"],
    numbers: Float64[np.ndarray, "n 3"],
    directions: Float64[np.ndarray, "n 3"],
    distances: Float64[np.ndarray, " n"],
    radiance: Float64[np.ndarray, "n 3"],
    density: Float64[np.ndarray, " n"],
    lights_asked: Int64[np.ndarray, " n"],
) -> None:
    """Run :func:`sample_light_index` and :func:`sample_light` at points with three uniform numbers each.

    ``density`` and, of light that comes from one direction only, ``radiance`` hold the choice of the light.
    """
    for n in range(len(points)):
        p = points[n]
        l, share = sample_light_index(lights, p[0], p[1], p[2], numbers[n, 0], True)
        lights_asked[n] = l
        if l < 0:
            radiance[n], density[n] = 0.0, 0.0
            continue
        d_x, d_y, d_z, distance, red, green, blue, pdf = sample_light(
            lights, l, p[0], p[1], p[2], numbers[n, 1], numbers[n, 2]
        )
        directions[n, 0], directions[n, 1], directions[n, 2] = d_x, d_y, d_z
        distances[n], density[n] = distance, pdf * share
        factor = 1.0 if pdf > 0.0 else 1.0 / share
        radiance[n, 0], radiance[n, 1], radiance[n, 2] = red * factor, green * factor, blue * factor

"""Surface interaction of a ray with a triangle: point, normals and material with its textures."""

import math

import numpy as np
from jaxtyping import Float32

from octasplat.engine.pathtracing.kernels.kernel_args import MaterialArrays, SurfaceArrays, Vec3
from octasplat.engine.pathtracing.kernels.texture import eval_texture
from octasplat.engine.trace.kernels.native import njit_no_refcount

DIFFUSE, MIRROR, GLASS, PRINCIPLED, EMITTER = 0, 1, 2, 3, 4
RAY_OFFSET_SCALE = 5e-6
"""How far off a surface rays begin, of the largest coordinate: float32 rounds the point."""
FACE_OFFSET_SCALE = 3e-7
"""Likewise of the longest edge of its face, which Embree finds a little before or behind itself; a third of
that is enough for all of 80,000 rays."""


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def interpolate_corners(
    corners: Float32[np.ndarray, "3 3"], a: float, b: float, c: float
) -> tuple[float, float, float]:
    """Return the point with weights a, b, c of the corners."""
    return (
        a * corners[0, 0] + b * corners[1, 0] + c * corners[2, 0],
        a * corners[0, 1] + b * corners[1, 1] + c * corners[2, 1],
        a * corners[0, 2] + b * corners[1, 2] + c * corners[2, 2],
    )


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def interpolate_uv(
    corner_uv: Float32[np.ndarray, "3 2"], a: float, b: float, c: float
) -> tuple[float, float]:
    """Return the texture coordinates with weights a, b, c of the corners."""
    return (
        a * corner_uv[0, 0] + b * corner_uv[1, 0] + c * corner_uv[2, 0],
        a * corner_uv[0, 1] + b * corner_uv[1, 1] + c * corner_uv[2, 1],
    )


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def normalize(x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return the vector with length 1."""
    inverse = 1.0 / max(math.sqrt(x * x + y * y + z * z), 1e-30)
    return inverse * x, inverse * y, inverse * z


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def face_normal(corners: Float32[np.ndarray, "3 3"]) -> tuple[float, float, float]:
    """Return unit normal of a triangle, on the side from which its corners run anticlockwise."""
    u_x, u_y, u_z = (
        float(corners[1, 0]) - corners[0, 0],
        float(corners[1, 1]) - corners[0, 1],
        float(corners[1, 2]) - corners[0, 2],
    )
    v_x, v_y, v_z = (
        float(corners[2, 0]) - corners[0, 0],
        float(corners[2, 1]) - corners[0, 1],
        float(corners[2, 2]) - corners[0, 2],
    )
    return normalize(u_y * v_z - u_z * v_y, u_z * v_x - u_x * v_z, u_x * v_y - u_y * v_x)


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def offset_ray_origin(
    p_x: float, p_y: float, p_z: float, n_x: float, n_y: float, n_z: float, step: float
) -> tuple[float, float, float]:
    """Move a point a little off a surface along n, so that rounding does not put it behind the surface.

    ``step`` is that of :func:`.surface_point_vectors.write_surface_points8`.
    """
    return p_x + step * n_x, p_y + step * n_y, p_z + step * n_z


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def has_textures(materials: MaterialArrays, m: int) -> bool:
    """Return whether :func:`eval_material`, :func:`eval_clear_coat` or :func:`eval_normal_map` reads one."""
    return (
        materials.color_textures[m] >= 0
        or materials.metallic_roughness_textures[m] >= 0
        or materials.normal_textures[m] >= 0
        or materials.clear_coat_textures[m] >= 0
        or materials.clear_coat_roughness_textures[m] >= 0
    )


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def eval_material(
    materials: MaterialArrays, m: int, u: float, v: float
) -> tuple[float, float, float, float, float]:
    """Return base color, metallic and roughness of material ``m`` at texture coordinates."""
    red, green, blue = (
        materials.colors_linear[m, 0],
        materials.colors_linear[m, 1],
        materials.colors_linear[m, 2],
    )
    metallic, roughness = materials.metallic[m], materials.roughness[m]
    texture = materials.color_textures[m]
    if texture >= 0:
        t_r, t_g, t_b = eval_texture(materials, texture, u, v)
        red, green, blue = red * t_r, green * t_g, blue * t_b
    texture = materials.metallic_roughness_textures[m]
    if texture >= 0:
        _, t_g, t_b = eval_texture(materials, texture, u, v)
        # channels as in glTF: green is roughness, blue metallic
        roughness, metallic = roughness * t_g, metallic * t_b
    return red, green, blue, metallic, roughness


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def eval_clear_coat(materials: MaterialArrays, m: int, u: float, v: float) -> tuple[float, float]:
    """Return the share of the clear coat of material ``m`` at texture coordinates, and its roughness."""
    share, roughness = materials.clear_coats[m], materials.clear_coat_roughness[m]
    # channels as in glTF: red is the share, green the roughness
    texture = materials.clear_coat_textures[m]
    if texture >= 0:
        share *= eval_texture(materials, texture, u, v)[0]
    texture = materials.clear_coat_roughness_textures[m]
    if texture >= 0:
        roughness *= eval_texture(materials, texture, u, v)[1]
    return share, roughness


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def eval_vertex_alpha(surfaces: SurfaceArrays, face: int, a: float, b: float, c: float) -> float:
    """Return the alpha of the corners of a face at a place, 1 where no mesh has any of its own."""
    if len(surfaces.corner_alpha) == 0:
        return 1.0
    alpha = surfaces.corner_alpha[face]
    return a * alpha[0] + b * alpha[1] + c * alpha[2]


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def eval_vertex_color(
    surfaces: SurfaceArrays, face: int, a: float, b: float, c: float
) -> tuple[float, float, float]:
    """Return the color of the corners of a face at a place, white where no mesh has colors of its own."""
    if len(surfaces.corner_rgb_linear) == 0:
        return 1.0, 1.0, 1.0
    return interpolate_corners(surfaces.corner_rgb_linear[face], a, b, c)


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def eval_normal_map(
    materials: MaterialArrays,
    m: int,
    corners: Float32[np.ndarray, "3 3"],
    corner_uv: Float32[np.ndarray, "3 2"],
    texture_uv: tuple[float, float],
    normal: Vec3,
    shading_normal: Vec3,
    direction: Vec3,
) -> Vec3:
    """Perturb the shading normal s by the normal texture; ``normal`` is the face's, on the viewer's side.

    The frame follows the texture coordinates of the face: x where u grows, y where v shrinks, as v counts
    downwards. From the back of a face a bump is a dent: the normal is that of the front, reversed, as glTF
    has it. s stays where the face has none, or where the viewer would see the new one from behind.
    """
    (u, v), uv = texture_uv, corner_uv
    (n_x, n_y, n_z), (s_x, s_y, s_z), (d_x, d_y, d_z) = normal, shading_normal, direction
    texture = materials.normal_textures[m]
    if texture < 0:
        return s_x, s_y, s_z
    a_u, a_v = float(uv[1, 0]) - uv[0, 0], float(uv[1, 1]) - uv[0, 1]
    b_u, b_v = float(uv[2, 0]) - uv[0, 0], float(uv[2, 1]) - uv[0, 1]
    area = a_u * b_v - a_v * b_u
    if abs(area) < 1e-20:  # no area in the texture: no direction in which u grows
        return s_x, s_y, s_z
    a_x, a_y, a_z = (
        float(corners[1, 0]) - corners[0, 0],
        float(corners[1, 1]) - corners[0, 1],
        float(corners[1, 2]) - corners[0, 2],
    )
    b_x, b_y, b_z = (
        float(corners[2, 0]) - corners[0, 0],
        float(corners[2, 1]) - corners[0, 1],
        float(corners[2, 2]) - corners[0, 2],
    )
    # dP/du and -dP/dv from the edges, then orthonormal to s
    t_x, t_y, t_z = (
        (b_v * a_x - a_v * b_x) / area,
        (b_v * a_y - a_v * b_y) / area,
        (b_v * a_z - a_v * b_z) / area,
    )
    w_x, w_y, w_z = (
        (b_u * a_x - a_u * b_x) / area,
        (b_u * a_y - a_u * b_y) / area,
        (b_u * a_z - a_u * b_z) / area,
    )
    along = t_x * s_x + t_y * s_y + t_z * s_z
    t_x, t_y, t_z = normalize(t_x - along * s_x, t_y - along * s_y, t_z - along * s_z)
    along, beside = w_x * s_x + w_y * s_y + w_z * s_z, w_x * t_x + w_y * t_y + w_z * t_z
    w_x, w_y, w_z = normalize(
        w_x - along * s_x - beside * t_x, w_y - along * s_y - beside * t_y, w_z - along * s_z - beside * t_z
    )
    x, y, z = eval_texture(materials, texture, u, v)
    scale = materials.normal_scales[m]
    f_x, f_y, f_z = a_y * b_z - a_z * b_y, a_z * b_x - a_x * b_z, a_x * b_y - a_y * b_x
    side = scale if f_x * n_x + f_y * n_y + f_z * n_z >= 0.0 else -scale
    # not below the surface
    x, y, z = side * (2.0 * x - 1.0), side * (2.0 * y - 1.0), max(2.0 * z - 1.0, 1e-3)
    x, y, z = normalize(x * t_x + y * w_x + z * s_x, x * t_y + y * w_y + z * s_y, x * t_z + y * w_z + z * s_z)
    if x * d_x + y * d_y + z * d_z > -1e-4 or x * n_x + y * n_y + z * n_z <= 0.0:
        return s_x, s_y, s_z
    return x, y, z


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def reflect(
    d_x: float, d_y: float, d_z: float, n_x: float, n_y: float, n_z: float
) -> tuple[float, float, float]:
    """Return the direction d after a mirror with the normal n."""
    twice = 2.0 * (d_x * n_x + d_y * n_y + d_z * n_z)
    return d_x - twice * n_x, d_y - twice * n_y, d_z - twice * n_z

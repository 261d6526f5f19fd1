"""What a ray finds on a triangle: the point, its normals, and its material with textures looked up."""

import math

from engine.trace.kernels_native import lean

DIFFUSE, MIRROR, GLASS, OPAQUE, LIGHT = 0, 1, 2, 3, 4
OFFSET = 5e-6


@lean(forceinline=True)
def hit_point(corners, a, b, c):
    """The point with weights a, b, c of the corners."""
    return (
        a * corners[0, 0] + b * corners[1, 0] + c * corners[2, 0],
        a * corners[0, 1] + b * corners[1, 1] + c * corners[2, 1],
        a * corners[0, 2] + b * corners[1, 2] + c * corners[2, 2],
    )


@lean(forceinline=True)
def unit(x, y, z):
    """The vector with length 1."""
    length = max(math.sqrt(x * x + y * y + z * z), 1e-30)
    return x / length, y / length, z / length


@lean(forceinline=True)
def face_normal(corners):
    """Unit normal of a triangle, on the side from which its corners run anticlockwise."""
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
    return unit(u_y * v_z - u_z * v_y, u_z * v_x - u_x * v_z, u_x * v_y - u_y * v_x)


@lean(forceinline=True)
def lifted(p_x, p_y, p_z, n_x, n_y, n_z):
    """The point a little off a surface along n, so that rounding does not put it behind the surface."""
    step = OFFSET * max(abs(p_x), abs(p_y), abs(p_z), 1e-3)
    return p_x + step * n_x, p_y + step * n_y, p_z + step * n_z


@lean(forceinline=True)
def texture_value(materials, texture, u, v):
    """Bilinear linear value of a texture that repeats."""
    first, height, width = (
        materials.texture_sizes[texture, 0],
        materials.texture_sizes[texture, 1],
        materials.texture_sizes[texture, 2],
    )
    texels = materials.texels_linear
    x, y = (u - math.floor(u)) * width - 0.5, (v - math.floor(v)) * height - 0.5
    i, j = math.floor(x), math.floor(y)
    x, y = x - i, y - j
    left, right = int(i) % width, (int(i) + 1) % width
    high, low = int(j) % height, (int(j) + 1) % height
    a, b = first + high * width + left, first + high * width + right
    c, d = first + low * width + left, first + low * width + right
    w_a, w_b, w_c, w_d = (1.0 - x) * (1.0 - y), x * (1.0 - y), (1.0 - x) * y, x * y
    return (
        w_a * texels[a, 0] + w_b * texels[b, 0] + w_c * texels[c, 0] + w_d * texels[d, 0],
        w_a * texels[a, 1] + w_b * texels[b, 1] + w_c * texels[c, 1] + w_d * texels[d, 1],
        w_a * texels[a, 2] + w_b * texels[b, 2] + w_c * texels[c, 2] + w_d * texels[d, 2],
    )


@lean(forceinline=True)
def material_at(materials, m, u, v):
    """Base colour, metallic and roughness of material ``m`` at texture coordinates."""
    red, green, blue = (
        materials.colours_linear[m, 0],
        materials.colours_linear[m, 1],
        materials.colours_linear[m, 2],
    )
    metallic, roughness = materials.metallic[m], materials.roughness[m]
    texture = materials.colour_textures[m]
    if texture >= 0:
        t_r, t_g, t_b = texture_value(materials, texture, u, v)
        red, green, blue = red * t_r, green * t_g, blue * t_b
    texture = materials.metallic_roughness_textures[m]
    if texture >= 0:
        _, t_g, t_b = texture_value(materials, texture, u, v)
        roughness, metallic = roughness * t_g, metallic * t_b
    return red, green, blue, metallic, roughness


@lean(forceinline=True)
def shading_normal(normals, a, b, c, n_x, n_y, n_z, d_x, d_y, d_z):
    """The interpolated normal on the side of n; n itself where the viewer would see it from behind."""
    s_x, s_y, s_z = hit_point(normals, a, b, c)
    s_x, s_y, s_z = unit(s_x, s_y, s_z)
    if s_x * n_x + s_y * n_y + s_z * n_z < 0.0:
        s_x, s_y, s_z = -s_x, -s_y, -s_z
    if s_x * d_x + s_y * d_y + s_z * d_z > -1e-4:
        return n_x, n_y, n_z
    return s_x, s_y, s_z


@lean(forceinline=True)
def reflected(d_x, d_y, d_z, n_x, n_y, n_z):
    """The direction d after a mirror with the normal n."""
    twice = 2.0 * (d_x * n_x + d_y * n_y + d_z * n_z)
    return d_x - twice * n_x, d_y - twice * n_y, d_z - twice * n_z

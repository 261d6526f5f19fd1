"""A path at a surface that scatters: what one light sends to it, and the direction in which it goes on.

The two ways in which light is found are joined by multiple importance sampling with the balance heuristic
("Optimally Combining Sampling Techniques for Monte Carlo Rendering", Veach and Guibas 1995).
"""

import math

from numba import njit

from engine.light.kernels_bsdf import around, opaque_sample, opaque_value
from engine.light.kernels_lights import FAR, pick_light, sample_light
from engine.light.kernels_path import CLEAR, SCATTERED, SHORT_OF_LIGHT, STRAIGHT
from engine.light.kernels_surface import unit


@njit(error_model="numpy")
def scatter(
    k, p, paths, x, y, z, n_x, n_y, n_z, red, green, blue, metallic, roughness, ior, ground, kept,
    mirror, coat, coat_mean, lights, rules, numbers, shadows,
):  # fmt: skip
    """Ask a light, into row ``k`` of ``shadows``, and send path ``p`` on from a point by its material.

    ``numbers`` are six uniform ones: the light, two for a place on it, the lobe, two for the direction.
    """
    d = paths.directions_world[p]
    a_x, a_y, a_z, b_x, b_y, b_z = around(n_x, n_y, n_z)
    o_x = -(d[0] * a_x + d[1] * a_y + d[2] * a_z)
    o_y = -(d[0] * b_x + d[1] * b_y + d[2] * b_z)
    o_z = -(d[0] * n_x + d[1] * n_y + d[2] * n_z)
    l, share = pick_light(lights, x, y, z, numbers[0]) if len(lights.kinds) else (-1, 0.0)
    if l >= 0:
        w_x, w_y, w_z, distance, l_r, l_g, l_b, l_pdf = sample_light(
            lights, l, x, y, z, numbers[1], numbers[2]
        )
        i_z = w_x * n_x + w_y * n_y + w_z * n_z
        if i_z > 0.0 and l_r + l_g + l_b > 0.0:
            f_r, f_g, f_b, pdf = opaque_value(
                o_x, o_y, o_z,
                w_x * a_x + w_y * a_y + w_z * a_z, w_x * b_x + w_y * b_y + w_z * b_z, i_z,
                red, green, blue, metallic, roughness, ior, ground, kept, mirror, coat, coat_mean,
            )  # fmt: skip
            factor = 1.0 / share
            shadows.straight[k] = l_pdf == 0.0
            if l_pdf > 0.0:
                l_pdf *= share
                factor = 1.0 / (l_pdf + pdf) if lights.seen[l] else 1.0 / l_pdf
            w = paths.weights[p]
            l_r, l_g, l_b = w[0] * f_r * l_r * factor, w[1] * f_g * l_g * factor, w[2] * f_b * l_b * factor
            most = max(l_r, l_g, l_b)
            if paths.marks[p] & SCATTERED and most > rules.clamp:
                cut = rules.clamp / most
                l_r, l_g, l_b = l_r * cut, l_g * cut, l_b * cut
            shadows.lit[k, 0], shadows.lit[k, 1], shadows.lit[k, 2] = l_r, l_g, l_b
            shadows.origins_world[k, 0], shadows.origins_world[k, 1], shadows.origins_world[k, 2] = x, y, z
            shadows.directions_world[k, 0] = w_x
            shadows.directions_world[k, 1] = w_y
            shadows.directions_world[k, 2] = w_z
            shadows.t_max[k] = distance * SHORT_OF_LIGHT if distance < FAR else math.inf
    i_x, i_y, i_z = opaque_sample(
        o_x, o_y, o_z, red, green, blue, metallic, roughness, coat, numbers[3], numbers[4], numbers[5]
    )
    f_r, f_g, f_b, pdf = opaque_value(
        o_x, o_y, o_z, i_x, i_y, i_z, red, green, blue, metallic, roughness, ior, ground, kept,
        mirror, coat, coat_mean,
    )  # fmt: skip
    if not pdf > 0.0 or f_r + f_g + f_b <= 0.0:
        paths.alive[p] = False
        return
    paths.weights[p, 0] *= f_r / pdf
    paths.weights[p, 1] *= f_g / pdf
    paths.weights[p, 2] *= f_b / pdf
    paths.marks[p] = (paths.marks[p] | SCATTERED) & ~(CLEAR | STRAIGHT)
    w_x, w_y, w_z = unit(
        i_x * a_x + i_y * b_x + i_z * n_x,
        i_x * a_y + i_y * b_y + i_z * n_y,
        i_x * a_z + i_y * b_z + i_z * n_z,
    )
    paths.origins_world[p, 0], paths.origins_world[p, 1], paths.origins_world[p, 2] = x, y, z
    paths.directions_world[p, 0], paths.directions_world[p, 1], paths.directions_world[p, 2] = w_x, w_y, w_z
    paths.densities[p] = pdf

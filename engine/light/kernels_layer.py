"""Gaussians on a ray: the layer that they are in front of what the ray meets.

How display colours and linear light meet. The trained colours of Gaussians are display values and are
composited as such, into one layer of premultiplied colour g and transmittance T for each ray.

- On the camera's own ray, and on as long as mirrors and glass pass on all of it in one direction, layers are
  composited with each other and over what is behind them in display values: g + T encode(L), L the mean
  linear radiance of what is behind.
- On any other ray a layer sends the linear radiance (1 - T) decode(g / (1 - T)) and lets T of the linear
  light behind it through. Where such a ray comes straight from a mirror or from glass and ends in the
  surroundings, what is behind the layer is known, and the radiance is decode(g + T encode(L)) as for the
  camera.
"""

import math

from octasplat.engine.compilation import kernel
from octasplat.engine.light.arrays import PAIRS_OF_SURFACE
from octasplat.engine.light.kernels_lights import FAR, adding_share, pick_light, sample_light
from octasplat.engine.light.kernels_path import ENDED, PAIRS_OF_CAMERA, add_radiance, beyond
from octasplat.engine.light.kernels_random import uniform_pair
from octasplat.engine.light.kernels_scatter import CLEAR, LAYER_PLACE, PICK, SHORT_OF_LIGHT
from octasplat.engine.light.kernels_surface import unit
from octasplat.engine.trace.kernels_native import lean

NOTHING = 1e-6
ONE_SURFACE = 0.05
SHADOWED, RELIT, AMBIENT = 0, 1, 2
"""Features of Gaussians: share that shadows take, share that is relit, and that times its ambient part."""


@lean(forceinline=True)
def encode(linear):
    """The display value of a linear one (IEC 61966-2-1), also beyond 1."""
    if linear <= 0.0031308:
        return 12.92 * max(linear, 0.0)
    return 1.055 * linear ** (1.0 / 2.4) - 0.055


@lean(forceinline=True)
def decode(display):
    """The linear value of a display value, also beyond 1."""
    if display <= 0.04045:
        return max(display, 0.0) / 12.92
    return ((display + 0.055) / 1.055) ** 2.4


@kernel(_nrt=False, error_model="numpy")
def meet_layers(
    first, last, scratch, paths, active, depth, distances, faces,
    rgb, transmittance, depth_median, depth_sum, normals, features,
    lights, environment, rules, absorption, spent_below, shadows,
):  # fmt: skip
    """Put the layers of Gaussians in front of the surfaces ``faces`` onto the paths ``active``.

    ``shadows`` gets what the layers ask of lights. A ray of which less than ``spent_below`` is left ends: its
    face becomes :data:`ENDED`.
    """
    for k in range(first, last):
        p = active[k]
        for channel in range(3):
            shadows.lit[k, channel] = shadows.lost[k, channel] = 0.0
        left = float(transmittance[k])
        share = 1.0 - left
        if share <= NOTHING:
            continue
        d, o = paths.directions_world[p], paths.origins_world[p]
        clear = paths.marks[p] & CLEAR != 0
        shadowed, relit = features[k, SHADOWED] / share, features[k, RELIT] / share
        base = 1.0 - relit + features[k, AMBIENT] / share
        # The mean distance is smoother than the median, but lies in the air where the layer is two surfaces.
        distance = depth_sum[k] / share
        if abs(distance - depth_median[k]) > ONE_SURFACE * depth_median[k] and depth_median[k] > 0.0:
            distance = depth_median[k]
        b_r, b_g, b_b = beyond(lights, environment, rules, paths.marks[p], d[0], d[1], d[2])
        # --- what one unit of the layer's light counts, and how its colour is lit ---
        if clear:
            g_r = g_g = g_b = paths.transmittance[p] * share
        else:
            w = paths.weights[p]
            g_r = w[0] * share * decode(rgb[k, 0] / share)
            g_g = w[1] * share * decode(rgb[k, 1] / share)
            g_b = w[2] * share * decode(rgb[k, 2] / share)
            if paths.inside[p] >= 0:
                medium = absorption[paths.inside[p]]
                g_r *= math.exp(-medium[0] * distance)
                g_g *= math.exp(-medium[1] * distance)
                g_b *= math.exp(-medium[2] * distance)
        lit_by_stage = shadowed > NOTHING or relit > NOTHING
        if lit_by_stage and len(lights.kinds):
            x, y, z = o[0] + distance * d[0], o[1] + distance * d[1], o[2] + distance * d[2]
            first_pair = PAIRS_OF_CAMERA + depth * PAIRS_OF_SURFACE
            _, pick = uniform_pair(paths.keys[p], paths.samples[p], first_pair + PICK)
            l, chance = pick_light(lights, x, y, z, pick)
            if l >= 0:
                u, v = uniform_pair(paths.keys[p], paths.samples[p], first_pair + LAYER_PLACE)
                w_x, w_y, w_z, reach, l_r, l_g, l_b, pdf = sample_light(lights, l, x, y, z, u, v)
                n_x, n_y, n_z = unit(normals[k, 0], normals[k, 1], normals[k, 2])
                cosine = max(n_x * w_x + n_y * w_y + n_z * w_z, 0.0)
                taking = relit + (shadowed if lights.adds[l] else 0.0)
                factor = taking * cosine / (math.pi * chance * (pdf if pdf > 0.0 else 1.0))
                shadows.lit[k, 0] = g_r * l_r * factor
                shadows.lit[k, 1] = g_g * l_g * factor
                shadows.lit[k, 2] = g_b * l_b * factor
                if shadowed > NOTHING and not lights.adds[l]:
                    # Only among the lights that take something is the shadow a mean.
                    losing = shadowed / max(1.0 - adding_share(lights, x, y, z), 1e-6)
                    shadows.lost[k, 0] = -g_r * losing
                    shadows.lost[k, 1] = -g_g * losing
                    shadows.lost[k, 2] = -g_b * losing
                shadows.origins_world[k, 0], shadows.origins_world[k, 1], shadows.origins_world[k, 2] = (
                    x,
                    y,
                    z,
                )
                shadows.directions_world[k, 0] = w_x
                shadows.directions_world[k, 1] = w_y
                shadows.directions_world[k, 2] = w_z
                shadows.straight[k] = True
                shadows.t_max[k] = reach * SHORT_OF_LIGHT if reach < FAR else math.inf
        if clear:
            for channel in range(3):
                paths.layer_srgb[p, channel] += paths.transmittance[p] * rgb[k, channel]
            paths.shade[p, 0] += g_r * base
            paths.shade[p, 1] += g_g * base
            paths.shade[p, 2] += g_b * base
            paths.transmittance[p] *= left
            if paths.transmittance[p] < spent_below:
                paths.radiance_linear[p, 0] = b_r
                paths.radiance_linear[p, 1] = b_g
                paths.radiance_linear[p, 2] = b_b
                paths.alive[p], faces[k] = False, ENDED
            continue
        known = faces[k] < 0 and paths.densities[p] == 0.0 and not lit_by_stage and paths.inside[p] < 0
        if known:
            w = paths.weights[p]
            add_radiance(
                paths, p,
                w[0] * (decode(rgb[k, 0] + left * encode(b_r)) - left * b_r),
                w[1] * (decode(rgb[k, 1] + left * encode(b_g)) - left * b_g),
                w[2] * (decode(rgb[k, 2] + left * encode(b_b)) - left * b_b),
                rules.clamp,
            )  # fmt: skip
        else:
            add_radiance(paths, p, g_r * base, g_g * base, g_b * base, rules.clamp)
        for channel in range(3):
            paths.weights[p, channel] *= left
        if left < spent_below:
            paths.alive[p], faces[k] = False, ENDED


@kernel(_nrt=False, error_model="numpy")
def add_layer_light(first, last, scratch, paths, active, lit, lost, free, through_casters, through_others):
    """Add what shadow rays of layers brought.

    ``free`` is the share in each channel that meshes let through, ``through_casters`` and ``through_others``
    are transmittances of the Gaussians that cast shadows on Gaussians and of those that do not.
    """
    for k in range(first, last):
        p = active[k]
        for channel in range(3):
            reached = free[k, channel] * through_casters[k]
            taken = through_others[k] * (1.0 - reached)
            amount = lit[k, channel] * reached + lost[k, channel] * taken
            if paths.marks[p] & CLEAR:
                paths.shade[p, channel] += amount
            else:
                paths.radiance_linear[p, channel] += amount

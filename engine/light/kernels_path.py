"""Paths at surfaces: light that reaches the point from lights, and the way on by the surface's material.

The radiance that is carried is basic radiance (over the square of the index of refraction), so that nothing
changes by entering glass and coming out again. Each kernel does the rows ``first`` to ``last``, so that
several threads can share the work.
"""

import math

from octasplat.engine.compilation import kernel
from octasplat.engine.light.arrays import BLOCK, PAIRS_OF_SURFACE
from octasplat.engine.light.kernels_bsdf import around, fresnel_dielectric
from octasplat.engine.light.kernels_frosted import LEAST_FROST, frosted_sample, frosted_value
from octasplat.engine.light.kernels_lights import (
    emitted,
    environment_density,
    environment_radiance,
    light_share,
    pick_light,
    sample_light,
    seen_density,
)
from octasplat.engine.light.kernels_random import fill_pairs, pixel_key
from octasplat.engine.light.kernels_scatter import (
    CHOICE,
    CLEAR,
    DIRECTION,
    PICK,
    PLACE,
    SCATTERED,
    STRAIGHT,
    ask,
    leave,
    scatter,
)
from octasplat.engine.light.kernels_surface import (
    DIFFUSE,
    GLASS,
    LIGHT,
    MIRROR,
    bumped_normal,
    face_normal,
    hit_point,
    lifted,
    material_at,
    reflected,
    shading_normal,
    unit,
    vertex_colour,
)
from octasplat.engine.shading.kernels_microfacets import table_value
from octasplat.engine.trace.kernels_native import lean

ENDED = -2
"""In place of a face: the ray ended in front of what it would have met."""
PAIRS_OF_CAMERA = 2


@lean(forceinline=True)
def _camera_numbers(scratch, rules, first_pixel, per_pixel, first_sample, order, place, number, count):
    """Keys, sample numbers and the camera's uniform numbers of ``count`` paths, at most a block of them."""
    count = min(count, BLOCK)
    key = pixel_key(rules.seed, order[first_pixel + place])
    for n in range(count):
        if number == per_pixel:
            place, number = place + 1, 0
            key = pixel_key(rules.seed, order[first_pixel + place])
        scratch.keys[n], scratch.samples[n] = key, first_sample + number
        number += 1
    fill_pairs(scratch.keys, scratch.samples, count, 0, scratch.numbers[:PAIRS_OF_CAMERA])


@kernel(_nrt=False, error_model="numpy")
def start_paths(first, last, scratch, view, rules, first_pixel, per_pixel, first_sample, order, paths):
    """Paths of pixels ``order[first_pixel]`` and on, ``per_pixel`` to each, numbered from ``first_sample``.

    Beside a pixel's centre the direction follows the slopes between the neighbours, which is right for any
    lens to the second order in a pixel.
    """
    height, width, _ = view.directions_world.shape
    across_x, across_y, across_z, up_x, up_y, up_z = around(view.axis[0], view.axis[1], view.axis[2])
    numbers = scratch.numbers
    place, number = first // per_pixel, first % per_pixel - 1
    pixel = order[first_pixel + place]
    y, x = pixel // width, pixel % width
    for k in range(first, last):
        n = (k - first) % BLOCK
        number += 1
        if number == per_pixel:
            place, number = place + 1, 0
        if n == 0:
            _camera_numbers(
                scratch, rules, first_pixel, per_pixel, first_sample, order, place, number, last - k
            )
        if n == 0 or number == 0:
            pixel = order[first_pixel + place]
            y, x = pixel // width, pixel % width
        paths.keys[k], paths.samples[k] = scratch.keys[n], scratch.samples[n]
        centre = view.directions_world[y, x]
        d_x, d_y, d_z = float(centre[0]), float(centre[1]), float(centre[2])
        if rules.anti_aliasing:
            u, v = numbers[0, 0, n], numbers[0, 1, n]
            left, right = max(x - 1, 0), min(x + 1, width - 1)
            high, low = max(y - 1, 0), min(y + 1, height - 1)
            along = (u - 0.5) / max(right - left, 1)
            down = (v - 0.5) / max(low - high, 1)
            a, b = view.directions_world[y, left], view.directions_world[y, right]
            c, d = view.directions_world[high, x], view.directions_world[low, x]
            d_x += along * (b[0] - a[0]) + down * (d[0] - c[0])
            d_y += along * (b[1] - a[1]) + down * (d[1] - c[1])
            d_z += along * (b[2] - a[2]) + down * (d[2] - c[2])
            d_x, d_y, d_z = unit(d_x, d_y, d_z)
        o_x, o_y, o_z = view.origin_world[0], view.origin_world[1], view.origin_world[2]
        if view.aperture > 0.0:
            u, v = numbers[1, 0, n], numbers[1, 1, n]
            radius, angle = 0.5 * view.aperture * math.sqrt(u), 2.0 * math.pi * v
            a, b = radius * math.cos(angle), radius * math.sin(angle)
            l_x, l_y, l_z = a * across_x + b * up_x, a * across_y + b * up_y, a * across_z + b * up_z
            forward = d_x * view.axis[0] + d_y * view.axis[1] + d_z * view.axis[2]
            t = view.focus_distance / max(forward, 1e-6)
            o_x, o_y, o_z = o_x + l_x, o_y + l_y, o_z + l_z
            d_x, d_y, d_z = unit(t * d_x - l_x, t * d_y - l_y, t * d_z - l_z)
        paths.origins_world[k, 0], paths.origins_world[k, 1], paths.origins_world[k, 2] = o_x, o_y, o_z
        paths.directions_world[k, 0], paths.directions_world[k, 1], paths.directions_world[k, 2] = (
            d_x,
            d_y,
            d_z,
        )
        for channel in range(3):
            paths.weights[k, channel], paths.radiance_linear[k, channel] = 1.0, 0.0
            paths.layer_srgb[k, channel], paths.shade[k, channel] = 0.0, 0.0
            paths.albedo_linear[k, channel], paths.normals_world[k, channel] = 0.0, 0.0
        paths.transmittance[k], paths.coverage[k], paths.things[k] = 1.0, 1.0, 0.0
        paths.densities[k], paths.viewers[k], paths.inside[k] = 0.0, 0.0, -1
        paths.marks[k], paths.alive[k] = CLEAR | STRAIGHT, True


@lean(forceinline=True)
def beyond(lights, environment, rules, marks, d_x, d_y, d_z):
    """Linear radiance from behind everything; ``environment`` is the number of that light or -1."""
    if environment >= 0 and (rules.environment_visible or not marks & STRAIGHT):
        return environment_radiance(lights, d_x, d_y, d_z)
    background = rules.background_linear
    return background[0], background[1], background[2]


@lean(forceinline=True)
def add_radiance(paths, p, red, green, blue, clamp):
    """Add light to a path, no more than ``clamp`` of it where it comes by way of scattering."""
    if paths.marks[p] & SCATTERED:
        most = max(red, green, blue)
        if most > clamp:
            red, green, blue = red * clamp / most, green * clamp / most, blue * clamp / most
    paths.radiance_linear[p, 0] += red
    paths.radiance_linear[p, 1] += green
    paths.radiance_linear[p, 2] += blue


@lean(forceinline=True)
def _miss(paths, p, lights, environment, rules):
    """A path ends behind everything."""
    d = paths.directions_world[p]
    red, green, blue = beyond(lights, environment, rules, paths.marks[p], d[0], d[1], d[2])
    share = 1.0
    if environment >= 0 and paths.densities[p] > 0.0:
        o = paths.origins_world[p]
        pdf = light_share(lights, environment, o[0], o[1], o[2]) * environment_density(
            lights, d[0], d[1], d[2]
        )
        share = paths.densities[p] / (paths.densities[p] + pdf)
    if paths.marks[p] & STRAIGHT and not (environment >= 0 and rules.environment_visible):
        paths.coverage[p] = 1.0 - paths.transmittance[p]
    w = paths.weights[p]
    add_radiance(paths, p, share * w[0] * red, share * w[1] * green, share * w[2] * blue, rules.clamp)


@lean(forceinline=True)
def _light_seen(paths, p, lights, l, distance, facing, u, v, rules):
    """A path meets a shining surface; ``facing`` is the cosine to its front, (u, v) the place on a mesh."""
    if facing <= 0.0:
        return
    share = 1.0
    if paths.densities[p] > 0.0:
        o = paths.origins_world[p]
        pdf = light_share(lights, l, o[0], o[1], o[2]) * seen_density(lights, l, o, distance, facing)
        share = paths.densities[p] / (paths.densities[p] + pdf)
    w = paths.weights[p]
    red, green, blue = emitted(lights, l, u, v)
    add_radiance(paths, p, share * w[0] * red, share * w[1] * green, share * w[2] * blue, rules.clamp)


@lean(forceinline=True)
def _mirror(paths, p, x, y, z, n_x, n_y, n_z, s_x, s_y, s_z, red, green, blue):
    """Reflect a path."""
    d = paths.directions_world[p]
    r_x, r_y, r_z = reflected(d[0], d[1], d[2], s_x, s_y, s_z)
    if r_x * n_x + r_y * n_y + r_z * n_z <= 0.0:
        r_x, r_y, r_z = reflected(d[0], d[1], d[2], n_x, n_y, n_z)
    if red != 1.0 or green != 1.0 or blue != 1.0:
        paths.marks[p] &= ~CLEAR
    paths.marks[p] &= ~STRAIGHT
    paths.weights[p, 0] *= red
    paths.weights[p, 1] *= green
    paths.weights[p, 2] *= blue
    x, y, z = lifted(x, y, z, n_x, n_y, n_z)
    leave(paths, p, x, y, z, r_x, r_y, r_z, 0.0)


@lean(forceinline=True)
def _glass(paths, p, materials, m, entering, x, y, z, n_x, n_y, n_z, s_x, s_y, s_z, choice):
    """Reflect a path at glass or let it through, by chance as Fresnel says."""
    d = paths.directions_world[p]
    eta = materials.iors[m] if entering else 1.0 / materials.iors[m]
    cosine = -(d[0] * s_x + d[1] * s_y + d[2] * s_z)
    share, cos_t = fresnel_dielectric(min(cosine, 1.0), eta)
    if share < 1.0 and eta != 1.0:
        paths.marks[p] &= ~CLEAR
    if eta != 1.0 and choice < share:
        _mirror(paths, p, x, y, z, n_x, n_y, n_z, s_x, s_y, s_z, 1.0, 1.0, 1.0)
        return
    tint = materials.colours_linear[m]
    plain = tint[0] == 1.0 and tint[1] == 1.0 and tint[2] == 1.0
    absorbs = materials.absorption[m, 0] + materials.absorption[m, 1] + materials.absorption[m, 2] > 0.0
    if not plain or absorbs:
        paths.marks[p] &= ~CLEAR
    for channel in range(3):
        paths.weights[p, channel] *= tint[channel]
    t_x, t_y, t_z = float(d[0]), float(d[1]), float(d[2])
    if eta != 1.0:
        paths.marks[p] &= ~STRAIGHT
        along = cosine / eta - cos_t
        t_x, t_y, t_z = unit(t_x / eta + along * s_x, t_y / eta + along * s_y, t_z / eta + along * s_z)
    paths.inside[p] = m if entering else -1
    x, y, z = lifted(x, y, z, -n_x, -n_y, -n_z)
    leave(paths, p, x, y, z, t_x, t_y, t_z, 0.0)


@lean(forceinline=True)
def _fill_numbers(scratch, paths, active, faces, first, last, first_pair):
    """The uniform numbers of those of the rows ``first`` to ``last``, at most a block, that meet a face."""
    count = 0
    for k in range(first, last):
        if faces[k] >= 0:
            p = active[k]
            scratch.keys[count], scratch.samples[count] = paths.keys[p], paths.samples[p]
            count += 1
    fill_pairs(scratch.keys, scratch.samples, count, first_pair, scratch.numbers)


@lean(forceinline=True)
def _guide(paths, p, red, green, blue, n_x, n_y, n_z):
    """Note colour and normal of the first mesh that the camera's ray meets, as far as it is seen."""
    share = paths.things[p]
    paths.albedo_linear[p, 0] = share * red
    paths.albedo_linear[p, 1] = share * green
    paths.albedo_linear[p, 2] = share * blue
    paths.normals_world[p, 0] = share * n_x
    paths.normals_world[p, 1] = share * n_y
    paths.normals_world[p, 2] = share * n_z


@lean()
def _frosted_glass(
    paths, p, k, materials, m, entering, x, y, z, n_x, n_y, n_z, s_x, s_y, s_z, choice,
    lights, rules, shadows, numbers, n,
):  # fmt: skip
    """What lights send to rough glass, and a way on that its facets reflect or refract."""
    d = paths.directions_world[p]
    eta = materials.iors[m] if entering else 1.0 / materials.iors[m]
    tint, roughness = materials.colours_linear[m], materials.roughness[m]
    alpha = roughness * roughness
    a_x, a_y, a_z, b_x, b_y, b_z = around(s_x, s_y, s_z)
    o_x = -(d[0] * a_x + d[1] * a_y + d[2] * a_z)
    o_y = -(d[0] * b_x + d[1] * b_y + d[2] * b_z)
    o_z = -(d[0] * s_x + d[1] * s_y + d[2] * s_z)
    gain = 1.0
    if materials.kept[m]:
        gain = 1.0 / table_value(materials.coat[materials.coats[m] + (0 if entering else 1)], o_z, roughness)
    front_x, front_y, front_z = lifted(x, y, z, n_x, n_y, n_z)
    back_x, back_y, back_z = lifted(x, y, z, -n_x, -n_y, -n_z)
    w = paths.weights[p]
    clamp = rules.clamp if paths.marks[p] & SCATTERED else math.inf
    if len(lights.kinds):
        l, share = pick_light(lights, x, y, z, numbers[PICK, 0, n])
        if l >= 0:
            u, v = numbers[PLACE, 0, n], numbers[PLACE, 1, n]
            w_x, w_y, w_z, distance, l_r, l_g, l_b, l_pdf = sample_light(lights, l, x, y, z, u, v)
            i_z = w_x * s_x + w_y * s_y + w_z * s_z
            if i_z * (w_x * n_x + w_y * n_y + w_z * n_z) > 0.0 and l_r + l_g + l_b > 0.0:
                value, pdf = frosted_value(
                    o_x, o_y, o_z,
                    w_x * a_x + w_y * a_y + w_z * a_z, w_x * b_x + w_y * b_y + w_z * b_z, i_z, eta, alpha,
                )  # fmt: skip
                factor = gain * value / share
                shadows.straight[k] = l_pdf == 0.0
                if l_pdf > 0.0:
                    l_pdf *= share
                    factor = gain * value / (l_pdf + pdf if lights.seen[l] else l_pdf)
                if value > 0.0:
                    through = i_z < 0.0
                    ask(
                        shadows, k,
                        back_x if through else front_x, back_y if through else front_y,
                        back_z if through else front_z, w_x, w_y, w_z, distance,
                        w[0] * l_r * factor * (tint[0] if through else 1.0),
                        w[1] * l_g * factor * (tint[1] if through else 1.0),
                        w[2] * l_b * factor * (tint[2] if through else 1.0), clamp,
                    )  # fmt: skip
    u, v = numbers[DIRECTION, 0, n], numbers[DIRECTION, 1, n]
    i_x, i_y, i_z = frosted_sample(o_x, o_y, o_z, eta, alpha, choice, u, v)
    value, pdf = frosted_value(o_x, o_y, o_z, i_x, i_y, i_z, eta, alpha)
    w_x = i_x * a_x + i_y * b_x + i_z * s_x
    w_y = i_x * a_y + i_y * b_y + i_z * s_y
    w_z = i_x * a_z + i_y * b_z + i_z * s_z
    if not pdf > 0.0 or i_z * (w_x * n_x + w_y * n_y + w_z * n_z) <= 0.0:
        paths.alive[p] = False
        return
    through = i_z < 0.0
    for channel in range(3):
        paths.weights[p, channel] *= gain * value / pdf * (tint[channel] if through else 1.0)
    paths.marks[p] = (paths.marks[p] | SCATTERED) & ~(CLEAR | STRAIGHT)
    w_x, w_y, w_z = unit(w_x, w_y, w_z)
    if through:
        paths.inside[p] = m if entering else -1
        leave(paths, p, back_x, back_y, back_z, w_x, w_y, w_z, pdf)
    else:
        leave(paths, p, front_x, front_y, front_z, w_x, w_y, w_z, pdf)


@kernel(_nrt=False, error_model="numpy")
def meet_surfaces(
    first,
    last,
    scratch,
    paths,
    active,
    depth,
    distances,
    faces,
    barycentrics,
    surfaces,
    materials,
    lights,
    environment,
    rules,
    shadows,
):
    """What the paths ``active`` find at the end of their rays; ``depth`` counts the surfaces met before.

    Adds light that they run into, turns them to where they go on, and writes what they ask of lights into
    ``shadows``, a row a ray. Paths that end are not alive any more.
    """
    numbers = scratch.numbers
    first_pair = PAIRS_OF_CAMERA + depth * PAIRS_OF_SURFACE
    n = 0
    for k in range(first, last):
        if (k - first) % BLOCK == 0:
            _fill_numbers(scratch, paths, active, faces, k, min(k + BLOCK, last), first_pair)
            n = -1
        p = active[k]
        face = faces[k]
        shadows.lit[k, 0] = shadows.lit[k, 1] = shadows.lit[k, 2] = 0.0
        if face == ENDED:
            continue
        if face < 0:
            _miss(paths, p, lights, environment, rules)
            paths.alive[p] = False
            continue
        n += 1
        d = paths.directions_world[p]
        b, c = float(barycentrics[k, 0]), float(barycentrics[k, 1])
        a = 1.0 - b - c
        n_x, n_y, n_z = face_normal(surfaces.corners_world[face])
        facing = -(d[0] * n_x + d[1] * n_y + d[2] * n_z)
        m = surfaces.materials[face]
        kind = materials.kinds[m]
        if paths.inside[p] >= 0:
            medium = materials.absorption[paths.inside[p]]
            for channel in range(3):
                paths.weights[p, channel] *= math.exp(-medium[channel] * distances[k])
        first_thing = paths.marks[p] & STRAIGHT != 0 and paths.things[p] == 0.0
        if first_thing:
            paths.things[p] = paths.transmittance[p]
            _guide(paths, p, 1.0, 1.0, 1.0, n_x, n_y, n_z)
        uv = surfaces.corner_uv[face]
        u_t = a * uv[0, 0] + b * uv[1, 0] + c * uv[2, 0]
        v_t = a * uv[0, 1] + b * uv[1, 1] + c * uv[2, 1]
        if kind == LIGHT:
            _light_seen(paths, p, lights, materials.lights[m], distances[k], facing, 0.0, 0.0, rules)
        elif materials.lights[m] >= 0:
            _light_seen(paths, p, lights, materials.lights[m], distances[k], abs(facing), u_t, v_t, rules)
        if kind == LIGHT or depth >= rules.max_depth:
            paths.alive[p] = False
            continue
        x, y, z = hit_point(surfaces.corners_world[face], a, b, c)
        if facing < 0.0:
            n_x, n_y, n_z = -n_x, -n_y, -n_z
        s_x, s_y, s_z = shading_normal(
            surfaces.corner_normals[face], a, b, c, n_x, n_y, n_z, d[0], d[1], d[2]
        )
        if first_thing:
            _guide(paths, p, 1.0, 1.0, 1.0, s_x, s_y, s_z)
        choice, roulette = numbers[CHOICE, 0, n], numbers[CHOICE, 1, n]
        if depth >= rules.roulette_depth:
            w = paths.weights[p]
            stay = min(max(w[0], w[1], w[2]), 0.95)
            if roulette >= stay:
                paths.alive[p] = False
                continue
            for channel in range(3):
                paths.weights[p, channel] /= stay
        if kind == GLASS and materials.roughness[m] >= LEAST_FROST and materials.iors[m] != 1.0:
            _frosted_glass(
                paths, p, k, materials, m, facing >= 0.0, x, y, z, n_x, n_y, n_z, s_x, s_y, s_z, choice,
                lights, rules, shadows, numbers, n,
            )  # fmt: skip
            continue
        if kind == GLASS:
            _glass(paths, p, materials, m, facing >= 0.0, x, y, z, n_x, n_y, n_z, s_x, s_y, s_z, choice)
            continue
        red, green, blue, metallic, roughness = material_at(materials, m, u_t, v_t)
        if materials.tinted[m]:
            t_r, t_g, t_b = vertex_colour(surfaces, face, a, b, c)
            red, green, blue = red * t_r, green * t_g, blue * t_b
        if kind == MIRROR:
            _mirror(paths, p, x, y, z, n_x, n_y, n_z, s_x, s_y, s_z, red, green, blue)
            continue
        x, y, z = lifted(x, y, z, n_x, n_y, n_z)
        s_x, s_y, s_z = bumped_normal(
            materials, m, surfaces.corners_world[face], uv, u_t, v_t,
            n_x, n_y, n_z, s_x, s_y, s_z, d[0], d[1], d[2],
        )  # fmt: skip
        if first_thing:
            _guide(paths, p, red, green, blue, s_x, s_y, s_z)
        scatter(
            k, p, n, numbers, paths, kind == DIFFUSE, x, y, z, n_x, n_y, n_z, s_x, s_y, s_z,
            red, green, blue, metallic, roughness,
            materials.iors[m], materials.grounds[m], materials.kept[m] != 0,
            materials.mirror, materials.coat[materials.coats[m]], materials.coat_means[materials.coats[m]],
            lights, rules, shadows,
        )  # fmt: skip


@kernel(_nrt=False, error_model="numpy")
def add_lit(first, last, scratch, paths, active, lit, share):
    """Add what shadow rays brought: ``lit`` times the share of it that got through."""
    for k in range(first, last):
        if share[k, 0] + share[k, 1] + share[k, 2] > 0.0:
            for channel in range(3):
                paths.radiance_linear[active[k], channel] += lit[k, channel] * share[k, channel]

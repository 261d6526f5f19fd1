"""Gaussians with materials on a ray: a surface that scatters light as a mesh of that material would.

What a ray sees of them is one surface, where half of its light is gone: their mean albedo, metallic,
roughness and normal, weighted as the tracer composites. A path meets it with the probability of its coverage,
and else goes on to what is behind; so no light is counted twice, and rays of all kinds see the same.
"""

import math

from octasplat.engine.compilation import kernel
from octasplat.engine.light.kernels_bsdf import BURLEY
from octasplat.engine.light.kernels_layer import NOTHING
from octasplat.engine.light.kernels_path import ENDED
from octasplat.engine.light.kernels_random import pixel_key, uniform_pair
from octasplat.engine.light.kernels_scatter import CHOICE, DIRECTION, FRONT, PICK, PLACE, STRAIGHT, scatter
from octasplat.engine.light.kernels_surface import unit
from octasplat.engine.trace.kernels_native import lean

MATERIAL, ALBEDO, METALLIC, ROUGHNESS, LIFT = 3, 4, 7, 8, 9
"""Features of Gaussians behind those of :mod:`octasplat.engine.light.kernels_layer`.

Whether they have a material, this, and how far off their surface rays begin, world units.
"""
COLUMNS = 10
IOR = 1.5
"""Of what is no metal: it reflects 0.04 head-on."""
FIRST_PAIR, PAIRS = 1 << 12, 5
"""Pairs of numbers of these surfaces, apart from those of meshes."""


@lean(forceinline=True)
def _draw(paths, p, pair, numbers):
    """The numbers of :func:`scatter`, into the first column."""
    key, sample = paths.keys[p], paths.samples[p]
    for place in (CHOICE, DIRECTION, PICK, PLACE):
        numbers[place, 0, 0], numbers[place, 1, 0] = uniform_pair(key, sample, pair + place)


@kernel(_nrt=False, error_model="numpy")
def meet_materials(
    first, last, scratch, paths, active, depth, faces, rgb, transmittance, depth_median, depth_sum, normals,
    features, materials, lights, rules, spent_below, shadows,
):  # fmt: skip
    """Let paths meet the Gaussians with materials on their rays, or take these away from what was seen.

    A path that meets them goes on from there: its face becomes :data:`ENDED`, and nothing of the layer is
    left. ``shadows`` gets what it asks of lights.
    """
    numbers = scratch.numbers
    for k in range(first, last):
        p = active[k]
        shadows.lit[k, 0] = shadows.lit[k, 1] = shadows.lit[k, 2] = 0.0
        left = float(transmittance[k])
        share = 1.0 - left
        chance = float(features[k, MATERIAL])
        if chance <= NOTHING:
            continue
        if left < spent_below:  # the tracer stopped looking here
            chance /= share
        pair = FIRST_PAIR + depth * PAIRS
        choice, roulette = uniform_pair(paths.keys[p], paths.samples[p], pair)
        if choice >= chance:
            # --- past them: what is left is seen as if they were not there ---
            rest = 1.0 / max(1.0 - chance, NOTHING)
            transmittance[k] = min(left * rest, 1.0)
            for channel in range(3):
                rgb[k, channel] *= rest
                features[k, channel] *= rest
            depth_sum[k] *= rest
            continue
        # Not the mean: the little that shines through to a far side would pull it below the surface.
        distance = depth_median[k] if depth_median[k] > 0.0 else depth_sum[k] / share
        transmittance[k] = 1.0
        faces[k] = ENDED
        if depth >= rules.max_depth:
            paths.alive[p] = False
            continue
        if paths.inside[p] >= 0:
            medium = materials.absorption[paths.inside[p]]
            for channel in range(3):
                paths.weights[p, channel] *= math.exp(-medium[channel] * distance)
        if depth >= rules.roulette_depth:
            w = paths.weights[p]
            stay = min(max(w[0], w[1], w[2]), 0.95)
            if roulette >= stay:
                paths.alive[p] = False
                continue
            for channel in range(3):
                paths.weights[p, channel] /= stay
        if paths.marks[p] & STRAIGHT:
            paths.marks[p] |= FRONT
        _draw(paths, p, pair + 1, numbers)
        o, d = paths.origins_world[p], paths.directions_world[p]
        n_x, n_y, n_z = unit(normals[k, 0], normals[k, 1], normals[k, 2])
        part = 1.0 / float(features[k, MATERIAL])
        lift = features[k, LIFT] * part
        scatter(
            k, p, 0, numbers, paths, False,
            o[0] + distance * d[0] + lift * n_x, o[1] + distance * d[1] + lift * n_y,
            o[2] + distance * d[2] + lift * n_z, n_x, n_y, n_z, n_x, n_y, n_z,
            min(features[k, ALBEDO] * part, 1.0), min(features[k, ALBEDO + 1] * part, 1.0),
            min(features[k, ALBEDO + 2] * part, 1.0), min(features[k, METALLIC] * part, 1.0),
            min(features[k, ROUGHNESS] * part, 1.0), IOR, BURLEY, False,
            materials.mirror, materials.coat[0], materials.coat_means[0], lights, rules, shadows,
        )  # fmt: skip


@kernel(_nrt=False, error_model="numpy")
def start_at_points(first, last, scratch, at, pixels, samples, rules, materials, lights, paths, shadows):
    """Paths that begin at points of surfaces, as if the camera's rays had met them there."""
    numbers = scratch.numbers
    for k in range(first, last):
        paths.keys[k], paths.samples[k] = pixel_key(rules.seed, pixels[k]), samples[k]
        for channel in range(3):
            paths.directions_world[k, channel] = at.directions_world[k, channel]
            paths.weights[k, channel] = 1.0
            paths.radiance_linear[k, channel] = 0.0
            paths.layer_srgb[k, channel] = 0.0
            paths.shade[k, channel] = 0.0
            paths.albedo_linear[k, channel], paths.normals_world[k, channel] = 0.0, 0.0
            shadows.lit[k, channel] = 0.0
        paths.transmittance[k], paths.coverage[k], paths.things[k] = 1.0, 1.0, 0.0
        paths.densities[k], paths.viewers[k], paths.inside[k] = 0.0, 0.0, -1
        paths.marks[k], paths.alive[k] = FRONT, True
        _draw(paths, k, FIRST_PAIR + 1, numbers)
        point, n, material = at.points_world[k], at.normals_world[k], at.materials[k]
        n_x, n_y, n_z = float(n[0]), float(n[1]), float(n[2])
        scatter(
            k, k, 0, numbers, paths, False, float(point[0]), float(point[1]), float(point[2]),
            n_x, n_y, n_z, n_x, n_y, n_z, float(material[0]), float(material[1]), float(material[2]),
            float(material[3]), float(material[4]), IOR, BURLEY, False,
            materials.mirror, materials.coat[0], materials.coat_means[0], lights, rules, shadows,
        )  # fmt: skip

"""Gaussians with materials on a ray: a surface that scatters light as a mesh of that material would.

What a ray sees of them is one surface, where half of its light is gone: their mean albedo, metallic,
roughness and normal, weighted as the tracer composites. A path meets it with the probability of its coverage,
and else goes on to what is behind; so no light is counted twice, and rays of all kinds see the same.
"""

import math

import numpy as np
from jaxtyping import Float64, Int64

from octasplat.engine.core.compilation import kernel
from octasplat.engine.pathtracing.kernels.camera_paths import reset_paths
from octasplat.engine.pathtracing.kernels.gaussian_layer import MIN_COVERAGE
from octasplat.engine.pathtracing.kernels.kernel_args import (
    AlbedoTables,
    Bsdf,
    IntegratorParameters,
    LayerArrays,
    LightArrays,
    MaterialArrays,
    SurfacePoint,
)
from octasplat.engine.pathtracing.kernels.nested_glass import copy_media
from octasplat.engine.pathtracing.kernels.path_args import (
    PATH_ENDED,
    Bounce,
    LightQuery,
    PathArrays,
    PathSamples,
    PathScratch,
    ShadowRayArrays,
    SurfaceInteractions,
)
from octasplat.engine.pathtracing.kernels.principled_bsdf import BURLEY
from octasplat.engine.pathtracing.kernels.sampler import pixel_key, uniform_pair
from octasplat.engine.pathtracing.kernels.scatter import (
    DIRECTION_SAMPLE,
    FLAG_CAMERA_RAY,
    FLAG_GAUSSIAN_SURFACE,
    LIGHT_CHOICE_SAMPLE,
    LIGHT_POSITION_SAMPLE,
    LOBE_SAMPLE,
    draw_light,
    scatter_path,
    survives_roulette,
)
from octasplat.engine.pathtracing.kernels.surface import normalize
from octasplat.engine.trace.kernels.native import njit_no_refcount

MATERIAL, ALBEDO, METALLIC, ROUGHNESS, RAY_OFFSET = 4, 5, 8, 9, 10
"""Features of Gaussians behind those of :mod:`octasplat.engine.pathtracing.kernels.gaussian_layer`.

Whether they have a material, this, and how far off their surface rays begin, world units.
"""
FEATURE_COUNT = 11
IOR = 1.5
"""Of what is no metal: it reflects 0.04 head-on."""
FIRST_PAIR, PAIRS_PER_BOUNCE = 1 << 12, 5
"""Pairs of numbers of these surfaces, apart from those of meshes."""


@njit_no_refcount(forceinline=True)
def _draw_samples(paths: PathArrays, p: int, pair: int, random_numbers: Float64[np.ndarray, "d 2 b"]) -> None:
    """Write the numbers of :func:`scatter`, into the first column."""
    key, sample = paths.keys[p], paths.samples[p]
    for place in (LOBE_SAMPLE, DIRECTION_SAMPLE, LIGHT_CHOICE_SAMPLE, LIGHT_POSITION_SAMPLE):
        random_numbers[place, 0, 0], random_numbers[place, 1, 0] = uniform_pair(key, sample, pair + place)


@njit_no_refcount(forceinline=True)
def _albedo_tables(materials: MaterialArrays) -> AlbedoTables:
    """Return the tables of these surfaces, which have the default index of refraction."""
    coat = materials.coat_albedo[0]
    return AlbedoTables(materials.ggx_albedo, coat, materials.coat_mean_albedo[0], coat)


@kernel(_nrt=False, error_model="numpy")
def intersect_gaussian_surfaces(
    first: int, last: int, scratch: PathScratch, bounce: Bounce, layer: LayerArrays
) -> None:
    """Intersect paths with the Gaussians that have materials, or remove these from the layer.

    A path that meets them goes on from there: its face becomes :data:`PATH_ENDED`, and nothing of the layer
    is left. The shadow rays get what it asks of lights.
    """
    paths, active, depth, hits, scene, integrator, shadows = bounce
    faces = hits.faces
    materials, lights = scene.materials, scene.lights
    rgb, transmittance, features = layer.rgb, layer.transmittance, layer.features
    depth_median, depth_sum, normals = layer.depth_median, layer.depth_sum, layer.normals
    samples = PathSamples(scratch.random_numbers, 0)
    tables = _albedo_tables(materials)
    for k in range(first, last):
        p = active[k]
        shadows.radiance_linear[k, 0] = shadows.radiance_linear[k, 1] = shadows.radiance_linear[k, 2] = 0.0
        left, chance = float(transmittance[k]), float(features[k, MATERIAL])
        share = 1.0 - left
        if chance <= MIN_COVERAGE:
            continue
        if left < layer.min_transmittance:  # the tracer stopped looking here
            chance /= share  # what the tracer did not look for counts as covered by the same
        pair = FIRST_PAIR + depth * PAIRS_PER_BOUNCE
        choice, roulette = uniform_pair(paths.keys[p], paths.samples[p], pair)
        if choice >= chance:
            # --- past them: what is left is seen as if they were not there ---
            rest = 1.0 / max(1.0 - chance, MIN_COVERAGE)
            transmittance[k] = min(left * rest, 1.0)
            for channel in range(3):
                rgb[k, channel] *= rest
            for feature in range(MATERIAL):
                features[k, feature] *= rest
            depth_sum[k] *= rest
            continue
        # --- the path goes on from their surface ---
        # Not the mean: the little that shines through to a far side would pull it below the surface.
        distance = depth_median[k] if depth_median[k] > 0.0 else depth_sum[k] / share
        transmittance[k] = 1.0
        faces[k] = PATH_ENDED
        if depth >= integrator.max_depth:
            paths.is_alive[p] = False
            continue
        if paths.medium_ids[p] >= 0:
            medium = materials.absorption[paths.medium_ids[p]]
            for channel in range(3):
                paths.throughput[p, channel] *= math.exp(-medium[channel] * distance)
        if depth >= integrator.roulette_depth and not survives_roulette(paths, p, roulette):
            continue
        if paths.flags[p] & FLAG_CAMERA_RAY:
            paths.flags[p] |= FLAG_GAUSSIAN_SURFACE
        _draw_samples(paths, p, pair + 1, samples.random_numbers)
        o, d = paths.origins_world[p], paths.directions_world[p]
        n_x, n_y, n_z = normalize(normals[k, 0], normals[k, 1], normals[k, 2])
        # features are sums along the ray; over that of MATERIAL they are means
        part = 1.0 / float(features[k, MATERIAL])
        lift = features[k, RAY_OFFSET] * part
        point = (
            o[0] + distance * d[0] + lift * n_x,
            # off the surface, whose Gaussians would shadow their own point
            o[1] + distance * d[1] + lift * n_y,
            o[2] + distance * d[2] + lift * n_z,
        )
        color = (
            min(features[k, ALBEDO] * part, 1.0),
            min(features[k, ALBEDO + 1] * part, 1.0),
            min(features[k, ALBEDO + 2] * part, 1.0),
        )
        metallic, roughness = min(features[k, METALLIC] * part, 1.0), min(features[k, ROUGHNESS] * part, 1.0)
        bsdf = Bsdf(color, metallic, roughness, IOR, BURLEY, False, 0.0, 0.0)
        normal, query = (n_x, n_y, n_z), LightQuery(lights, integrator, shadows, k)
        shadows.medium_ids[k] = paths.medium_ids[p]
        if scene.any_nested:
            copy_media(paths.media[p], shadows.media[k])
        light = draw_light(lights, point, samples)
        surface = SurfacePoint(point, normal, normal, 0.0)
        scatter_path(p, samples, paths, False, surface, bsdf, tables, light, query)


@kernel(_nrt=False, error_model="numpy")
def start_paths_at_surfaces(
    first: int,
    last: int,
    scratch: PathScratch,
    interactions: SurfaceInteractions,
    pixels: Int64[np.ndarray, " n"],
    samples: Int64[np.ndarray, " n"],
    integrator: IntegratorParameters,
    materials: MaterialArrays,
    lights: LightArrays,
    paths: PathArrays,
    shadows: ShadowRayArrays,
) -> None:
    """Start paths at points of surfaces, as if the camera's rays had hit them there."""
    column = PathSamples(scratch.random_numbers, 0)
    tables = _albedo_tables(materials)
    reset_paths(paths, first, last - first, FLAG_GAUSSIAN_SURFACE)
    for k in range(first, last):
        paths.keys[k], paths.samples[k] = pixel_key(integrator.seed, pixels[k]), samples[k]
        shadows.radiance_linear[k, 0] = shadows.radiance_linear[k, 1] = shadows.radiance_linear[k, 2] = 0.0
        point, d, n = (
            interactions.points_world[k],
            interactions.directions_world[k],
            interactions.normals_world[k],
        )
        origin = float(point[0]), float(point[1]), float(point[2])
        for axis in range(3):
            paths.origins_world[k, axis], paths.directions_world[k, axis] = point[axis], d[axis]
        _draw_samples(paths, k, FIRST_PAIR + 1, scratch.random_numbers)
        material = interactions.materials[k]
        normal = float(n[0]), float(n[1]), float(n[2])
        color = float(material[0]), float(material[1]), float(material[2])
        bsdf = Bsdf(color, float(material[3]), float(material[4]), IOR, BURLEY, False, 0.0, 0.0)
        query = LightQuery(lights, integrator, shadows, k)
        light = draw_light(lights, origin, column)
        surface = SurfacePoint(origin, normal, normal, 0.0)
        scatter_path(k, column, paths, False, surface, bsdf, tables, light, query)

"""Gaussians on a ray: the layer that they are in front of what the ray meets.

How display colors and linear light meet. The trained colors of Gaussians are display values and are
composited as such, into one layer of premultiplied color g and transmittance T for each ray.

- On the camera's own ray, and on as long as mirrors and glass send what they pass on in one direction, layers
  are composited with each other and over what is behind them in display values: g + T encode(L), L the mean
  linear radiance of what is behind. Mirrors dim the color of a layer, as linear light.
- On any other ray a layer sends the linear radiance (1 - T) decode(g / (1 - T)) and lets T of the linear
  light behind it through. Where such a ray comes straight from a mirror or from glass and ends in the
  surroundings, what is behind the layer is known, and the radiance is decode(g + T encode(L)) as for the
  camera.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int32

from octasplat.engine.core.compilation import kernel
from octasplat.engine.pathtracing.kernels.kernel_args import LayerArrays, Rgb, Vec3
from octasplat.engine.pathtracing.kernels.lights import (
    INFINITE_DISTANCE,
    no_shadow_probability,
    sample_light,
    sample_light_index,
)
from octasplat.engine.pathtracing.kernels.nested_glass import copy_media
from octasplat.engine.pathtracing.kernels.path_args import (
    CAMERA_SAMPLE_PAIRS,
    PATH_ENDED,
    SAMPLE_PAIRS_PER_BOUNCE,
    Bounce,
    LightQuery,
    PathArrays,
    PathScratch,
)
from octasplat.engine.pathtracing.kernels.path_radiance import add_radiance, eval_background
from octasplat.engine.pathtracing.kernels.sampler import uniform_pair
from octasplat.engine.pathtracing.kernels.scatter import (
    FLAG_CLEAR,
    FLAG_SCATTERED,
    LAYER_LIGHT_SAMPLE,
    LIGHT_CHOICE_SAMPLE,
    SHADOW_RAY_SCALE,
)
from octasplat.engine.pathtracing.kernels.surface import normalize
from octasplat.engine.trace.kernels.native import njit_no_refcount

MIN_COVERAGE = 1e-6
SINGLE_SURFACE_TOLERANCE = 0.05
SHADOWED, RELIT, AMBIENT, ADDITIVE = 0, 1, 2, 3
"""Features of Gaussians: share that shadows take, share that is relit, that times its ambient part, and share
that new lights are added to."""


class LayerLight(NamedTuple):
    """What shadow rays of layers bring.

    Attributes:
        radiance: where nothing is in the way.
        occluded_radiance: where a mesh is in the way of light that would have come.
        mesh_transmittance: the share in each channel that meshes let through.
        caster_transmittance: that of the Gaussians that cast shadows on Gaussians.
        other_transmittance: that of the Gaussians that do not.
    """

    radiance: Float32[np.ndarray, "n 3"]
    occluded_radiance: Float32[np.ndarray, "n 3"]
    mesh_transmittance: Float32[np.ndarray, "n 3"]
    caster_transmittance: Float32[np.ndarray, " n"]
    other_transmittance: Float32[np.ndarray, " n"]


@njit_no_refcount(forceinline=True)
def encode_srgb(linear: float) -> float:
    """Return the display value of a linear one (IEC 61966-2-1), also beyond 1."""
    if linear <= 0.0031308:
        return 12.92 * max(linear, 0.0)
    return 1.055 * linear ** (1.0 / 2.4) - 0.055


@njit_no_refcount(forceinline=True)
def decode_srgb(display: float) -> float:
    """Return the linear value of a display value, also beyond 1."""
    if display <= 0.04045:
        return max(display, 0.0) / 12.92
    return ((display + 0.055) / 1.055) ** 2.4


@njit_no_refcount(forceinline=True)
def _mirrored_color(color_srgb: float, share: float, reflectance: float) -> float:
    """Return a premultiplied display color of coverage ``share`` in mirrors of a linear reflectance."""
    if reflectance == 1.0:
        # encoding is not linear: the color is scaled without its coverage
        return color_srgb
    return share * encode_srgb(reflectance * decode_srgb(color_srgb / share))


@njit_no_refcount(forceinline=True)
def _layer_distance(layer: LayerArrays, k: int, share: float) -> float:
    """Return where a layer of coverage ``share`` lies.

    The mean distance is smoother than the median, but lies in the air where the layer is two surfaces.
    """
    distance = layer.depth_sum[k] / share
    median = layer.depth_median[k]
    if abs(distance - median) > SINGLE_SURFACE_TOLERANCE * median and median > 0.0:
        distance = median
    return distance


@njit_no_refcount(forceinline=True)
def _layer_throughput(
    paths: PathArrays,
    p: int,
    layer: LayerArrays,
    k: int,
    share: float,
    distance: float,
    absorption: Float64[np.ndarray, "m 3"],
) -> Rgb:
    """Return what one unit of a layer's light counts: of its coverage on clear paths, else of its color."""
    if paths.flags[p] & FLAG_CLEAR != 0:
        g_r = g_g = g_b = paths.transmittance[p] * share
        return g_r, g_g, g_b
    w = paths.throughput[p]
    g_r = w[0] * share * decode_srgb(layer.rgb[k, 0] / share)
    g_g = w[1] * share * decode_srgb(layer.rgb[k, 1] / share)
    g_b = w[2] * share * decode_srgb(layer.rgb[k, 2] / share)
    if paths.medium_ids[p] >= 0:
        medium = absorption[paths.medium_ids[p]]
        g_r *= math.exp(-medium[0] * distance)
        g_g *= math.exp(-medium[1] * distance)
        g_b *= math.exp(-medium[2] * distance)
    return g_r, g_g, g_b


@njit_no_refcount(forceinline=True)
def _query_layer_light(
    paths: PathArrays,
    p: int,
    first_pair: int,
    point: Vec3,
    normal: Vec3,
    weight: Rgb,
    shares: tuple[float, float, float],
    query: LightQuery,
) -> None:
    """Queue a light query of a layer of Gaussians.

    ``weight`` is what one unit of the layer's light counts, ``shares`` are those that shadows take, that all
    lights give, and that new lights are added to.
    """
    lights, shadows, k = query.lights, query.shadows, query.k
    shadowed, relit, additive = shares
    (x, y, z), (g_r, g_g, g_b) = point, weight
    # the second number: surfaces take the first
    _, pick = uniform_pair(paths.keys[p], paths.samples[p], first_pair + LIGHT_CHOICE_SAMPLE)
    l, chance = sample_light_index(lights, x, y, z, pick, False)
    if l < 0:
        return
    u, v = uniform_pair(paths.keys[p], paths.samples[p], first_pair + LAYER_LIGHT_SAMPLE)
    w_x, w_y, w_z, reach, l_r, l_g, l_b, pdf = sample_light(lights, l, x, y, z, u, v)
    n_x, n_y, n_z = normalize(normal[0], normal[1], normal[2])
    cosine = max(n_x * w_x + n_y * w_y + n_z * w_z, 0.0)
    taking = (relit if lights.lights_relit[l] else 0.0) + (additive if lights.adds_light[l] else 0.0)
    # a Lambertian surface with the layer's normal; a light in one direction has no density
    factor = taking * cosine / (math.pi * chance * (pdf if pdf > 0.0 else 1.0))
    red, green, blue = g_r * l_r * factor, g_g * l_g * factor, g_b * l_b * factor
    if paths.flags[p] & FLAG_SCATTERED:
        most, clamp = max(red, green, blue), query.integrator.clamp
        if most > clamp:
            red, green, blue = red * clamp / most, green * clamp / most, blue * clamp / most
    shadows.radiance_linear[k, 0] = red
    shadows.radiance_linear[k, 1] = green
    shadows.radiance_linear[k, 2] = blue
    if shadowed > MIN_COVERAGE and lights.takes_light[l]:
        # Only among the lights that take something is the shadow a mean.
        losing = shadowed / max(1.0 - no_shadow_probability(lights, x, y, z), 1e-6)
        shadows.occluded_radiance_linear[k, 0] = -g_r * losing
        shadows.occluded_radiance_linear[k, 1] = -g_g * losing
        shadows.occluded_radiance_linear[k, 2] = -g_b * losing
    shadows.origins_world[k, 0], shadows.origins_world[k, 1], shadows.origins_world[k, 2] = x, y, z
    shadows.directions_world[k, 0] = w_x
    shadows.directions_world[k, 1] = w_y
    shadows.directions_world[k, 2] = w_z
    shadows.passes_glass[k] = True
    # short of the light's own surface; nothing is in the way of what casts no shadows
    reach = reach * SHADOW_RAY_SCALE if reach < INFINITE_DISTANCE else math.inf
    shadows.t_max[k] = reach if lights.casts_shadows[l] else 0.0


@kernel(_nrt=False, error_model="numpy")
def intersect_gaussian_layers(
    first: int, last: int, scratch: PathScratch, bounce: Bounce, layer: LayerArrays
) -> None:
    """Put the layers of Gaussians in front of the surfaces ``faces`` onto paths.

    The shadow rays get what the layers ask of lights. Where a ray ends, its face becomes :data:`PATH_ENDED`.
    """
    paths, active, depth, hits, scene, integrator, shadows = bounce
    faces = hits.faces
    lights, absorption = scene.lights, scene.materials.absorption
    for k in range(first, last):
        p = active[k]
        for channel in range(3):
            shadows.radiance_linear[k, channel] = shadows.occluded_radiance_linear[k, channel] = 0.0
        left = float(layer.transmittance[k])
        share = 1.0 - left
        if share <= MIN_COVERAGE:
            continue
        d, o = paths.directions_world[p], paths.origins_world[p]
        clear = paths.flags[p] & FLAG_CLEAR != 0
        features = layer.features[k]
        # features are sums along the ray; over the coverage they are means
        shares = features[SHADOWED] / share, features[RELIT] / share, features[ADDITIVE] / share
        relit = shares[1]
        base = 1.0 - relit + features[AMBIENT] / share
        distance = _layer_distance(layer, k, share)
        b_r, b_g, b_b = eval_background(
            lights, scene.environment, integrator, paths.flags[p], d[0], d[1], d[2]
        )
        # --- what one unit of the layer's light counts, and how its color is lit ---
        g_r, g_g, g_b = _layer_throughput(paths, p, layer, k, share, distance, absorption)
        if max(shares[0], shares[1], shares[2]) > MIN_COVERAGE and len(lights.kinds):
            point = o[0] + distance * d[0], o[1] + distance * d[1], o[2] + distance * d[2]
            first_pair = CAMERA_SAMPLE_PAIRS + depth * SAMPLE_PAIRS_PER_BOUNCE
            normal = layer.normals[k, 0], layer.normals[k, 1], layer.normals[k, 2]
            query = LightQuery(lights, integrator, shadows, k)
            shadows.medium_ids[k] = paths.medium_ids[p]
            if scene.any_nested:
                copy_media(paths.media[p], shadows.media[k])
            _query_layer_light(paths, p, first_pair, point, normal, (g_r, g_g, g_b), shares, query)
        # --- clear paths: layers are composited in display values ---
        if clear:
            for channel in range(3):
                paths.layer_srgb[p, channel] += paths.transmittance[p] * _mirrored_color(
                    layer.rgb[k, channel], share, paths.throughput[p, channel]
                )
            paths.shading_factor[p, 0] += g_r * base
            paths.shading_factor[p, 1] += g_g * base
            paths.shading_factor[p, 2] += g_b * base
            paths.transmittance[p] *= left
            if paths.transmittance[p] < layer.min_transmittance:
                paths.radiance_linear[p, 0] = b_r
                paths.radiance_linear[p, 1] = b_g
                paths.radiance_linear[p, 2] = b_b
                paths.is_alive[p], faces[k] = False, PATH_ENDED
            continue
        # --- other paths: the layer's linear radiance, over what is behind it where that is known ---
        # What lights add to it or take from it is asked apart; a relit color has another base.
        known = faces[k] < 0 and paths.pdf[p] == 0.0 and relit <= MIN_COVERAGE and paths.medium_ids[p] < 0
        if known:
            w, rgb = paths.throughput[p], layer.rgb[k]
            add_radiance(
                # Taken away again is left b, which the background adds later.
                paths, p,
                w[0] * (decode_srgb(rgb[0] + left * encode_srgb(b_r)) - left * b_r),
                w[1] * (decode_srgb(rgb[1] + left * encode_srgb(b_g)) - left * b_g),
                w[2] * (decode_srgb(rgb[2] + left * encode_srgb(b_b)) - left * b_b),
                integrator.clamp,
            )  # fmt: skip
        else:
            add_radiance(paths, p, g_r * base, g_g * base, g_b * base, integrator.clamp)
        for channel in range(3):
            paths.throughput[p, channel] *= left
        if left < layer.min_transmittance:
            paths.is_alive[p], faces[k] = False, PATH_ENDED


@kernel(_nrt=False, error_model="numpy")
def add_layer_light(
    first: int,
    last: int,
    scratch: PathScratch,
    paths: PathArrays,
    active: Int32[np.ndarray, " n"],
    light: LayerLight,
) -> None:
    """Add what shadow rays of layers brought."""
    for k in range(first, last):
        p = active[k]
        for channel in range(3):
            # taken: light that the meshes and casters keep off, but not what is dark already
            reached = light.mesh_transmittance[k, channel] * light.caster_transmittance[k]
            taken = light.other_transmittance[k] * (1.0 - reached)
            amount = light.radiance[k, channel] * reached + light.occluded_radiance[k, channel] * taken
            if paths.flags[p] & FLAG_CLEAR:
                paths.shading_factor[p, channel] += amount
            else:
                paths.radiance_linear[p, channel] += amount

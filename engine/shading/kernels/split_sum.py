"""Split-sum shading of pixels, its gradients, and the table of the BRDF's half.

Everything is a pure function of its arguments in float64; :mod:`octasplat.engine.shading.split_sum` has the
formula.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float64, Int32

from octasplat.engine.core.compilation import device_function, kernel
from octasplat.engine.shading.kernels.environment_levels import EnvironmentLevels, Lookup, look_up
from octasplat.engine.shading.kernels.microfacets import ggx_masking, sample_visible_normal, schlick_weight

TAPS = 12
"""Texels that a pixel asks: four each of two levels of the lobe and of the irradiance."""
LEAST_COSINE = 1e-3
F0 = 0.04


class SurfaceArrays(NamedTuple):
    """Points that are shaded; directions and normals are in the map's frame.

    Fields as in :class:`octasplat.engine.shading.split_sum.Surface`.
    """

    material: Float64[np.ndarray, "p 5"]
    normal: Float64[np.ndarray, "p 3"]
    direction: Float64[np.ndarray, "p 3"]
    visibility: Float64[np.ndarray, " p"]
    indirect: Float64[np.ndarray, "p 3"]
    ambient: Float64[np.ndarray, " p"]
    bounced: Float64[np.ndarray, "p 3"]


class GradientArrays(NamedTuple):
    """The arrays of a :class:`octasplat.engine.shading.split_sum.ShadeGradients`, to be written."""

    material: Float64[np.ndarray, "p 5"]
    normal: Float64[np.ndarray, "p 3"]
    reflected: Float64[np.ndarray, "p 3"]
    visibility: Float64[np.ndarray, " p"]
    indirect: Float64[np.ndarray, "p 3"]
    ambient: Float64[np.ndarray, " p"]
    bounced: Float64[np.ndarray, "p 3"]
    specular: Float64[np.ndarray, "p 3"]
    diffuse: Float64[np.ndarray, "p 3"]
    around: Float64[np.ndarray, "p 3"]
    taps: Int32[np.ndarray, "p 12"]
    weights: Float64[np.ndarray, "p 12"]


@kernel(_nrt=False, error_model="numpy")
def integrate_table(first: int, last: int, samples: int, table: Float64[np.ndarray, "a c 2"]) -> None:
    """Integrate scale and bias of F0 that one bounce off GGX facets of a white environment sends back.

    Writes the cells ``first`` to ``last``, row after row. Rows are roughness 0 to 1, columns the cosine to
    the viewer 0 to 1; visible normals are sampled by the points of Hammersley.
    """
    rows, columns = table.shape[:2]
    for cell in range(first, last):
        row, column = cell // columns, cell % columns
        roughness = row / (rows - 1)
        alpha = max(roughness * roughness, 1e-4)
        o_z = max(column / (columns - 1), LEAST_COSINE)
        o_x = math.sqrt(max(1.0 - o_z * o_z, 0.0))
        scale = bias = 0.0
        for k in range(samples):
            v, half, bits = 0.0, 0.5, k
            while bits > 0:
                v += half * (bits & 1)
                bits >>= 1
                half *= 0.5
            h_x, _, h_z = sample_visible_normal(o_x, 0.0, o_z, alpha, (k + 0.5) / samples, v)
            cos_d = o_x * h_x + o_z * h_z
            i_z = 2.0 * cos_d * h_z - o_z
            if i_z > 0.0:
                masking = ggx_masking(i_z, alpha)
                weight = schlick_weight(cos_d)
                scale += (1.0 - weight) * masking
                bias += weight * masking
        table[row, column, 0], table[row, column, 1] = scale / samples, bias / samples


@device_function(error_model="numpy")
def table_slopes(
    table: Float64[np.ndarray, "a c 2"], cosine: float, roughness: float
) -> tuple[float, float, float, float, float, float]:
    """Return both values of the table, and their slopes by cosine and by roughness."""
    rows, columns = table.shape[:2]
    y = min(max(roughness, 0.0), 1.0) * (rows - 1)
    x = min(max(cosine, 0.0), 1.0) * (columns - 1)
    j, i = min(int(y), rows - 2), min(int(x), columns - 2)
    y, x = y - j, x - i
    a0, b0, c0, d0 = table[j, i, 0], table[j, i + 1, 0], table[j + 1, i, 0], table[j + 1, i + 1, 0]
    a1, b1, c1, d1 = table[j, i, 1], table[j, i + 1, 1], table[j + 1, i, 1], table[j + 1, i + 1, 1]
    scale = (a0 * (1 - x) + b0 * x) * (1 - y) + (c0 * (1 - x) + d0 * x) * y
    bias = (a1 * (1 - x) + b1 * x) * (1 - y) + (c1 * (1 - x) + d1 * x) * y
    by_cos0 = ((b0 - a0) * (1 - y) + (d0 - c0) * y) * (columns - 1)
    by_cos1 = ((b1 - a1) * (1 - y) + (d1 - c1) * y) * (columns - 1)
    by_rough0 = ((c0 - a0) * (1 - x) + (d0 - b0) * x) * (rows - 1)
    by_rough1 = ((c1 - a1) * (1 - x) + (d1 - b1) * x) * (rows - 1)
    return scale, bias, by_cos0, by_cos1, by_rough0, by_rough1


@device_function(error_model="numpy")
def mix(
    texels: Float[np.ndarray, "t 3"], a: int, b: int, c: int, d: int, x: float, y: float, channel: int
) -> float:
    """Return bilinear value of four texels."""
    top = texels[a, channel] * (1.0 - x) + texels[b, channel] * x
    bottom = texels[c, channel] * (1.0 - x) + texels[d, channel] * x
    return top * (1.0 - y) + bottom * y


@device_function(error_model="numpy")
def mix_slopes(
    texels: Float[np.ndarray, "t 3"], a: int, b: int, c: int, d: int, x: float, y: float, channel: int
) -> tuple[float, float]:
    """Return slopes of that by the two fractions."""
    p, q, r, s = texels[a, channel], texels[b, channel], texels[c, channel], texels[d, channel]
    return (q - p) * (1.0 - y) + (s - r) * y, (r - p) * (1.0 - x) + (s - q) * x


@device_function(error_model="numpy")
def level_of(roughnesses: Float64[np.ndarray, " l"], roughness: float) -> tuple[int, float, float]:
    """Return the level below a roughness, how far it is to the next, and the slope of that."""
    last = len(roughnesses) - 1
    if roughness <= roughnesses[0]:
        return 0, 0.0, 0.0
    for level in range(last):
        if roughness < roughnesses[level + 1]:
            gap = roughnesses[level + 1] - roughnesses[level]
            return level, (roughness - roughnesses[level]) / gap, 1.0 / gap
    return last - 1, 1.0, 0.0


@device_function(error_model="numpy")
def shade_pixel(
    p: int,
    surface: SurfaceArrays,
    light: EnvironmentLevels,
    table: Float64[np.ndarray, "a c 2"],
    rgb: Float64[np.ndarray, "p 3"],
) -> None:
    """Write the linear color of one pixel."""
    material, normal, direction, visibility, indirect, ambient, bounced = surface
    texels, offsets, heights, roughnesses = light.texels, light.offsets, light.heights, light.roughnesses
    n_x, n_y, n_z = normal[p, 0], normal[p, 1], normal[p, 2]
    cosine = -(direction[p, 0] * n_x + direction[p, 1] * n_y + direction[p, 2] * n_z)
    r_x = direction[p, 0] + 2.0 * cosine * n_x
    r_y = direction[p, 1] + 2.0 * cosine * n_y
    r_z = direction[p, 2] + 2.0 * cosine * n_z
    metallic, roughness = material[p, 3], material[p, 4]
    scale, bias, _, _, _, _ = table_slopes(table, max(cosine, LEAST_COSINE), roughness)
    level, between, _ = level_of(roughnesses, roughness)
    a, b, c, d, x, y, _, _, _ = look_up(texels, offsets[level], heights[level], r_x, r_y, r_z)
    e, f, g, h, u, v, _, _, _ = look_up(texels, offsets[level + 1], heights[level + 1], r_x, r_y, r_z)
    last = len(heights) - 1
    i, j, k, l, s, t, _, _, _ = look_up(texels, offsets[last], heights[last], n_x, n_y, n_z)
    for channel in range(3):
        albedo = material[p, channel]
        f0 = F0 * (1.0 - metallic) + metallic * albedo
        sharp = mix(texels, a, b, c, d, x, y, channel)
        blurred = mix(texels, e, f, g, h, u, v, channel)
        seen = visibility[p] * (sharp * (1.0 - between) + blurred * between) + indirect[p, channel]
        lit = ambient[p] * mix(texels, i, j, k, l, s, t, channel) + bounced[p, channel]
        rgb[p, channel] = (f0 * scale + bias) * seen + (1.0 - metallic) * albedo * lit


@kernel(_nrt=False, error_model="numpy")
def shade_pixels(
    first: int,
    last: int,
    surface: SurfaceArrays,
    light: EnvironmentLevels,
    table: Float64[np.ndarray, "a c 2"],
    rgb: Float64[np.ndarray, "p 3"],
) -> None:
    """Write the linear colors of the pixels ``first`` to ``last``."""
    for p in range(first, last):
        shade_pixel(p, surface, light, table, rgb)


@device_function(error_model="numpy")
def look_back(
    out: GradientArrays,
    p: int,
    place: int,
    light: EnvironmentLevels,
    level: int,
    direction: tuple[float, float, float],
    share: float,
) -> Lookup:
    """Write the four texels of a look-up in a level, from ``place`` on, and their weights times ``share``.

    Returns:
        What :func:`look_up` does.
    """
    taps, weights = out.taps, out.weights
    x, y, z = direction
    found = look_up(light.texels, light.offsets[level], light.heights[level], x, y, z)
    a, b, c, d, u, v, _, _, _ = found
    taps[p, place], taps[p, place + 1], taps[p, place + 2], taps[p, place + 3] = a, b, c, d
    weights[p, place] = share * (1.0 - u) * (1.0 - v)
    weights[p, place + 1] = share * u * (1.0 - v)
    weights[p, place + 2] = share * (1.0 - u) * v
    weights[p, place + 3] = share * u * v
    return found


@device_function(error_model="numpy")
def direction_slope(
    texels: Float[np.ndarray, "t 3"], found: Lookup, channel: int
) -> tuple[float, float, float]:
    """Return slope of a looked-up value by the direction."""
    a, b, c, d, u, v, column_x, column_z, row_y = found
    by_u, by_v = mix_slopes(texels, a, b, c, d, u, v, channel)
    return by_u * column_x, by_v * row_y, by_u * column_z


@device_function(error_model="numpy")
def reverse_pixel(
    p: int,
    surface: SurfaceArrays,
    light: EnvironmentLevels,
    table: Float64[np.ndarray, "a c 2"],
    blur: float,
    by_rgb: Float64[np.ndarray, "p 3"],
    out: GradientArrays,
) -> None:
    """Write the gradients of one pixel; see :class:`octasplat.engine.shading.split_sum.ShadeGradients`."""
    material, normal, direction, visibility, indirect, ambient, bounced = surface
    texels, offsets, heights, roughnesses = light.texels, light.offsets, light.heights, light.roughnesses
    n_x, n_y, n_z = normal[p, 0], normal[p, 1], normal[p, 2]
    d_x, d_y, d_z = direction[p, 0], direction[p, 1], direction[p, 2]
    cosine = -(d_x * n_x + d_y * n_y + d_z * n_z)
    r_x, r_y, r_z = d_x + 2.0 * cosine * n_x, d_y + 2.0 * cosine * n_y, d_z + 2.0 * cosine * n_z
    metallic, roughness = material[p, 3], material[p, 4]
    seen_cosine = max(cosine, LEAST_COSINE)
    scale, bias, cos0, cos1, rough0, rough1 = table_slopes(table, seen_cosine, roughness)
    level, between, by_between = level_of(roughnesses, roughness)
    # --- what the pixel sees: two levels of the lobe, and the irradiance ---
    reflected = r_x, r_y, r_z
    near = look_back(out, p, 0, light, level, reflected, visibility[p] * (1.0 - between))
    far = look_back(out, p, 4, light, level + 1, reflected, visibility[p] * between)
    facing = look_back(out, p, 8, light, len(heights) - 1, (n_x, n_y, n_z), ambient[p])
    slope, slope_between, slope_near, slope_far = level, between, near, far
    if blur > roughness:  # the direction is led by a blurred level
        slope, slope_between, _ = level_of(roughnesses, blur)
        slope_near = look_up(texels, offsets[slope], heights[slope], r_x, r_y, r_z)
        slope_far = look_up(texels, offsets[slope + 1], heights[slope + 1], r_x, r_y, r_z)
    # --- sums over the channels; gr is dL by the reflected direction, gn by the normal ---
    by_metallic = by_roughness = by_cosine = by_visibility = by_ambient = 0.0
    gr_x = gr_y = gr_z = gn_x = gn_y = gn_z = 0.0
    for channel in range(3):
        gradient, albedo = by_rgb[p, channel], material[p, channel]
        f0 = F0 * (1.0 - metallic) + metallic * albedo
        factor = f0 * scale + bias
        sharp = mix(texels, near[0], near[1], near[2], near[3], near[4], near[5], channel)
        blurred = mix(texels, far[0], far[1], far[2], far[3], far[4], far[5], channel)
        around = sharp * (1.0 - between) + blurred * between
        out.around[p, channel] = around
        irradiance = mix(texels, facing[0], facing[1], facing[2], facing[3], facing[4], facing[5], channel)
        seen = visibility[p] * around + indirect[p, channel]
        lit = ambient[p] * irradiance + bounced[p, channel]
        matt = (1.0 - metallic) * albedo
        out.material[p, channel] = gradient * (metallic * scale * seen + (1.0 - metallic) * lit)
        by_metallic += gradient * ((albedo - F0) * scale * seen - albedo * lit)
        by_factor = gradient * seen
        by_cosine += by_factor * (f0 * cos0 + cos1)
        by_roughness += by_factor * (f0 * rough0 + rough1)
        by_roughness += gradient * factor * visibility[p] * (blurred - sharp) * by_between
        by_visibility += gradient * factor * around
        by_ambient += gradient * matt * irradiance
        out.indirect[p, channel] = out.specular[p, channel] = gradient * factor
        out.bounced[p, channel] = out.diffuse[p, channel] = gradient * matt
        share = gradient * factor * visibility[p]
        s_x, s_y, s_z = direction_slope(texels, slope_near, channel)
        t_x, t_y, t_z = direction_slope(texels, slope_far, channel)
        gr_x += share * (s_x * (1.0 - slope_between) + t_x * slope_between)
        gr_y += share * (s_y * (1.0 - slope_between) + t_y * slope_between)
        gr_z += share * (s_z * (1.0 - slope_between) + t_z * slope_between)
        share = gradient * matt * ambient[p]
        s_x, s_y, s_z = direction_slope(texels, facing, channel)
        gn_x += share * s_x
        gn_y += share * s_y
        gn_z += share * s_z
    # --- the rest of the gradients ---
    if cosine < LEAST_COSINE:
        by_cosine = 0.0
    along = n_x * gr_x + n_y * gr_y + n_z * gr_z
    out.reflected[p, 0] = 2.0 * (cosine * gr_x - along * d_x)
    out.reflected[p, 1] = 2.0 * (cosine * gr_y - along * d_y)
    out.reflected[p, 2] = 2.0 * (cosine * gr_z - along * d_z)
    out.normal[p, 0] = gn_x - by_cosine * d_x
    out.normal[p, 1] = gn_y - by_cosine * d_y
    out.normal[p, 2] = gn_z - by_cosine * d_z
    out.material[p, 3], out.material[p, 4] = by_metallic, by_roughness
    out.visibility[p], out.ambient[p] = by_visibility, by_ambient


@kernel(_nrt=False, error_model="numpy")
def reverse_pixels(
    first: int,
    last: int,
    surface: SurfaceArrays,
    light: EnvironmentLevels,
    table: Float64[np.ndarray, "a c 2"],
    blur: float,
    by_rgb: Float64[np.ndarray, "p 3"],
    out: GradientArrays,
) -> None:
    """Write the gradients of the pixels ``first`` to ``last``."""
    for p in range(first, last):
        reverse_pixel(p, surface, light, table, blur, by_rgb, out)


@kernel(error_model="numpy")
def add_to_texels(
    taps: Int32[np.ndarray, "p 12"],
    weights: Float64[np.ndarray, "p 12"],
    specular: Float64[np.ndarray, "p 3"],
    diffuse: Float64[np.ndarray, "p 3"],
    by_texels: Float64[np.ndarray, "t 3"],
) -> None:
    """Add each pixel's shares to the texels that it asked, pixel after pixel."""
    for p in range(len(taps)):
        for k in range(TAPS):
            weight = weights[p, k]
            if weight == 0.0:
                continue
            texel = taps[p, k]
            for channel in range(3):
                gradient = specular[p, channel] if k < 8 else diffuse[p, channel]
                by_texels[texel, channel] += weight * gradient

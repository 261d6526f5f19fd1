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


class ShadeGradients(NamedTuple):
    """Gradients of a loss with respect to what was shaded.

    Attributes:
        material: by albedo, metallic and roughness.
        normal: by the normal, but not through the reflected direction.
        reflected: by the normal through the reflected direction.
        visibility: by the visibility.
        indirect: by the indirect light.
        ambient: by the ambient visibility.
        bounced: by the bounced light.
        specular: by what the lobe sees, each channel.
        diffuse: by the irradiance.
        around: no gradient: what the lobe would see if nothing hid the environment.
        taps: texels that were asked.
        weights: their weights.
    """

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

    def sum_texels(self, count: int) -> Float64[np.ndarray, "t 3"]:
        """Return gradients by the texels of all levels, summed point after point."""
        sums = np.zeros((count, 3))
        add_to_texels(self.taps, self.weights, self.specular, self.diffuse, sums)
        return sums


class ShadeBackward(NamedTuple):
    """What gradients are computed from, and where they go.

    Attributes:
        surface: the points.
        light: levels of the environment.
        table: scale and bias of F0.
        blur: see :func:`octasplat.engine.shading.split_sum.shade_backward`.
        grad_rgb: gradient by the colors.
        out: the gradients that are written.
    """

    surface: SurfaceArrays
    light: EnvironmentLevels
    table: Float64[np.ndarray, "a c 2"]
    blur: float
    grad_rgb: Float64[np.ndarray, "p 3"]
    out: ShadeGradients


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
            v, half, bits = 0.0, 0.5, k  # radical inverse in base 2, the second Hammersley coordinate
            while bits > 0:
                v += half * (bits & 1)
                bits >>= 1
                half *= 0.5
            h_x, _, h_z = sample_visible_normal(o_x, 0.0, o_z, alpha, (k + 0.5) / samples, v)
            cos_d = o_x * h_x + o_z * h_z
            i_z = 2.0 * cos_d * h_z - o_z  # o reflected at h; below the surface nothing is sent back
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
    grad_cos0 = ((b0 - a0) * (1 - y) + (d0 - c0) * y) * (columns - 1)
    grad_cos1 = ((b1 - a1) * (1 - y) + (d1 - c1) * y) * (columns - 1)
    grad_rough0 = ((c0 - a0) * (1 - x) + (d0 - b0) * x) * (rows - 1)
    grad_rough1 = ((c1 - a1) * (1 - x) + (d1 - b1) * x) * (rows - 1)
    return scale, bias, grad_cos0, grad_cos1, grad_rough0, grad_rough1


@device_function(error_model="numpy")
def mix(
    texels: Float[np.ndarray, "t 3"], a: int, b: int, c: int, d: int, x: float, y: float, channel: int
) -> float:
    """Return bilinear value of four texels."""
    top = texels[a, channel] * (1.0 - x) + texels[b, channel] * x
    bottom = texels[c, channel] * (1.0 - x) + texels[d, channel] * x
    return top * (1.0 - y) + bottom * y


@device_function(error_model="numpy")
def mix_gradient(
    texels: Float[np.ndarray, "t 3"], a: int, b: int, c: int, d: int, x: float, y: float, channel: int
) -> tuple[float, float]:
    """Return the gradient of :func:`mix` with respect to the two fractions."""
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
    r_x = direction[p, 0] + 2.0 * cosine * n_x  # R = d + 2 (N.V) N, with V = -d
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
        specular_light = visibility[p] * (sharp * (1.0 - between) + blurred * between) + indirect[p, channel]
        diffuse_light = ambient[p] * mix(texels, i, j, k, l, s, t, channel) + bounced[p, channel]
        rgb[p, channel] = (f0 * scale + bias) * specular_light + (1.0 - metallic) * albedo * diffuse_light


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
def look_up_recorded(
    out: ShadeGradients,
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
def direction_gradient(
    texels: Float[np.ndarray, "t 3"], found: Lookup, channel: int
) -> tuple[float, float, float]:
    """Return the gradient of a looked-up value with respect to the direction."""
    a, b, c, d, u, v, column_x, column_z, row_y = found
    grad_u, grad_v = mix_gradient(texels, a, b, c, d, u, v, channel)
    return grad_u * column_x, grad_v * row_y, grad_u * column_z


@device_function(error_model="numpy")
def backward_pixel(p: int, backward: ShadeBackward) -> None:
    """Write the gradients of one pixel."""
    surface, light, table, blur, grad_rgb, out = backward
    material, normal, direction, visibility, indirect, ambient, bounced = surface
    texels, offsets, heights, roughnesses = light.texels, light.offsets, light.heights, light.roughnesses
    n_x, n_y, n_z = normal[p, 0], normal[p, 1], normal[p, 2]
    d_x, d_y, d_z = direction[p, 0], direction[p, 1], direction[p, 2]
    cosine = -(d_x * n_x + d_y * n_y + d_z * n_z)
    r_x, r_y, r_z = d_x + 2.0 * cosine * n_x, d_y + 2.0 * cosine * n_y, d_z + 2.0 * cosine * n_z
    metallic, roughness = material[p, 3], material[p, 4]
    safe_cosine = max(cosine, LEAST_COSINE)
    scale, bias, grad_scale_cosine, grad_bias_cosine, grad_scale_roughness, grad_bias_roughness = (
        table_slopes(table, safe_cosine, roughness)
    )
    level, between, grad_between = level_of(roughnesses, roughness)
    # --- what the pixel sees: two levels of the lobe, and the irradiance ---
    reflected = r_x, r_y, r_z
    near = look_up_recorded(out, p, 0, light, level, reflected, visibility[p] * (1.0 - between))
    far = look_up_recorded(out, p, 4, light, level + 1, reflected, visibility[p] * between)
    facing = look_up_recorded(out, p, 8, light, len(heights) - 1, (n_x, n_y, n_z), ambient[p])
    gradient_level, gradient_between, gradient_near, gradient_far = level, between, near, far
    if blur > roughness:  # the direction is led by a blurred level
        gradient_level, gradient_between, _ = level_of(roughnesses, blur)
        gradient_near = look_up(texels, offsets[gradient_level], heights[gradient_level], r_x, r_y, r_z)
        gradient_far = look_up(
            texels, offsets[gradient_level + 1], heights[gradient_level + 1], r_x, r_y, r_z
        )
    # --- sums over the channels; grad_r is by the reflected direction, grad_n by the normal ---
    grad_metallic = grad_roughness = grad_cosine = grad_visibility = grad_ambient = 0.0
    grad_r_x = grad_r_y = grad_r_z = grad_n_x = grad_n_y = grad_n_z = 0.0
    for channel in range(3):
        gradient, albedo = grad_rgb[p, channel], material[p, channel]
        f0 = F0 * (1.0 - metallic) + metallic * albedo
        factor = f0 * scale + bias
        sharp = mix(texels, near[0], near[1], near[2], near[3], near[4], near[5], channel)
        blurred = mix(texels, far[0], far[1], far[2], far[3], far[4], far[5], channel)
        around = sharp * (1.0 - between) + blurred * between
        out.around[p, channel] = around
        irradiance = mix(texels, facing[0], facing[1], facing[2], facing[3], facing[4], facing[5], channel)
        specular_light = visibility[p] * around + indirect[p, channel]
        diffuse_light = ambient[p] * irradiance + bounced[p, channel]
        diffuse_albedo = (1.0 - metallic) * albedo
        out.material[p, channel] = gradient * (
            metallic * scale * specular_light + (1.0 - metallic) * diffuse_light
        )
        grad_metallic += gradient * ((albedo - F0) * scale * specular_light - albedo * diffuse_light)
        grad_factor = gradient * specular_light
        grad_cosine += grad_factor * (f0 * grad_scale_cosine + grad_bias_cosine)
        grad_roughness += grad_factor * (f0 * grad_scale_roughness + grad_bias_roughness)
        # through the mix of two levels of the lobe
        grad_roughness += gradient * factor * visibility[p] * (blurred - sharp) * grad_between
        grad_visibility += gradient * factor * around
        grad_ambient += gradient * diffuse_albedo * irradiance
        out.indirect[p, channel] = out.specular[p, channel] = gradient * factor
        out.bounced[p, channel] = out.diffuse[p, channel] = gradient * diffuse_albedo
        share = gradient * factor * visibility[p]
        s_x, s_y, s_z = direction_gradient(texels, gradient_near, channel)
        t_x, t_y, t_z = direction_gradient(texels, gradient_far, channel)
        grad_r_x += share * (s_x * (1.0 - gradient_between) + t_x * gradient_between)
        grad_r_y += share * (s_y * (1.0 - gradient_between) + t_y * gradient_between)
        grad_r_z += share * (s_z * (1.0 - gradient_between) + t_z * gradient_between)
        share = gradient * diffuse_albedo * ambient[p]
        s_x, s_y, s_z = direction_gradient(texels, facing, channel)
        grad_n_x += share * s_x
        grad_n_y += share * s_y
        grad_n_z += share * s_z
    # --- the rest of the gradients ---
    if cosine < LEAST_COSINE:  # clamped cosines have no slope
        grad_cosine = 0.0
    along = n_x * grad_r_x + n_y * grad_r_y + n_z * grad_r_z  # dR/dN: R = d - 2 <d, N> N
    out.reflected[p, 0] = 2.0 * (cosine * grad_r_x - along * d_x)
    out.reflected[p, 1] = 2.0 * (cosine * grad_r_y - along * d_y)
    out.reflected[p, 2] = 2.0 * (cosine * grad_r_z - along * d_z)
    out.normal[p, 0] = grad_n_x - grad_cosine * d_x
    out.normal[p, 1] = grad_n_y - grad_cosine * d_y
    out.normal[p, 2] = grad_n_z - grad_cosine * d_z
    out.material[p, 3], out.material[p, 4] = grad_metallic, grad_roughness
    out.visibility[p], out.ambient[p] = grad_visibility, grad_ambient


@kernel(_nrt=False, error_model="numpy")
def backward_pixels(first: int, last: int, backward: ShadeBackward) -> None:
    """Write the gradients of the pixels ``first`` to ``last``."""
    for p in range(first, last):
        backward_pixel(p, backward)


@kernel(error_model="numpy")
def add_to_texels(
    taps: Int32[np.ndarray, "p 12"],
    weights: Float64[np.ndarray, "p 12"],
    specular: Float64[np.ndarray, "p 3"],
    diffuse: Float64[np.ndarray, "p 3"],
    grad_texels: Float64[np.ndarray, "t 3"],
) -> None:
    """Add each pixel's shares to the texels that it asked, pixel after pixel."""
    for p in range(len(taps)):
        for k in range(TAPS):
            weight = weights[p, k]
            if weight == 0.0:  # levels that had no share
                continue
            texel = taps[p, k]
            for channel in range(3):
                gradient = specular[p, channel] if k < 8 else diffuse[p, channel]
                grad_texels[texel, channel] += weight * gradient

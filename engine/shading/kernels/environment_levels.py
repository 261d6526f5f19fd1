"""Prefiltered levels of an environment as fixed linear maps, and the look-up of a direction in them.

Maps are equirectangular: row 0 is up, the middle column forward, right lies to its right; a map is twice as
wide as it is high. Directions here are in the map's own frame: right, up, forward.
"""

import math

import numpy as np
from numba import prange

from octasplat.engine.core.compilation import device_function, kernel
from octasplat.engine.shading.kernels.microfacets import ggx_density

LEAST_SQUARE = 1e-6
"""Nearer than this to a pole, a longitude has no slope."""


@device_function(error_model="numpy", inline="always")
def texel_direction(row, column, height):
    """The middle of a texel."""
    polar = math.pi * (row + 0.5) / height
    longitude = math.pi * ((column + 0.5) / height - 1.0)
    ring = math.sin(polar)
    return ring * math.sin(longitude), math.cos(polar), ring * math.cos(longitude)


@device_function(error_model="numpy")
def lobe_weight(cosine, alpha):
    """What a rough mirror that looks along its normal takes from a direction of that cosine to it.

    GGX's density of the half vector times the cosine; pure cosine where ``alpha`` is negative.
    """
    if cosine <= 0.0:
        return 0.0
    if alpha < 0.0:
        return cosine
    return ggx_density(math.sqrt(0.5 * (1.0 + cosine)), alpha) * cosine


@kernel(parallel=True, error_model="numpy")
def lobe_rows(height, source_height, alpha, least, starts, columns, weights, counting):
    """Each texel of a level as a weighted mean of texels of a map, in compressed sparse rows.

    Args:
        height: rows of the level.
        source_height: rows of the map that it is made from.
        alpha: GGX's; negative for irradiance over pi.
        least: share of the largest weight below which a texel is left out.
        starts: where each row begins; it is written if ``counting``, and else read.
        columns: receives the numbers of the texels.
        weights: receives their weights; they add up to 1.
        counting: whether only ``starts`` is wanted.
    """
    least_weight = least * lobe_weight(1.0, alpha)
    reach = math.pi / 2  # angle at which the weight falls below the least one
    if alpha >= 0.0:
        reach = 0.0
        while reach < math.pi / 2 and lobe_weight(math.cos(reach), alpha) > least_weight:
            reach += 0.002
    texel = math.pi / source_height
    sources = np.empty((source_height, 2 * source_height, 3))
    for j in range(source_height):
        for i in range(2 * source_height):
            sources[j, i] = texel_direction(j, i, source_height)
    starts[0] = 0
    for number in prange(2 * height * height):
        row, column = number // (2 * height), number % (2 * height)
        polar = math.pi * (row + 0.5) / height
        top = max(0, int((polar - reach) / texel - 1.0))
        bottom = min(source_height, int((polar + reach) / texel + 2.0))
        x, y, z = texel_direction(row, column, height)
        total = 0.0
        first = 0 if counting else starts[number]
        place = first
        for j in range(top, bottom):
            ring = math.sin(math.pi * (j + 0.5) / source_height)
            for i in range(2 * source_height):
                weight = lobe_weight(
                    x * sources[j, i, 0] + y * sources[j, i, 1] + z * sources[j, i, 2], alpha
                )
                if weight <= least_weight:
                    continue
                if not counting:
                    columns[place] = j * 2 * source_height + i
                    weights[place] = weight * ring
                    total += weight * ring
                place += 1
        if counting:
            starts[number + 1] = place
        else:
            for k in range(first, place):
                weights[k] /= total
    if counting:
        for number in range(2 * height * height):
            starts[number + 1] += starts[number]


@kernel(parallel=True, error_model="numpy")
def sparse_product(starts, columns, weights, values, out):
    """``out`` = the sparse rows times ``values``, three channels; each sum in the order of its row."""
    for row in prange(len(starts) - 1):
        red = green = blue = 0.0
        for k in range(starts[row], starts[row + 1]):
            column, weight = columns[k], weights[k]
            red += weight * values[column, 0]
            green += weight * values[column, 1]
            blue += weight * values[column, 2]
        out[row, 0], out[row, 1], out[row, 2] = red, green, blue


@device_function(error_model="numpy")
def look_up(texels, offset, height, x, y, z):
    """Bilinear value of a level at a unit direction.

    Returns:
        Numbers of the four texels, the two fractions between them, and the slopes of these by the direction:
        of the column by x and z, of the row by y.
    """
    width = 2 * height
    square = max(x * x + z * z, LEAST_SQUARE)
    across = (0.5 + math.atan2(x, z) / (2.0 * math.pi)) * width - 0.5
    down = math.acos(min(max(y, -1.0), 1.0)) / math.pi * height - 0.5
    column_x, column_z = width / (2.0 * math.pi) * z / square, -width / (2.0 * math.pi) * x / square
    row_y = -height / (math.pi * math.sqrt(square))
    left, top = math.floor(across), math.floor(down)
    fraction_x, fraction_y = across - left, down - top
    first, second = int(left) % width, (int(left) + 1) % width
    upper, lower = int(top), int(top) + 1
    if upper < 0 or lower >= height:
        upper = lower = min(max(upper, 0), height - 1)
        row_y = 0.0
    a, b = offset + upper * width, offset + lower * width
    return a + first, a + second, b + first, b + second, fraction_x, fraction_y, column_x, column_z, row_y

"""Prefiltered levels of an environment as fixed linear maps, and the look-up of a direction in them.

Maps are equirectangular: row 0 is up, the middle column forward, right lies to its right; a map is twice as
wide as it is high. Directions here are in the map's own frame: right, up, forward.
"""

import math
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float, Float32, Float64, Int32, Int64

from octasplat.engine.core.compilation import device_function, kernel
from octasplat.engine.shading.kernels.microfacets import ggx_density

LEAST_SQUARE = 1e-6
"""Nearer than this to a pole, a longitude has no slope."""


Lookup: TypeAlias = tuple[int, int, int, int, float, float, float, float, float]
"""Where a direction lies in a level, see :func:`look_up`."""


class EnvironmentLevels(NamedTuple):
    """All levels one after another, as kernels take them.

    Attributes:
        texels: linear radiance.
        offsets: first texel of each level; the irradiance comes last.
        heights: rows of each level.
        roughnesses: of each level but the last.
    """

    texels: Float32[np.ndarray, "t 3"]
    offsets: Int64[np.ndarray, " l"]
    heights: Int64[np.ndarray, " l"]
    roughnesses: Float64[np.ndarray, " l1"]


@device_function(error_model="numpy", inline="always")
def texel_direction(row: int, column: int, height: int) -> tuple[float, float, float]:
    """Return the middle of a texel."""
    polar = math.pi * (row + 0.5) / height
    longitude = math.pi * ((column + 0.5) / height - 1.0)
    ring = math.sin(polar)
    return ring * math.sin(longitude), math.cos(polar), ring * math.cos(longitude)


@device_function(error_model="numpy")
def lobe_weight(cosine: float, alpha: float) -> float:
    """Return what a rough mirror that looks along its normal takes from a direction of that cosine to it.

    GGX's density of the half vector times the cosine; pure cosine where ``alpha`` is negative.
    """
    if cosine <= 0.0:
        return 0.0
    if alpha < 0.0:
        return cosine
    return ggx_density(math.sqrt(0.5 * (1.0 + cosine)), alpha) * cosine


@device_function(error_model="numpy")
def lobe_reach(alpha: float, least_weight: float) -> float:
    """Return the angle at which a lobe's weight falls below the least one."""
    if alpha < 0.0:
        return math.pi / 2
    reach = 0.0
    while reach < math.pi / 2 and lobe_weight(math.cos(reach), alpha) > least_weight:
        reach += 0.002
    return reach


@kernel(error_model="numpy")
def lobe_rows(
    first_row: int,
    last_row: int,
    height: int,
    source_height: int,
    alpha: float,
    least: float,
    starts: Int64[np.ndarray, " r1"],
    columns: Int32[np.ndarray, " k"],
    weights: Float32[np.ndarray, " k"],
    counting: bool,
) -> None:
    """Write each texel of a level as a weighted mean of texels of a map, in compressed sparse rows.

    Args:
        first_row: the first texel of the level that is written.
        last_row: the one behind the last.
        height: rows of the level.
        source_height: rows of the map that it is made from.
        alpha: GGX's; negative for irradiance over pi.
        least: share of the largest weight below which a texel is left out.
        starts: where each row begins; if ``counting``, its length is written to the place behind, else it is
            read.
        columns: receives the numbers of the texels.
        weights: receives their weights; they add up to 1.
        counting: whether only ``starts`` is wanted.
    """
    least_weight = least * lobe_weight(1.0, alpha)
    reach = lobe_reach(alpha, least_weight)
    texel = math.pi / source_height
    # --- directions of the map's texels ---
    sources = np.empty((source_height, 2 * source_height, 3))
    for j in range(source_height):
        for i in range(2 * source_height):
            sources[j, i] = texel_direction(j, i, source_height)
    for number in range(first_row, last_row):
        row, column = number // (2 * height), number % (2 * height)
        polar = math.pi * (row + 0.5) / height
        # rows of texels within reach of the lobe
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
                    weights[place] = weight * ring  # times the texel's solid angle
                    total += weight * ring
                place += 1
        if counting:
            starts[number + 1] = place
        else:
            for k in range(first, place):
                weights[k] /= total


@kernel(_nrt=False, error_model="numpy")
def sparse_product(
    first: int,
    last: int,
    starts: Int64[np.ndarray, " r1"],
    columns: Int32[np.ndarray, " k"],
    weights: Float32[np.ndarray, " k"],
    values: Float[np.ndarray, "c 3"],
    out: Float[np.ndarray, "r 3"],
) -> None:
    """Write the sparse rows ``first`` to ``last`` times ``values``, three channels, to ``out``.

    Each sum is taken in the order of its row.
    """
    for row in range(first, last):
        red = green = blue = 0.0
        for k in range(starts[row], starts[row + 1]):
            column, weight = columns[k], weights[k]
            red += weight * values[column, 0]
            green += weight * values[column, 1]
            blue += weight * values[column, 2]
        out[row, 0], out[row, 1], out[row, 2] = red, green, blue


@device_function(error_model="numpy")
def look_up(
    texels: Float[np.ndarray, "t 3"], offset: int, height: int, x: float, y: float, z: float
) -> Lookup:
    """Return bilinear value of a level at a unit direction.

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
    if upper < 0 or lower >= height:  # beyond the last row's center: no slope towards the pole
        upper = lower = min(max(upper, 0), height - 1)
        row_y = 0.0
    a, b = offset + upper * width, offset + lower * width
    return a + first, a + second, b + first, b + second, fraction_x, fraction_y, column_x, column_z, row_y

"""Compiled functions of lights: which one to ask, a way to it, and how likely that way was.

``lights`` is :class:`engine.light.lights.LightArrays`; p is the point that is lit. Weights of lights at a
point are what they would bring to a surface that faces them, so that the nearest and strongest is asked
most.
"""

import math

from numba import njit

from engine.trace.kernels_native import lean

POINT, SPOT, DIRECTIONAL, RECTANGLE, ENVIRONMENT = 0, 1, 2, 3, 4
FAR = 1e30


@lean(forceinline=True)
def luminance(red, green, blue):
    """Of linear Rec. 709 values."""
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


@lean(forceinline=True)
def _cone(lights, l, way_x, way_y, way_z):
    """How much of a spot's intensity goes a way (a unit vector from the light)."""
    axis = lights.axes[l]
    cosine = axis[0] * way_x + axis[1] * way_y + axis[2] * way_z
    outer, inner = lights.cosines[l, 0], lights.cosines[l, 1]
    share = min(max((cosine - outer) / (inner - outer), 0.0), 1.0)
    return share * share


@lean(forceinline=True)
def light_weight(lights, l, p_x, p_y, p_z):
    """About the irradiance that a light gives to a surface at p that faces it; 0 only where it gives none."""
    power = luminance(lights.rgb_linear[l, 0], lights.rgb_linear[l, 1], lights.rgb_linear[l, 2])
    kind = lights.kinds[l]
    if kind in (DIRECTIONAL, ENVIRONMENT):
        return power
    way_x = p_x - lights.positions_world[l, 0]
    way_y = p_y - lights.positions_world[l, 1]
    way_z = p_z - lights.positions_world[l, 2]
    squared = max(way_x * way_x + way_y * way_y + way_z * way_z, 1e-20)
    if kind == RECTANGLE:
        axis = lights.axes[l]
        if axis[0] * way_x + axis[1] * way_y + axis[2] * way_z <= 0.0:
            return 0.0
        return power * lights.areas[l] / (squared + lights.areas[l] / math.pi)
    if kind == SPOT:
        distance = math.sqrt(squared)
        power *= _cone(lights, l, way_x / distance, way_y / distance, way_z / distance)
    return power / squared


@lean(forceinline=True)
def pick_light(lights, p_x, p_y, p_z, u):
    """A light and the probability with which it is asked at p; -1 where none shines."""
    count = len(lights.kinds)
    if count == 1:
        return (0, 1.0) if light_weight(lights, 0, p_x, p_y, p_z) > 0.0 else (-1, 0.0)
    total = 0.0
    for l in range(count):
        total += light_weight(lights, l, p_x, p_y, p_z)
    if not total > 0.0:
        return -1, 0.0
    left, found, share = u * total, -1, 0.0
    for l in range(count):
        weight = light_weight(lights, l, p_x, p_y, p_z)
        if weight > 0.0:
            found, share = l, weight / total  # the last one that shines, should rounding leave a rest
            left -= weight
            if left < 0.0:
                break
    return found, share


@lean(forceinline=True)
def light_share(lights, wanted, p_x, p_y, p_z):
    """The probability with which :func:`pick_light` asks the light ``wanted`` at p."""
    total, own = 0.0, 0.0
    for l in range(len(lights.kinds)):
        weight = light_weight(lights, l, p_x, p_y, p_z)
        total += weight
        if l == wanted:
            own = weight
    return own / total if total > 0.0 else 0.0


@lean(forceinline=True)
def sample_light(lights, l, p_x, p_y, p_z, u, v):
    """A way from p to a light: unit direction, distance, linear radiance, density over solid angle.

    A density of 0 marks light that comes from one direction only: in place of radiance there is irradiance.
    """
    kind = lights.kinds[l]
    rgb = lights.rgb_linear[l]
    if kind == ENVIRONMENT:
        d_x, d_y, d_z, pdf = sample_environment(lights, u, v)
        red, green, blue = environment_radiance(lights, d_x, d_y, d_z)
        return d_x, d_y, d_z, FAR, red, green, blue, pdf
    axis = lights.axes[l]
    if kind == DIRECTIONAL:
        return -axis[0], -axis[1], -axis[2], FAR, rgb[0], rgb[1], rgb[2], 0.0
    way_x = lights.positions_world[l, 0] - p_x
    way_y = lights.positions_world[l, 1] - p_y
    way_z = lights.positions_world[l, 2] - p_z
    if kind == RECTANGLE:
        a, b = u - 0.5, v - 0.5
        way_x += a * lights.sides_u[l, 0] + b * lights.sides_v[l, 0]
        way_y += a * lights.sides_u[l, 1] + b * lights.sides_v[l, 1]
        way_z += a * lights.sides_u[l, 2] + b * lights.sides_v[l, 2]
    squared = max(way_x * way_x + way_y * way_y + way_z * way_z, 1e-20)
    distance = math.sqrt(squared)
    way_x, way_y, way_z = way_x / distance, way_y / distance, way_z / distance
    if kind == RECTANGLE:
        cosine = -(axis[0] * way_x + axis[1] * way_y + axis[2] * way_z)
        if cosine <= 1e-9:
            return way_x, way_y, way_z, distance, 0.0, 0.0, 0.0, 1.0
        pdf = squared / (cosine * lights.areas[l])
        return way_x, way_y, way_z, distance, rgb[0], rgb[1], rgb[2], pdf
    falloff = 1.0 / squared
    if kind == SPOT:
        falloff *= _cone(lights, l, -way_x, -way_y, -way_z)
    return way_x, way_y, way_z, distance, rgb[0] * falloff, rgb[1] * falloff, rgb[2] * falloff, 0.0


@lean(forceinline=True)
def _environment_place(lights, d_x, d_y, d_z):
    """Where a direction lies in the map, (u, v) from 0 to 1, and the sine of its angle to up."""
    frame = lights.environment_frame
    right = frame[0, 0] * d_x + frame[0, 1] * d_y + frame[0, 2] * d_z
    up = frame[1, 0] * d_x + frame[1, 1] * d_y + frame[1, 2] * d_z
    forward = frame[2, 0] * d_x + frame[2, 1] * d_y + frame[2, 2] * d_z
    sine = math.sqrt(right * right + forward * forward)
    return 0.5 + math.atan2(right, forward) / (2.0 * math.pi), math.atan2(sine, up) / math.pi, sine


@lean(forceinline=True)
def environment_radiance(lights, d_x, d_y, d_z):
    """Linear radiance from a direction: bilinear between the map's pixels, round at its sides."""
    radiance = lights.environment_linear
    height, width, _ = radiance.shape
    u, v, _ = _environment_place(lights, d_x, d_y, d_z)
    x, y = u * width - 0.5, min(max(v * height - 0.5, 0.0), height - 1.0)
    i, j = math.floor(x), min(int(y), max(height - 2, 0))
    x, y = x - i, y - j
    left, right = int(i) % width, (int(i) + 1) % width
    low = min(j + 1, height - 1)
    a, b, c, d = (1.0 - x) * (1.0 - y), x * (1.0 - y), (1.0 - x) * y, x * y
    red = (
        a * radiance[j, left, 0]
        + b * radiance[j, right, 0]
        + c * radiance[low, left, 0]
        + d * radiance[low, right, 0]
    )
    green = (
        a * radiance[j, left, 1]
        + b * radiance[j, right, 1]
        + c * radiance[low, left, 1]
        + d * radiance[low, right, 1]
    )
    blue = (
        a * radiance[j, left, 2]
        + b * radiance[j, right, 2]
        + c * radiance[low, left, 2]
        + d * radiance[low, right, 2]
    )
    return red, green, blue


@lean(forceinline=True)
def environment_density(lights, d_x, d_y, d_z):
    """Density over solid angle with which :func:`sample_environment` gives a direction."""
    shares = lights.environment_shares
    height, width = shares.shape
    u, v, sine = _environment_place(lights, d_x, d_y, d_z)
    i, j = min(int(u * width), width - 1), min(int(v * height), height - 1)
    return shares[j, i] * width * height / (2.0 * math.pi * math.pi * max(sine, 1e-9))


@lean(forceinline=True)
def _step(sums, u):
    """The step of a cumulative sum from 0 to 1 in which u lies, and how far in."""
    low, high = 0, len(sums) - 1
    while high - low > 1:
        middle = (low + high) // 2
        if sums[middle] <= u:
            low = middle
        else:
            high = middle
    span = sums[low + 1] - sums[low]
    return low, min(max((u - sums[low]) / span, 0.0), 1.0 - 1e-9) if span > 0.0 else 0.5


@lean(forceinline=True)
def sample_environment(lights, u, v):
    """A direction, likelier where the map is brighter, and its density over solid angle."""
    height, width = lights.environment_shares.shape
    j, down = _step(lights.environment_rows, v)
    i, across = _step(lights.environment_columns[j], u)
    polar = (j + down) / height * math.pi
    around = ((i + across) / width - 0.5) * 2.0 * math.pi
    sine = math.sin(polar)
    right, up, forward = sine * math.sin(around), math.cos(polar), sine * math.cos(around)
    frame = lights.environment_frame
    d_x = right * frame[0, 0] + up * frame[1, 0] + forward * frame[2, 0]
    d_y = right * frame[0, 1] + up * frame[1, 1] + forward * frame[2, 1]
    d_z = right * frame[0, 2] + up * frame[1, 2] + forward * frame[2, 2]
    pdf = lights.environment_shares[j, i] * width * height / (2.0 * math.pi * math.pi * max(sine, 1e-9))
    return d_x, d_y, d_z, pdf


@njit(cache=True, error_model="numpy")
def environment_values(lights, directions, radiance, density):
    """Radiance and density of rows of directions."""
    for n in range(len(directions)):
        d = directions[n]
        radiance[n, 0], radiance[n, 1], radiance[n, 2] = environment_radiance(lights, d[0], d[1], d[2])
        density[n] = environment_density(lights, d[0], d[1], d[2])


@njit(cache=True, error_model="numpy")
def light_samples(lights, points, numbers, directions, distances, radiance, density, lights_asked):
    """:func:`pick_light` and :func:`sample_light` at rows of points with three uniform numbers each.

    ``density`` and, of light that comes from one direction only, ``radiance`` hold the choice of the light.
    """
    for n in range(len(points)):
        p = points[n]
        l, share = pick_light(lights, p[0], p[1], p[2], numbers[n, 0])
        lights_asked[n] = l
        if l < 0:
            radiance[n], density[n] = 0.0, 0.0
            continue
        d_x, d_y, d_z, distance, red, green, blue, pdf = sample_light(
            lights, l, p[0], p[1], p[2], numbers[n, 1], numbers[n, 2]
        )
        directions[n, 0], directions[n, 1], directions[n, 2] = d_x, d_y, d_z
        distances[n], density[n] = distance, pdf * share
        factor = 1.0 if pdf > 0.0 else 1.0 / share
        radiance[n, 0], radiance[n, 1], radiance[n, 2] = red * factor, green * factor, blue * factor

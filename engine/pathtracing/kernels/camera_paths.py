"""Paths at the camera: a place in the pixel, a place on the lens, and the way from there."""

import math

import numpy as np
from jaxtyping import Float32

from octasplat.engine.core.compilation import kernel
from octasplat.engine.pathtracing.kernels.kernel_args import IntegratorParameters, Vec3
from octasplat.engine.pathtracing.kernels.path_args import (
    BLOCK_SIZE,
    CAMERA_SAMPLE_PAIRS,
    PathArrays,
    PathScratch,
    PathStart,
)
from octasplat.engine.pathtracing.kernels.principled_bsdf import orthonormal_basis
from octasplat.engine.pathtracing.kernels.sampler import fill_pairs, pixel_key
from octasplat.engine.pathtracing.kernels.scatter import FLAG_CAMERA_RAY, FLAG_CLEAR
from octasplat.engine.pathtracing.kernels.surface import normalize
from octasplat.engine.trace.kernels.native import fill_bytes, njit_no_refcount


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def _fill_camera_samples(
    scratch: PathScratch, seed: int, start: PathStart, place: int, number: int, count: int, pairs: int
) -> None:
    """Write keys, sample numbers and ``pairs`` of uniform numbers of ``count`` paths, at most a block.

    The first of them is number ``number`` of the pixel at ``place``.
    """
    count = min(count, BLOCK_SIZE)
    key = pixel_key(seed, start.pixel_order[start.first_pixel + place])
    for n in range(count):
        if number == start.paths_per_pixel:
            place, number = place + 1, 0
            key = pixel_key(seed, start.pixel_order[start.first_pixel + place])
        scratch.keys[n], scratch.samples[n] = key, start.first_sample + number
        number += 1
    fill_pairs(scratch.keys, scratch.samples, count, 0, scratch.random_numbers[:pairs])


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def _pixel_slopes(directions: Float32[np.ndarray, "h w 3"], y: int, x: int) -> tuple[Vec3, Vec3]:
    """Return how the direction changes over the width and the height of a pixel, by its neighbors."""
    height, width, _ = directions.shape
    left, right = max(x - 1, 0), min(x + 1, width - 1)
    high, low = max(y - 1, 0), min(y + 1, height - 1)
    # two pixels apart, or one at the picture's edges
    along = 0.5 if right - left == 2 else 1.0
    down = 0.5 if low - high == 2 else 1.0
    a, b = directions[y, left], directions[y, right]
    c, d = directions[high, x], directions[low, x]
    return (
        (along * (b[0] - a[0]), along * (b[1] - a[1]), along * (b[2] - a[2])),
        (down * (d[0] - c[0]), down * (d[1] - c[1]), down * (d[2] - c[2])),
    )


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def _write_pixel_directions(
    scratch: PathScratch, start: PathStart, first: int, count: int, anti_aliasing: bool
) -> None:
    """Write the directions of ``count`` paths from ``first`` on, each through a place in its pixel.

    Beside a pixel's centre the direction follows the slopes between the neighbors, which is right for any
    lens to the second order in a pixel.
    """
    directions, numbers = start.camera_rays.directions_world, scratch.random_numbers
    width = directions.shape[1]
    place, number = first // start.paths_per_pixel, first % start.paths_per_pixel
    begin = 0
    while begin < count:
        pixel = start.pixel_order[start.first_pixel + place]
        centre = directions[pixel // width, pixel % width]
        c_x, c_y, c_z = float(centre[0]), float(centre[1]), float(centre[2])
        (a_x, a_y, a_z), (b_x, b_y, b_z) = _pixel_slopes(directions, pixel // width, pixel % width)
        end = min(begin + start.paths_per_pixel - number, count)
        for n in range(begin, end):
            d_x, d_y, d_z = c_x, c_y, c_z
            if anti_aliasing:
                u, v = numbers[0, 0, n] - 0.5, numbers[0, 1, n] - 0.5
                d_x, d_y, d_z = normalize(
                    c_x + u * a_x + v * b_x, c_y + u * a_y + v * b_y, c_z + u * a_z + v * b_z
                )
            scratch.directions[n, 0], scratch.directions[n, 1], scratch.directions[n, 2] = d_x, d_y, d_z
        begin, place, number = end, place + 1, 0


@njit_no_refcount(forceinline=True)
def reset_paths(paths: PathArrays, first: int, count: int, flags: int) -> None:
    """Start ``count`` paths, all but their rays: no radiance yet, unit throughput, in air.

    One array after the other, as each path has a row in twenty of them.
    """
    for array in (
        paths.radiance_linear, paths.layer_srgb, paths.shading_factor, paths.albedo_linear,
        paths.normals_world,
    ):  # fmt: skip
        row_bytes = array.shape[1] * array.itemsize
        fill_bytes(array.ctypes.data + first * row_bytes, count * row_bytes, 0)
    for numbers in (paths.mesh_visibility, paths.pdf, paths.t_view_origin):
        fill_bytes(numbers.ctypes.data + first * numbers.itemsize, count * numbers.itemsize, 0)
    # -1 has all bits set
    ids, media = paths.medium_ids, paths.media
    row_bytes = media.shape[1] * media.itemsize
    fill_bytes(ids.ctypes.data + first * ids.itemsize, count * ids.itemsize, 255)
    fill_bytes(media.ctypes.data + first * row_bytes, count * row_bytes, 255)
    for k in range(first, first + count):
        paths.transmittance[k] = 1.0
    for k in range(first, first + count):
        paths.coverage[k] = 1.0
    for k in range(first, first + count):
        paths.flags[k] = flags
    for k in range(first, first + count):
        paths.is_alive[k] = True
    for k in range(first, first + count):
        paths.throughput[k, 0] = paths.throughput[k, 1] = paths.throughput[k, 2] = 1.0


@kernel(_nrt=False, error_model="numpy", fastmath={"contract"})
def start_paths(
    first: int,
    last: int,
    scratch: PathScratch,
    integrator: IntegratorParameters,
    start: PathStart,
    paths: PathArrays,
) -> None:
    """Start the paths ``first`` to ``last`` of those that ``start`` describes."""
    camera, numbers = start.camera_rays, scratch.random_numbers
    axis = camera.axis
    across_x, across_y, across_z, up_x, up_y, up_z = orthonormal_basis(axis[0], axis[1], axis[2])
    pairs = CAMERA_SAMPLE_PAIRS if camera.aperture > 0.0 else 1  # without a lens none for the place on it
    for begin in range(first, last, BLOCK_SIZE):
        # --- places in pixels ---
        count = min(last - begin, BLOCK_SIZE)
        place, number = begin // start.paths_per_pixel, begin % start.paths_per_pixel
        _fill_camera_samples(scratch, integrator.seed, start, place, number, count, pairs)
        _write_pixel_directions(scratch, start, begin, count, integrator.anti_aliasing)
        reset_paths(paths, begin, count, FLAG_CLEAR | FLAG_CAMERA_RAY)
        for n in range(count):
            k = np.uintp(begin + n)  # unsigned: no place is counted from the end of an array
            direction = scratch.directions[n]
            d_x, d_y, d_z = float(direction[0]), float(direction[1]), float(direction[2])
            # --- a place on the lens ---
            o_x, o_y, o_z = camera.origin_world[0], camera.origin_world[1], camera.origin_world[2]
            if camera.aperture > 0.0:
                u, v = numbers[1, 0, n], numbers[1, 1, n]
                # evenly over the disc
                radius, angle = 0.5 * camera.aperture * math.sqrt(u), 2.0 * math.pi * v
                a, b = radius * math.cos(angle), radius * math.sin(angle)
                l_x, l_y, l_z = a * across_x + b * up_x, a * across_y + b * up_y, a * across_z + b * up_z
                # the plane in focus is across the axis: t is longer for oblique rays
                forward = d_x * axis[0] + d_y * axis[1] + d_z * axis[2]
                t = camera.focus_distance / max(forward, 1e-6)
                o_x, o_y, o_z = o_x + l_x, o_y + l_y, o_z + l_z
                d_x, d_y, d_z = normalize(t * d_x - l_x, t * d_y - l_y, t * d_z - l_z)
            paths.keys[k], paths.samples[k] = scratch.keys[n], scratch.samples[n]
            paths.origins_world[k, 0], paths.origins_world[k, 1], paths.origins_world[k, 2] = o_x, o_y, o_z
            paths.directions_world[k, 0] = d_x
            paths.directions_world[k, 1] = d_y
            paths.directions_world[k, 2] = d_z

"""Paths at the camera: a place in the pixel, a place on the lens, and the way from there."""

import math

import numpy as np
from jaxtyping import Float32

from octasplat.engine.core.compilation import kernel
from octasplat.engine.pathtracing.kernels.kernel_args import IntegratorParameters, Vec3
from octasplat.engine.pathtracing.kernels.path_args import (
    BLOCK_SIZE,
    CAMERA_SAMPLE_PAIRS,
    MAX_NESTED,
    PathArrays,
    PathScratch,
    PathStart,
)
from octasplat.engine.pathtracing.kernels.principled_bsdf import orthonormal_basis
from octasplat.engine.pathtracing.kernels.sampler import fill_pairs, pixel_key
from octasplat.engine.pathtracing.kernels.scatter import FLAG_CAMERA_RAY, FLAG_CLEAR
from octasplat.engine.pathtracing.kernels.surface import normalize
from octasplat.engine.trace.kernels.native import njit_no_refcount


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
def reset_path(paths: PathArrays, k: int, origin: Vec3, direction: Vec3, flags: int) -> None:
    """Start a path: no radiance yet, unit throughput."""
    paths.origins_world[k, 0], paths.origins_world[k, 1], paths.origins_world[k, 2] = origin
    paths.directions_world[k, 0], paths.directions_world[k, 1], paths.directions_world[k, 2] = direction
    for channel in range(3):
        paths.throughput[k, channel], paths.radiance_linear[k, channel] = 1.0, 0.0
        paths.layer_srgb[k, channel], paths.shading_factor[k, channel] = 0.0, 0.0
        paths.albedo_linear[k, channel], paths.normals_world[k, channel] = 0.0, 0.0
    paths.transmittance[k], paths.coverage[k], paths.mesh_visibility[k] = 1.0, 1.0, 0.0
    paths.pdf[k], paths.t_view_origin[k], paths.medium_ids[k] = 0.0, 0.0, -1
    for place in range(MAX_NESTED):
        paths.media[k, place] = -1
    paths.flags[k], paths.is_alive[k] = flags, True


@kernel(_nrt=False, error_model="numpy", fastmath={"contract"})
def start_paths(
    first: int,
    last: int,
    scratch: PathScratch,
    integrator: IntegratorParameters,
    start: PathStart,
    paths: PathArrays,
) -> None:
    """Start the paths ``first`` to ``last`` of those that ``start`` describes.

    Beside a pixel's centre the direction follows the slopes between the neighbours, which is right for any
    lens to the second order in a pixel.
    """
    camera, numbers = start.camera_rays, scratch.random_numbers
    directions, axis = camera.directions_world, camera.axis
    width = directions.shape[1]
    across_x, across_y, across_z, up_x, up_y, up_z = orthonormal_basis(axis[0], axis[1], axis[2])
    # --- the pixel: its place in the order, the number of the path in it, direction and slopes ---
    pairs = CAMERA_SAMPLE_PAIRS if camera.aperture > 0.0 else 1  # without a lens none for the place on it
    place, number = first // start.paths_per_pixel, first % start.paths_per_pixel - 1
    pixel = start.pixel_order[start.first_pixel + place]
    centre = directions[pixel // width, pixel % width]
    (a_x, a_y, a_z), (b_x, b_y, b_z) = _pixel_slopes(directions, pixel // width, pixel % width)
    for k in range(first, last):
        n = (k - first) % BLOCK_SIZE
        number += 1
        if number == start.paths_per_pixel:
            place, number = place + 1, 0
        if n == 0:
            _fill_camera_samples(scratch, integrator.seed, start, place, number, last - k, pairs)
        if number == 0:
            pixel = start.pixel_order[start.first_pixel + place]
            centre = directions[pixel // width, pixel % width]
            (a_x, a_y, a_z), (b_x, b_y, b_z) = _pixel_slopes(directions, pixel // width, pixel % width)
        paths.keys[k], paths.samples[k] = scratch.keys[n], scratch.samples[n]
        # --- a place in the pixel ---
        d_x, d_y, d_z = float(centre[0]), float(centre[1]), float(centre[2])
        if integrator.anti_aliasing:
            u, v = numbers[0, 0, n] - 0.5, numbers[0, 1, n] - 0.5
            d_x, d_y, d_z = normalize(
                d_x + u * a_x + v * b_x, d_y + u * a_y + v * b_y, d_z + u * a_z + v * b_z
            )
        # --- a place on the lens ---
        o_x, o_y, o_z = camera.origin_world[0], camera.origin_world[1], camera.origin_world[2]
        if camera.aperture > 0.0:
            u, v = numbers[1, 0, n], numbers[1, 1, n]
            radius, angle = 0.5 * camera.aperture * math.sqrt(u), 2.0 * math.pi * v  # evenly over the disc
            a, b = radius * math.cos(angle), radius * math.sin(angle)
            l_x, l_y, l_z = a * across_x + b * up_x, a * across_y + b * up_y, a * across_z + b * up_z
            # the plane in focus is across the axis: t is longer for oblique rays
            forward = d_x * axis[0] + d_y * axis[1] + d_z * axis[2]
            t = camera.focus_distance / max(forward, 1e-6)
            o_x, o_y, o_z = o_x + l_x, o_y + l_y, o_z + l_z
            d_x, d_y, d_z = normalize(t * d_x - l_x, t * d_y - l_y, t * d_z - l_z)
        reset_path(paths, k, (o_x, o_y, o_z), (d_x, d_y, d_z), FLAG_CLEAR | FLAG_CAMERA_RAY)

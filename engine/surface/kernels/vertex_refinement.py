"""Pixels as means over a mesh's corners: what they show, and what that says of the corners."""

import math

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32

from octasplat.engine.core.compilation import kernel

MIN_COSINE = 0.15
"""Pixels that see a triangle more from the side say nothing of where it lies."""


@kernel()
def linearise(
    first: int,
    last: int,
    vertices: Float32[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    sizes: Float[np.ndarray, " n"],
    rgb: Float32[np.ndarray, "n 3"],
    corners: Int32[np.ndarray, "p 3"],
    weights: Float32[np.ndarray, "p 3"],
    directions: Float32[np.ndarray, "p 3"],
    steady: Bool[np.ndarray, " p"],
    change: Float32[np.ndarray, "p 3"],
    lifts: Float32[np.ndarray, "p 3"],
) -> None:
    """Write how each pixel's color changes as its triangle moves by one along its normal, and who moves it.

    The point that the ray meets then moves along the ray by one over the cosine, and with it the color. A
    vertex moves by its ``sizes`` along its own normal; ``lifts`` is by how much that moves the triangle.
    """
    for p in range(first, last):
        i, j, k = corners[p, 0], corners[p, 1], corners[p, 2]
        ax, ay, az = np.float64(vertices[i, 0]), np.float64(vertices[i, 1]), np.float64(vertices[i, 2])
        ux, uy, uz = vertices[j, 0] - ax, vertices[j, 1] - ay, vertices[j, 2] - az
        vx, vy, vz = vertices[k, 0] - ax, vertices[k, 1] - ay, vertices[k, 2] - az
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        area = max(math.sqrt(nx * nx + ny * ny + nz * nz), 1e-20)
        nx, ny, nz = nx / area, ny / area, nz / area
        dx, dy, dz = np.float64(directions[p, 0]), np.float64(directions[p, 1]), np.float64(directions[p, 2])
        for c in range(3):
            corner = corners[p, c]
            facing = normals[corner, 0] * nx + normals[corner, 1] * ny + normals[corner, 2] * nz
            lifts[p, c] = weights[p, c] * sizes[corner] * facing
            change[p, c] = 0.0
        cosine = nx * dx + ny * dy + nz * dz
        if not steady[p] or abs(cosine) <= MIN_COSINE:  # unsteady pixels or oblique ones move nothing
            continue
        # gradients of the barycentric weights along the ray's direction
        grad_u = ((vy * nz - vz * ny) * dx + (vz * nx - vx * nz) * dy + (vx * ny - vy * nx) * dz) / area
        grad_v = ((ny * uz - nz * uy) * dx + (nz * ux - nx * uz) * dy + (nx * uy - ny * ux) * dz) / area
        for c in range(3):
            step = (rgb[j, c] - rgb[i, c]) * grad_u + (rgb[k, c] - rgb[i, c]) * grad_v
            change[p, c] = step / cosine


@kernel()
def apply_jacobian(
    first: int,
    last: int,
    corners: Int32[np.ndarray, "p 3"],
    weights: Float32[np.ndarray, "p 3"],
    lifts: Float32[np.ndarray, "p 3"],
    change: Float32[np.ndarray, "p 3"],
    values: Float32[np.ndarray, "n 4"],
    pixels: Float32[np.ndarray, "p 3"],
) -> None:
    """Write the colors of pixels for ``values`` of vertices: red, green, blue and how far they move."""
    for p in range(first, last):
        red = green = blue = moved = np.float32(0.0)
        for c in range(3):
            i, weight = corners[p, c], weights[p, c]
            red += weight * values[i, 0]
            green += weight * values[i, 1]
            blue += weight * values[i, 2]
            moved += lifts[p, c] * values[i, 3]
        pixels[p, 0] = red + change[p, 0] * moved
        pixels[p, 1] = green + change[p, 1] * moved
        pixels[p, 2] = blue + change[p, 2] * moved


@kernel()
def apply_jacobian_transpose(
    corners: Int32[np.ndarray, "p 3"],
    weights: Float32[np.ndarray, "p 3"],
    lifts: Float32[np.ndarray, "p 3"],
    change: Float32[np.ndarray, "p 3"],
    pixels: Float32[np.ndarray, "p 3"],
    values: Float32[np.ndarray, "n 4"],
) -> None:
    """Add the transpose of :func:`apply_jacobian` to ``values``; one thread, so that sums have one order."""
    for p in range(len(corners)):
        red, green, blue = pixels[p, 0], pixels[p, 1], pixels[p, 2]
        moved = change[p, 0] * red + change[p, 1] * green + change[p, 2] * blue
        for c in range(3):
            i, weight = corners[p, c], weights[p, c]
            values[i, 0] += weight * red
            values[i, 1] += weight * green
            values[i, 2] += weight * blue
            values[i, 3] += lifts[p, c] * moved


@kernel()
def jacobian_diagonal(
    corners: Int32[np.ndarray, "p 3"],
    weights: Float32[np.ndarray, "p 3"],
    lifts: Float32[np.ndarray, "p 3"],
    change: Float32[np.ndarray, "p 3"],
    sure: Float32[np.ndarray, " p"],
    values: Float32[np.ndarray, "n 4"],
) -> None:
    """Add the diagonal of the normal equations to ``values``.

    That is :func:`apply_jacobian_transpose` after :func:`apply_jacobian`, pixels weighted by ``sure``.
    """
    for p in range(len(corners)):
        strength = change[p, 0] ** 2 + change[p, 1] ** 2 + change[p, 2] ** 2
        for c in range(3):
            i, square = corners[p, c], weights[p, c] ** 2 * sure[p]
            for channel in range(3):
                values[i, channel] += square
            values[i, 3] += lifts[p, c] ** 2 * strength * sure[p]

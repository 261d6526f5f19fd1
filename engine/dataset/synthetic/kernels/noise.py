"""Compiled inner loops of the generated scene: gradient noise, and interpolation on triangles."""

import numpy as np
from jaxtyping import Float32, Int

from octasplat.engine.core.compilation import device_function, kernel


@device_function(inline="always")
def _hash(x: int, y: int, z: int, seed: int) -> np.uint32:
    """Return 32 well mixed bits of an integer lattice point."""
    h = np.uint32(x) * np.uint32(0x8DA6B343) ^ np.uint32(y) * np.uint32(0xD8163841)
    h = np.uint32(h) ^ np.uint32(z) * np.uint32(0xCB1AB31F) ^ np.uint32(seed) * np.uint32(0x9E3779B1)
    # Numba widens 32-bit integers in arithmetic, so that each step is cut back to 32 bits.
    h = np.uint32(h)
    # Finalizer [15 2c1b3c6d 12 297a2d39 15] of Wellons' hash-prospector
    h = np.uint32((h ^ (h >> np.uint32(15))) * np.uint32(0x2C1B3C6D))
    h = np.uint32((h ^ (h >> np.uint32(12))) * np.uint32(0x297A2D39))
    return np.uint32(h ^ (h >> np.uint32(15)))


@kernel()
def hash_cells(cells: Int[np.ndarray, "n 3"], seed: int, out: Float32[np.ndarray, " n"]) -> None:
    """Write a number in [0, 1) of every integer cell (n, 3), into ``out`` (n,)."""
    for i in range(cells.shape[0]):
        # The upper 24 bits: as many as a float32 holds exactly
        out[i] = np.float32(_hash(cells[i, 0], cells[i, 1], cells[i, 2], seed) >> np.uint32(8)) / np.float32(
            1 << 24
        )


@device_function(inline="always")
def _gradient_dot(h: np.uint32, dx: np.float32, dy: np.float32, dz: np.float32) -> np.float32:
    """Return the height at an offset from a lattice point, on the plane that the hash gives to that point."""
    scale = np.float32(1.0 / 511.5)  # 10 bits a component, to [-1, 1]
    gx = np.float32(h & np.uint32(1023)) * scale - np.float32(1)
    gy = np.float32((h >> np.uint32(10)) & np.uint32(1023)) * scale - np.float32(1)
    gz = np.float32((h >> np.uint32(20)) & np.uint32(1023)) * scale - np.float32(1)
    return gx * dx + gy * dy + gz * dz


@kernel()
def fractal_noise(
    points: Float32[np.ndarray, "n 3"], octaves: int, seed: int, out: Float32[np.ndarray, " n"]
) -> None:
    """Write the sum of ``octaves`` gradient noises, each twice as fine and half as strong."""
    one = np.float32(1)
    for i in range(points.shape[0]):
        total = np.float32(0)
        strength = np.float32(1.25)
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        for octave in range(octaves):
            fx, fy, fz = np.floor(px), np.floor(py), np.floor(pz)
            ix, iy, iz = np.int32(fx), np.int32(fy), np.int32(fz)
            x, y, z = px - fx, py - fy, pz - fz
            # Quintic blending: second derivatives are continuous, so lattice planes do not show.
            wx = x * x * x * (x * (x * np.float32(6) - np.float32(15)) + np.float32(10))
            wy = y * y * y * (y * (y * np.float32(6) - np.float32(15)) + np.float32(10))
            wz = z * z * z * (z * (z * np.float32(6) - np.float32(15)) + np.float32(10))
            s = seed + octave * 101
            a = _gradient_dot(_hash(ix, iy, iz, s), x, y, z)
            b = _gradient_dot(_hash(ix + 1, iy, iz, s), x - one, y, z)
            c = _gradient_dot(_hash(ix, iy + 1, iz, s), x, y - one, z)
            d = _gradient_dot(_hash(ix + 1, iy + 1, iz, s), x - one, y - one, z)
            near = (a + (b - a) * wx) + ((c + (d - c) * wx) - (a + (b - a) * wx)) * wy
            a = _gradient_dot(_hash(ix, iy, iz + 1, s), x, y, z - one)
            b = _gradient_dot(_hash(ix + 1, iy, iz + 1, s), x - one, y, z - one)
            c = _gradient_dot(_hash(ix, iy + 1, iz + 1, s), x, y - one, z - one)
            d = _gradient_dot(_hash(ix + 1, iy + 1, iz + 1, s), x - one, y - one, z - one)
            far = (a + (b - a) * wx) + ((c + (d - c) * wx) - (a + (b - a) * wx)) * wy
            total += strength * (near + (far - near) * wz)
            strength *= np.float32(0.5)
            # Not 2, or the zeros of all octaves at lattice points would fall together
            px, py, pz = px * np.float32(2.03), py * np.float32(2.03), pz * np.float32(2.03)
        out[i] = total


@kernel()
def interpolate_attributes(
    attributes: Float32[np.ndarray, "v k"],
    faces: Int[np.ndarray, "f 3"],
    face_ids: Int[np.ndarray, " n"],
    u: Float32[np.ndarray, " n"],
    v: Float32[np.ndarray, " n"],
    out: Float32[np.ndarray, "n k"],
) -> None:
    """Interpolate vertex attributes (vertices, k) at barycentric coordinates (u, v) on faces."""
    width = attributes.shape[1]
    for i in range(face_ids.shape[0]):
        a, b, c = faces[face_ids[i], 0], faces[face_ids[i], 1], faces[face_ids[i], 2]
        w = np.float32(1) - u[i] - v[i]
        for k in range(width):
            out[i, k] = w * attributes[a, k] + u[i] * attributes[b, k] + v[i] * attributes[c, k]

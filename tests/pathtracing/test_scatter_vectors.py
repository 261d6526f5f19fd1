"""Samples of a lamp and diffuse ways on, of eight rows at a time: those of the functions for one row."""

from pathlib import Path

import numba
import numpy as np

from octasplat.engine.pathtracing.compile_meshes import compile_meshes
from octasplat.engine.pathtracing.kernels.lights import light_samples
from octasplat.engine.pathtracing.kernels.principled_bsdf import orthonormal_basis, sample_cosine
from octasplat.engine.pathtracing.kernels.scatter_vectors import (
    LAMP_SAMPLE_ROWS,
    WAY_ROWS,
    write_diffuse_ways8,
    write_lamp_samples8,
)
from octasplat.engine.pathtracing.kernels.surface import offset_ray_origin
from octasplat.engine.pathtracing.kernels.surface_point_vectors import RAY_STEP_ROW, SURFACE_POINT_ROWS
from octasplat.engine.pathtracing.stage.model import RectangleLight, Stage

COUNT = 64


@numba.njit
def lamp_rows(points, numbers, lights, out):
    row_bytes, u, v = 8 * points.shape[1], numbers[0].ctypes.data, numbers[1].ctypes.data
    for i in range(0, points.shape[1], 8):
        write_lamp_samples8(
            points.ctypes.data + 8 * i, row_bytes, u + 8 * i, v + 8 * i, lights.positions_world.ctypes.data,
            lights.sides_u.ctypes.data, lights.sides_v.ctypes.data, lights.axes.ctypes.data,
            lights.areas.ctypes.data, out.ctypes.data + 8 * i,
        )  # fmt: skip


@numba.njit
def way_rows(points, numbers, out):
    row_bytes, u, v = 8 * points.shape[1], numbers[0].ctypes.data, numbers[1].ctypes.data
    for i in range(0, points.shape[1], 8):
        write_diffuse_ways8(
            points.ctypes.data + 8 * i, row_bytes, u + 8 * i, v + 8 * i, out.ctypes.data + 8 * i
        )


def surface_points() -> np.ndarray:
    """Points in front of and behind a lamp, with unit normals."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(SURFACE_POINT_ROWS, COUNT))
    points[3:6] /= np.linalg.norm(points[3:6], axis=0)
    points[6:9] /= np.linalg.norm(points[6:9], axis=0)
    return points


def test_samples_of_a_lamp_are_those_of_one_row() -> None:
    lamp = RectangleLight(
        position=(0.2, -0.5, 0.1), direction=(0.1, 1, 0.2), width=1.5, height=0.7, radiance=3
    )
    lights = compile_meshes(Stage(lights=(lamp,)), Path(), threads=1).scene.lights
    points, numbers = surface_points(), np.random.default_rng(1).random((3, COUNT))
    out = np.empty((LAMP_SAMPLE_ROWS, COUNT))
    lamp_rows(points, numbers[1:], lights, out)
    origins = np.array(
        [offset_ray_origin.py_func(*points[:6, n], points[RAY_STEP_ROW, n]) for n in range(COUNT)]
    )
    np.testing.assert_allclose(out[:3].T, origins, rtol=1e-13)
    directions, radiance = np.empty((2, COUNT, 3))
    distances, density = np.empty((2, COUNT))
    asked = np.empty(COUNT, np.int64)
    light_samples(lights, origins, numbers.T.copy(), directions, distances, radiance, density, asked)
    shines = radiance[:, 0] > 0.0
    assert 10 < shines.sum() < COUNT - 10
    np.testing.assert_allclose(out[3:6].T, directions, rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(out[6], distances, rtol=1e-12)
    np.testing.assert_allclose(out[7, shines], density[shines], rtol=1e-11)
    assert not out[7, ~shines].any()


def test_diffuse_ways_are_those_of_one_row() -> None:
    points, numbers = surface_points(), np.random.default_rng(2).random((2, COUNT))
    # the ends of the ranges, and normals along an axis
    numbers[0, :2], numbers[1, :8] = (0.0, 1.0 - 2.0**-24), np.arange(8) / 8
    points[6:9, :2] = np.array([[0, 0, 1], [0, 0, -1]]).T
    out = np.empty((WAY_ROWS, COUNT))
    way_rows(points, numbers, out)
    for n in range(COUNT):
        frame = np.append(orthonormal_basis.py_func(*points[6:9, n]), points[6:9, n]).reshape(3, 3)
        local = np.array(cosine_sample(*numbers[:, n]))
        np.testing.assert_allclose(out[:3, n], local @ frame, rtol=1e-12, atol=1e-14)
        np.testing.assert_allclose(out[3, n], local[2] / np.pi, rtol=1e-14)
    np.testing.assert_allclose(np.linalg.norm(out[:3], axis=0), 1.0, rtol=1e-9)


@numba.njit
def cosine_sample(u, v):
    return sample_cosine(u, v)

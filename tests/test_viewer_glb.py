"""What of a scene is written for viewers, which frame the bounding box of all that they get."""

import math
from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.files import read_mesh
from octasplat.engine.files.glb_surface import write_surface
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.octagon import CHI2_2_99
from octasplat.engine.geometry.triangle_mesh import TriangleMesh
from octasplat.engine.render.upright import upright_frame
from octasplat.engine.runs.viewer_glb import photographed

FOCUS = np.zeros(3)


def scene(means: np.ndarray, sigma: float = 0.01) -> FlatGaussians:
    count = len(means)
    return FlatGaussians(
        means.astype(np.float32),
        np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        np.full((count, 2), np.log(sigma), np.float32),
        np.full(count, 4, np.float32),
        np.zeros((count, 1, 3), np.float32),
    )


@pytest.fixture
def object_points() -> np.ndarray:
    return np.random.default_rng(0).uniform(-1, 1, (1000, 3))


def test_gaussians_far_behind_are_left_out(object_points: np.ndarray) -> None:
    sky = np.random.default_rng(1).uniform(50, 100, (300, 3))
    kept = photographed(scene(np.concatenate([object_points, sky])), FOCUS, 4.0, CHI2_2_99)
    assert kept[:1000].all() and not kept[1000:].any()


def test_floaters_between_the_cameras_do_not_widen_the_box(object_points: np.ndarray) -> None:
    floaters = np.array([[3.5, 0, 0], [0, -3.5, 0]])
    kept = photographed(scene(np.concatenate([object_points, floaters])), FOCUS, 4.0, CHI2_2_99)
    assert kept[:1000].all() and not kept[1000:].any()


def test_octagons_that_reach_out_of_the_box_are_left_out(object_points: np.ndarray) -> None:
    gaussians = scene(np.concatenate([object_points, np.zeros((1, 3))]))
    gaussians.log_scales[-1, 0] = np.log(2.0)
    kept = photographed(gaussians, FOCUS, 4.0, CHI2_2_99)
    assert kept[:1000].all() and not kept[1000]


def test_all_stay_where_hardly_any_lie_among_the_cameras(object_points: np.ndarray) -> None:
    assert photographed(scene(object_points + 100), FOCUS, 4.0, CHI2_2_99).all()


def test_cameras_without_a_common_point_leave_outliers_out(object_points: np.ndarray) -> None:
    outliers = np.array([[1000.0, 0, 0], [0, 0, -900.0]])
    kept = photographed(scene(np.concatenate([object_points, outliers])), FOCUS, math.inf, CHI2_2_99)
    assert kept[:1000].all() and not kept[1000:].any()


def test_upright_frame_has_up_against_gravity_and_the_cameras_in_front() -> None:
    # Cameras in a row along x at y = -5 look along +y, in a world whose z is up.
    rotation = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    centres = np.array([[x, -5.0, 0.5] for x in (-2.0, 0.0, 2.0)])
    frame = upright_frame(np.tile(rotation, (3, 1, 1)), centres, FOCUS)
    np.testing.assert_allclose(frame, [[1, 0, 0], [0, 0, 1], [0, -1, 0]], atol=1e-6)


@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), (500_000.0, 4_000_000.0, 10.0)])
def test_turned_surface_is_read_back_where_it_was(tmp_path: Path, origin: tuple[float, float, float]) -> None:
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    mesh = TriangleMesh(corners, faces, np.full((4, 3), 0.5, np.float32), origin_world=origin)
    write_surface(mesh, tmp_path / "plain.glb")
    write_surface(mesh, tmp_path / "turned.glb", (0.5, 0.5, 0.5, 0.5))
    plain, turned = (read_mesh(tmp_path / name) for name in ("plain.glb", "turned.glb"))
    np.testing.assert_allclose(turned.vertices, plain.vertices, atol=1e-6 * (1 + max(origin)))

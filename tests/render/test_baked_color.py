"""One color for each Gaussian in place of colors that change with the direction."""

import numpy as np
import pytest

from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.spherical_harmonics import sh_basis
from octasplat.engine.render.bake_color import colors_along, fit_colors_to_cameras, with_constant_color
from octasplat.engine.render.pinhole_camera import PinholeCamera
from octasplat.engine.render.pose_paths import turntable
from octasplat.engine.render.renderer import render_rays
from octasplat.engine.trace.factory import make_tracer
from octasplat.engine.trace.protocol import TraceSettings


def cloud(count: int) -> FlatGaussians:
    random = np.random.default_rng(2)
    sh = 0.25 * random.standard_normal((count, 4, 3)).astype(np.float32)
    return FlatGaussians(
        random.uniform(-1, 1, (count, 3)).astype(np.float32),
        random.standard_normal((count, 4)).astype(np.float32),
        random.uniform(-2.5, -1.5, (count, 2)).astype(np.float32),
        random.uniform(-1, 3, count).astype(np.float32),
        sh,
    )


def cameras(count: int) -> list[PinholeCamera]:
    poses = turntable(np.zeros(3), np.array([0.0, -1, 0]), 4.0, 1.0, count)
    return [PinholeCamera.from_pose(pose, 40, 30, fy_px=40.0) for pose in poses[: count // 4]]


def test_baked_color_equals_harmonics() -> None:
    gaussians, direction = cloud(20), np.array([1.0, 2.0, -2.0])
    expected = 0.5 + np.einsum("k,nkc->nc", sh_basis(direction / 3, 1), gaussians.sh)
    np.testing.assert_allclose(colors_along(gaussians, direction), np.maximum(expected, 0), atol=1e-6)
    plain = with_constant_color(gaussians, colors_along(gaussians, direction))
    np.testing.assert_allclose(plain.base_rgb_srgb, np.maximum(expected, 0), atol=1e-6)
    assert plain.sh_degree == 0


def test_baked_color_is_mean_over_views() -> None:
    gaussians = cloud(1)
    gaussians.means_world[:] = 0
    seen = cameras(4)  # one camera
    away = seen[0].centre_world / np.linalg.norm(seen[0].centre_world)
    half = np.array([1 + away[0], *np.cross([1.0, 0, 0], away)])  # the normal, axis x, towards it
    gaussians.quats_wxyz[:] = half / np.linalg.norm(half)
    tracer = make_tracer(TraceSettings(), threads=1)
    found = fit_colors_to_cameras(gaussians, tracer, [camera.rays for camera in seen], steps=0)
    expected = colors_along(gaussians, -seen[0].centre_world)
    assert np.abs(expected - gaussians.base_rgb_srgb).max() > 0.05
    np.testing.assert_allclose(found, np.clip(expected, 0, 1), atol=1e-5)


@pytest.mark.parametrize("threads", [1, 2])
def test_baked_color_is_closest_to_render(threads: int) -> None:
    gaussians, seen = cloud(300), cameras(32)
    tracer = make_tracer(TraceSettings(), threads=threads)
    images = [camera.rays for camera in seen]

    def error(scene: FlatGaussians) -> float:
        shown = []
        for each in (gaussians, scene):
            tracer.build(each)
            shown.append([render_rays(tracer, image(), np.zeros(3, np.float32)).rgb_srgb for image in images])
        return float(np.mean((np.array(shown[0]) - np.array(shown[1])) ** 2))

    means = with_constant_color(gaussians, fit_colors_to_cameras(gaussians, tracer, images, steps=0))
    least = with_constant_color(gaussians, fit_colors_to_cameras(gaussians, tracer, images))
    assert error(least) < 0.85 * error(means)
    assert error(means) < error(gaussians.with_base_color_only())
    again = with_constant_color(
        gaussians, fit_colors_to_cameras(gaussians, make_tracer(TraceSettings(), threads=1), images)
    )
    assert again.sh.tobytes() == least.sh.tobytes()

"""Renders at smaller sizes: blocks of pixels, rays through their middles, and several rays a pixel."""

import numpy as np
import pytest

from octasplat.engine.core.rays import ImageRays
from octasplat.engine.evaluate.multiscale import block_means, downscale_rays
from octasplat.engine.evaluate.view_metrics import depth_spread
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.render.pinhole_camera import PinholeCamera
from octasplat.engine.render.renderer import render_rays
from octasplat.engine.render.supersampling import pixel_angle, rays_per_pixel_side, render_averaged
from octasplat.engine.shading.plain import PLAIN_SHADING
from octasplat.engine.trace.cpu.tracer import CpuTracer
from octasplat.engine.trace.protocol import TraceSettings

BLACK = np.zeros(3, np.float32)


def camera(width: int, height: int) -> ImageRays:
    pose = np.eye(4)
    return PinholeCamera.from_pose(pose, width, height, fy_px=float(height)).rays()


def stripes() -> FlatGaussians:
    """Thin bright bars one after another across, some pixels of the large picture apart."""
    x = np.linspace(-0.5, 0.5, 41)
    means = np.stack([x, np.zeros(41), np.full(41, 1.0)], axis=1).astype(np.float32)
    half = float(np.sqrt(0.5))
    return FlatGaussians(
        means_world=means,
        quats_wxyz=np.tile(np.array([half, 0, -half, 0], np.float32), (41, 1)),
        log_scales=np.tile(np.log(np.array([0.6, 0.003], np.float32)), (41, 1)),
        opacity_logits=np.full(41, 4.0, np.float32),
        sh=np.full((41, 1, 3), 1.5, np.float32),
    )


def test_rays_of_a_smaller_picture_are_those_of_a_camera_with_fewer_pixels() -> None:
    np.testing.assert_allclose(
        downscale_rays(camera(64, 48), 4).directions_world, camera(16, 12).directions_world, rtol=0, atol=3e-4
    )
    assert block_means(np.arange(35, dtype=np.float32).reshape(5, 7, 1), 2)[..., 0].tolist() == [
        [4.0, 6.0, 8.0],
        [18.0, 20.0, 22.0],
    ]


def test_supersampling_equals_downscaling() -> None:
    tracer = CpuTracer(TraceSettings(), threads=1)
    tracer.build(stripes())
    large = camera(256, 192)
    wanted = block_means(render_rays(tracer, large, BLACK).rgb_srgb, 8)
    errors = [
        float(
            np.abs(
                render_averaged(tracer, downscale_rays(large, 8), BLACK, PLAIN_SHADING, side).rgb_srgb
                - wanted
            ).mean()
        )
        for side in (1, 4, 8)
    ]
    assert errors[2] < 0.01 < errors[0]
    assert errors[2] < errors[1] < errors[0]


def test_pixels_larger_than_those_of_the_training_get_more_rays() -> None:
    trained = pixel_angle(camera(256, 192))
    assert trained == pytest.approx(1 / 192, rel=1e-4)
    sides = [rays_per_pixel_side(camera(256 // n, 192 // n), trained) for n in (1, 2, 4, 8)]
    assert sides == [1, 2, 4, 4]
    assert rays_per_pixel_side(camera(512, 384), trained) == 1
    assert rays_per_pixel_side(camera(32, 24), 0.0) == 1


def test_depths_spread_where_there_is_more_than_a_surface() -> None:
    median = np.array([[2.0, 2.0, 2.0, 0.0]], np.float32)
    mean = np.array([[2.1, 1.7, 2.0, 0.4]], np.float32)
    assert depth_spread(mean, median) == pytest.approx(1 / 3)
    assert depth_spread(mean, np.zeros_like(median)) is None


def test_depths_under_a_mask_do_not_count() -> None:
    mean, median = np.float32([[1, 2, 3, 9]]), np.float32([[1, 1, 3, 0]])
    assert depth_spread(mean, median, np.float32([[1, 0, 1, 1]])) == 0
    assert depth_spread(mean, median, np.float32([[1, 1, 0, 1]])) == pytest.approx(1 / 2)
    assert depth_spread(mean, median, np.float32([[0, 0, 0, 1]])) is None

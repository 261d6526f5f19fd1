"""Normals at outlines are those of the thing in front, not a mean of it and of what stands behind."""

import numpy as np

from octasplat.engine.gaussians.frames import frames_from_normals, quaternions_from_matrices
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.render.pinhole_camera import PinholeCamera
from octasplat.engine.render.renderer import background_color, front_normals, render_rays
from octasplat.engine.trace.factory import make_tracer
from octasplat.engine.trace.protocol import TraceSettings

SIDE = 33


def test_normals_are_of_the_surface_in_front() -> None:
    tilted = np.array([np.sin(0.6), 0.0, -np.cos(0.6)])
    normals = np.stack([[0.0, 0.0, -1.0], tilted])
    scene = FlatGaussians(
        means_world=np.array([[0, 0, 2], [0, 0, 4]], np.float32),
        quats_wxyz=quaternions_from_matrices(frames_from_normals(normals)).astype(np.float32),
        log_scales=np.log(np.array([[0.25, 0.25], [20.0, 20.0]], np.float32)),
        opacity_logits=np.array([3.0, 6.0], np.float32),
        sh=np.zeros((2, 1, 3), np.float32),
    )
    tracer = make_tracer(TraceSettings(), threads=1)
    tracer.build(scene)
    rays = PinholeCamera.from_pose(np.eye(4), SIDE, SIDE, fy_px=SIDE).rays()
    image = render_rays(tracer, rays, background_color("black"))
    found = front_normals(tracer, rays, image.depth_median)
    np.testing.assert_allclose(np.linalg.norm(found, axis=2), 1, atol=1e-5)
    distance = np.linalg.norm(rays.rays.directions_world.reshape(SIDE, SIDE, 3)[..., 2:], axis=2)
    front = image.depth_median * distance < 3
    assert 20 < front.sum() < SIDE * SIDE / 2
    np.testing.assert_allclose(found[front], np.broadcast_to(normals[0], found[front].shape), atol=1e-5)
    assert np.abs(image.normal_world[front] - normals[0]).max() > 0.1  # which the mean mixes
    outside = image.depth > 3.9  # past the front one altogether
    outside &= np.abs(image.normal_world - tilted).max(axis=2) < 1e-6
    assert outside.any()
    np.testing.assert_allclose(found[outside], np.broadcast_to(tilted, found[outside].shape), atol=1e-5)


def test_front_normals_missed_rays_are_zero() -> None:
    scene = FlatGaussians(
        means_world=np.array([[0, 0, -2]], np.float32),
        quats_wxyz=np.array([[1, 0, 0, 0]], np.float32),
        log_scales=np.zeros((1, 2), np.float32),
        opacity_logits=np.zeros(1, np.float32),
        sh=np.zeros((1, 1, 3), np.float32),
    )
    tracer = make_tracer(TraceSettings(), threads=1)
    tracer.build(scene)
    rays = PinholeCamera.from_pose(np.eye(4), 8, 8, fy_px=8).rays()
    assert (front_normals(tracer, rays, np.zeros((8, 8), np.float32)) == 0).all()

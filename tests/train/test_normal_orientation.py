"""Which side of a Gaussian is out: the one from which the training views see it."""

import numpy as np

from octasplat.engine.trace.factory import make_tracer
from octasplat.engine.train.views.normal_orientation import orient_normals
from tests.support.planar_dataset import PlanarDataset


def test_normals_seen_from_behind_are_flipped() -> None:
    world = PlanarDataset()
    gaussians = world.initial_gaussians(opacity=0.6)
    rng = np.random.default_rng(5)
    gaussians.quats_wxyz = rng.normal(size=(len(gaussians), 4)).astype(np.float32)
    before = gaussians.select(np.arange(len(gaussians)))
    tracer = make_tracer()
    tracer.build(gaussians, np.zeros((len(gaussians), 3), np.float32))
    rays = world.rays(np.zeros(300, np.int64), rng.integers(0, 40, 300), rng.integers(0, 40, 300))
    as_before = tracer.trace(rays)

    turned = orient_normals(gaussians, world, world.train_indices, tracer)

    assert 100 < len(turned) < 200  # about half of 300
    np.testing.assert_allclose(
        gaussians.rotations[turned][:, :, 0], -before.rotations[turned][:, :, 0], atol=1e-6
    )
    others = np.setdiff1d(np.arange(len(gaussians)), turned)
    assert np.array_equal(gaussians.quats_wxyz[others], before.quats_wxyz[others])
    # The cameras stand at z = -2: but for those seen at grazing angles, normals now point there.
    steep = np.abs(gaussians.rotations[:, 2, 0]) > 0.5
    assert (gaussians.rotations[steep, 2, 0] < 0).all()
    tracer.refresh(turned)
    seen = tracer.trace(rays)
    for name in ("rgb_srgb", "transmittance", "depth_sum", "normal_world"):
        np.testing.assert_allclose(getattr(seen, name), getattr(as_before, name), atol=2e-5)
    assert len(orient_normals(gaussians, world, world.train_indices, tracer)) == 0

"""Gaussians among fixed ones: one scene to look at, gradients for the former alone."""

import numpy as np

from octasplat.engine.gaussians.model import concatenate
from octasplat.engine.trace.factory import make_tracer
from octasplat.engine.trace.fixed_gaussians import PartlyFixedTracer
from octasplat.engine.trace.protocol import TraceGradients, TraceSettings
from tests.support.trace_scenes import PARAMETERS, make_cloud, rays_inwards


def test_fixed_gaussians_are_seen_and_get_no_gradients() -> None:
    rng = np.random.default_rng(5)
    own, around = make_cloud(rng, 40, degree=1), make_cloud(rng, 70, degree=2)
    tracer = PartlyFixedTracer(make_tracer(TraceSettings(), threads=1), around)
    tracer.build(own)
    own.means_world += np.float32(0.02)
    own.sh *= np.float32(0.5)
    tracer.refresh(np.arange(40, dtype=np.int32))
    cut = around.copy()
    cut.sh = cut.sh[:, :4]
    whole = make_tracer(TraceSettings(), threads=1)
    whole.build(concatenate([own, cut]))
    rays = rays_inwards(rng, 300)
    found, wanted = tracer.trace(rays, record=True), whole.trace(rays, record=True)
    np.testing.assert_allclose(found.rgb_srgb, wanted.rgb_srgb, atol=1e-6)
    np.testing.assert_allclose(tracer.transmittance(rays), whole.transmittance(rays), atol=1e-6)
    assert found.recording is not None and wanted.recording is not None
    by = TraceGradients(rng.normal(size=found.rgb_srgb.shape).astype(np.float32))
    mine, all_of_it = tracer.backward(found.recording, by), whole.backward(wanted.recording, by).numpy()
    is_own = all_of_it.ids < 40
    np.testing.assert_array_equal(mine.ids, all_of_it.ids[is_own])
    assert 0 < is_own.sum() < len(is_own)
    for name in PARAMETERS:
        np.testing.assert_allclose(
            getattr(mine, name), getattr(all_of_it, name)[is_own], rtol=1e-4, atol=1e-5
        )

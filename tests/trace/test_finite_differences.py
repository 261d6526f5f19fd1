"""Gradients of the twin and of the tracer against central differences of the twin, in float64."""

import numpy as np
import pytest
import torch

from octasplat.engine.trace.protocol import TraceGradients
from octasplat.engine.trace.reference import ReferenceParameters, trace_reference
from tests.support.trace_scenes import (
    OUTPUTS,
    PARAMETERS,
    f32,
    make_cloud,
    make_tracer,
    random_gradients,
    rays_inwards,
    reference_gradients,
    reference_loss,
    scattered,
)

pytestmark = pytest.mark.usefixtures("both_ways")


STEP = 1e-6


@pytest.mark.parametrize("output", [*OUTPUTS, None])
def test_gradients_of_all_parameters(output: str | None) -> None:
    rng = np.random.default_rng(3)
    cloud = make_cloud(rng, 6, degree=1, size=0.4, radius=0.3, logits=(-1.5, 2.0))
    features = f32(rng.normal(size=(6, 1)))
    rays = rays_inwards(rng, 30)
    tracer = make_tracer(cloud, features)
    given = random_gradients(rng, 30, 1)
    if output is not None:  # through one output alone
        zeros = {name: np.zeros_like(getattr(given, name)) for name in OUTPUTS}
        given = TraceGradients(**{**zeros, output: getattr(given, output)})

    parameters = ReferenceParameters.from_gaussians(cloud, features)
    result = trace_reference(parameters, rays, tracer.settings)
    twin = reference_gradients(parameters, result, given)
    seen = tracer.trace(rays, record=True)
    assert seen.recording is not None
    ours = scattered(tracer.backward(seen.recording, given), 6)

    for name in PARAMETERS:
        leaf = getattr(parameters, name).detach()
        setattr(parameters, name, leaf)
        differences = np.zeros(leaf.numel())
        flat = leaf.view(-1)
        for k in range(leaf.numel()):
            losses = []
            for step in (STEP, -STEP):
                kept = flat[k].item()
                flat[k] = kept + step
                with torch.no_grad():
                    moved = trace_reference(parameters, rays, tracer.settings)
                    losses.append(reference_loss(moved, given).item())
                flat[k] = kept
            differences[k] = (losses[0] - losses[1]) / (2 * STEP)
        expected = differences.reshape(leaf.shape)
        scale = max(np.abs(expected).max(), 1e-3)
        assert np.abs(twin[name] - expected).max() < 1e-5 * scale, name
        assert np.abs(ours[name] - expected).max() < 1e-4 * scale, name

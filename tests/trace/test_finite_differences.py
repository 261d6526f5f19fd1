"""Gradients of the twin and of the tracer against central differences of the twin, in float64."""

import numpy as np
import pytest
import torch

from octasplat.engine.core.rays import RayBatch
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.trace.protocol import TraceGradients, TraceSettings
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

RAYS, GAUSSIANS = 30, 6
STEP = 1e-6
CASES = (*OUTPUTS, None)
"""Gradients through one output alone, and through all of them."""


@pytest.fixture(scope="module")
def scene() -> tuple[FlatGaussians, np.ndarray, RayBatch, TraceGradients]:
    """A small cloud, its features, rays into it, and gradients by all that they see."""
    rng = np.random.default_rng(3)
    cloud = make_cloud(rng, GAUSSIANS, degree=1, size=0.4, radius=0.3, logits=(-1.5, 2.0))
    features = f32(rng.normal(size=(GAUSSIANS, 1)))
    return cloud, features, rays_inwards(rng, RAYS), random_gradients(rng, RAYS, 1)


def through(output: str | None, given: TraceGradients) -> TraceGradients:
    """Return gradients that are zero but for those of one output."""
    if output is None:
        return given
    zeros = {name: np.zeros_like(getattr(given, name)) for name in OUTPUTS}
    return TraceGradients(**{**zeros, output: getattr(given, output)})


@pytest.fixture(scope="module")
def differences(scene: tuple) -> dict[str | None, dict[str, np.ndarray]]:
    """Central differences of each case's loss by each parameter; all cases take them from the same traces."""
    cloud, features, rays, given = scene
    parameters = ReferenceParameters.from_gaussians(cloud, features)
    cases = [through(output, given) for output in CASES]
    found: dict[str | None, dict[str, np.ndarray]] = {output: {} for output in CASES}
    for name in PARAMETERS:
        leaf = getattr(parameters, name).detach()
        setattr(parameters, name, leaf)
        flat = leaf.view(-1)
        rows = np.zeros((len(flat), len(cases)))
        for k in range(len(flat)):
            losses = []
            for step in (STEP, -STEP):
                kept = flat[k].item()
                flat[k] = kept + step
                with torch.no_grad():
                    moved = trace_reference(parameters, rays, TraceSettings())
                    losses.append([reference_loss(moved, case).item() for case in cases])
                flat[k] = kept
            rows[k] = np.subtract(*losses) / (2 * STEP)
        for column, output in enumerate(CASES):
            found[output][name] = rows[:, column].reshape(leaf.shape)
    return found


@pytest.mark.usefixtures("both_ways")
@pytest.mark.parametrize("output", CASES)
def test_gradients_of_all_parameters(scene: tuple, differences: dict, output: str | None) -> None:
    cloud, features, rays, everything = scene
    given = through(output, everything)
    tracer = make_tracer(cloud, features)
    assert tracer.settings == TraceSettings()  # those of the differences
    parameters = ReferenceParameters.from_gaussians(cloud, features)
    twin = reference_gradients(parameters, trace_reference(parameters, rays, tracer.settings), given)
    seen = tracer.trace(rays, record=True)
    assert seen.recording is not None
    ours = scattered(tracer.backward(seen.recording, given), GAUSSIANS)
    for name, expected in differences[output].items():
        scale = max(np.abs(expected).max(), 1e-3)
        assert np.abs(twin[name] - expected).max() < 1e-5 * scale, name
        assert np.abs(ours[name] - expected).max() < 1e-4 * scale, name

"""Gradients by rays against autograd of the reference implementation and central differences of it."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from octasplat.engine.core.rays import AT_INFINITY, RayBatch
from octasplat.engine.gaussians.spherical_harmonics import sh_basis, sh_basis_gradients
from octasplat.engine.trace.protocol import TraceGradients, TraceSettings
from octasplat.engine.trace.ray_gradients import ray_gradients
from octasplat.engine.trace.ray_hits import dominant_gaussians
from octasplat.engine.trace.reference import ReferenceParameters, trace_reference
from octasplat.engine.trace.reference_tracer import ReferenceTracer
from tests.support.daily import some_daily
from tests.support.trace_scenes import (
    OUTPUTS,
    f32,
    hit_lists,
    make_cloud,
    make_tracer,
    random_gradients,
    rays_inwards,
    unit,
)

STEP = 1e-4
"""Rays are float32: smaller steps would be lost in their rounding."""


def moved_losses(
    cloud: object, rays: RayBatch, name: str, given: TraceGradients, settings: TraceSettings
) -> np.ndarray:
    """Central differences of each ray's own loss by three components, through float64 rays."""
    parameters = ReferenceParameters.from_gaussians(cloud)
    found = np.zeros((len(rays), 3))
    for axis in range(3):
        losses, places = [], []
        for sign in (1, -1):
            array = getattr(rays, name).copy()
            array[:, axis] += sign * STEP
            places.append(array[:, axis].astype(np.float64))
            with torch.no_grad():
                result = trace_reference(parameters, replace(rays, **{name: array}), settings)
                losses.append(
                    sum(
                        (getattr(result, out).numpy() * getattr(given, out))
                        .reshape(len(rays), -1)
                        .sum(axis=1)
                        for out in OUTPUTS
                        if getattr(given, out) is not None
                    )
                )
        found[:, axis] = (losses[0] - losses[1]) / (places[0] - places[1])
    return found


def test_harmonics_gradient_matches_finite_differences(rng: np.random.Generator) -> None:
    directions = rng.normal(size=(20, 3))
    slopes = sh_basis_gradients(directions, 3)
    for axis in range(3):
        step = 1e-6 * np.eye(3)[axis]
        differences = (sh_basis(directions + step, 3) - sh_basis(directions - step, 3)) / 2e-6
        np.testing.assert_allclose(slopes[..., axis], differences, atol=1e-8)


@pytest.mark.parametrize("output", [*OUTPUTS[:-1], None])
@pytest.mark.parametrize("viewer", some_daily([0.0, -1.5, AT_INFINITY], [-1.5]))
def test_ray_gradients_equal_differences_of_the_reference(output: str | None, viewer: float) -> None:
    rng = np.random.default_rng(3)
    cloud = make_cloud(rng, 6, degree=3, size=0.5, radius=0.3, logits=(-1.5, 2.0))
    rays = replace(rays_inwards(rng, 60), t_view_origin=np.full(1, viewer))
    tracer = make_tracer(cloud)
    given = random_gradients(rng, 60)
    if output is not None:
        zeros = {name: np.zeros_like(getattr(given, name)) for name in OUTPUTS}
        given = TraceGradients(**{**zeros, output: getattr(given, output)})
    seen = tracer.trace(rays, record=True)
    assert seen.recording is not None
    ours = ray_gradients(cloud, rays, seen.recording, given, tracer.settings)
    for name in ("origins_world", "directions_world"):
        expected, found = moved_losses(cloud, rays, name, given, tracer.settings), getattr(ours, name)
        errors = np.abs(found - expected).max(axis=1) / max(np.abs(expected).max(), 1e-3)
        # A step across an octagon's edge or the half of the median is no slope: few rays may make one.
        assert np.sort(errors)[-4] < 2e-3, (name, np.sort(errors)[-6:])
        assert np.abs(found).max() > 0 or np.abs(expected).max() < 1e-6


@pytest.mark.usefixtures("both_ways")
def test_moving_all_rays_is_moving_all_gaussians_back(rng: np.random.Generator) -> None:
    cloud = make_cloud(rng, 300, degree=2, size=0.2)
    features = f32(rng.normal(size=(300, 2)))
    camera = f32([[0.0, 0.0, -3.0]])
    directions = f32(unit(rng.normal(size=(200, 3)) * [0.2, 0.2, 0.0] + [0, 0, 1]))
    rays = RayBatch(camera, directions)
    tracer = make_tracer(cloud, features)
    seen = tracer.trace(rays, record=True)
    assert seen.recording is not None
    given = random_gradients(rng, 200, 2)
    ours = ray_gradients(cloud, rays, seen.recording, given, tracer.settings, features)
    gaussians = tracer.backward(seen.recording, given)
    np.testing.assert_allclose(
        ours.origins_world.sum(axis=0), -gaussians.means_world.sum(axis=0), rtol=2e-3, atol=2e-3
    )


def test_gaussian_right_at_the_viewer_has_the_gradient_of_the_kernels(rng: np.random.Generator) -> None:
    cloud = replace(
        make_cloud(rng, 1, degree=2, size=0.5, logits=(0.5, 1.0)), means_world=f32([[0.0, 0.0, 1.0]])
    )
    rays = RayBatch(f32([[0.0, 0.0, 0.0]]), f32([[0.0, 0.0, 1.0]]), t_view_origin=np.ones(1, np.float32))
    tracer = make_tracer(cloud)
    seen = tracer.trace(rays, record=True)
    assert seen.recording is not None and seen.transmittance[0] < 1
    given = random_gradients(rng, 1)
    ours = ray_gradients(cloud, rays, seen.recording, given, tracer.settings)
    moved = tracer.backward(seen.recording, given).means_world
    np.testing.assert_allclose(ours.origins_world, -moved, rtol=2e-3, atol=1e-5)


@pytest.mark.usefixtures("both_ways")
def test_hits_by_ray_are_those_of_each_ray(rng: np.random.Generator) -> None:
    cloud = make_cloud(rng, 200)
    ways = f32(unit(rng.normal(size=(70, 3)) * 0.3 + [0, 0, 1]))
    for rays in (rays_inwards(rng, 50), RayBatch(f32([[0.0, 0.0, -3.0]]), ways)):
        seen = make_tracer(cloud).trace(rays, record=True)
        assert seen.recording is not None
        counts, ids = seen.recording.ids_by_ray()
        assert [part.tolist() for part in np.split(ids, np.cumsum(counts)[:-1])] == hit_lists(seen)


def test_heaviest_gaussian_of_each_ray_has_the_largest_weight(rng: np.random.Generator) -> None:
    cloud = make_cloud(rng, 40, size=0.2)
    rays = rays_inwards(rng, 80, spread=2.0)
    tracer, reference = make_tracer(cloud), ReferenceTracer()
    seen = tracer.trace(rays, record=True)
    assert seen.recording is not None
    found = dominant_gaussians(cloud, rays, seen.recording, tracer.settings)
    # The weights of all Gaussians at once: one feature for each of them.
    reference.build(cloud, np.eye(40, dtype=np.float32))
    weights = reference.trace(rays).features
    met = weights.sum(axis=1) > 0
    assert met.any() and not met.all()
    assert (found[met] == weights[met].argmax(axis=1)).all()
    assert (found[~met] == -1).all()

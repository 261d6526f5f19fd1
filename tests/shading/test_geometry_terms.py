"""Materials of neighbouring rays held together: the gradient against finite differences of the sum."""

import numpy as np
import pytest

from octasplat.engine.core.rays import RayBatch
from octasplat.engine.shading.geometry_losses import (
    DARK_METAL_ALBEDO,
    HUBER_DELTA,
    add_dark_metal_gradient,
    add_depth_normal_gradient,
    add_material_smoothness_gradient,
)
from octasplat.engine.shading.protocol import TracedRays
from octasplat.engine.shading.ray_patches import RayPatches
from octasplat.engine.trace.factory import make_tracer
from octasplat.engine.trace.protocol import TraceResult, TraceSettings
from octasplat.engine.train.sampling.pixel_sampler import PixelSampler

SIDE, METAL = 3, 10.0
WEIGHTS = (0.02, 0.03, 0.04, 0.2, 0.3)
CELLS = [(0, 0), (0, 1), (1, 0), (1, 1), (0, 2), (1, 2), (2, 0), (2, 1), (2, 2)]
"""Row and column of each ray of a window: along a Z."""
MIDDLE = CELLS.index((1, 1))


def in_rows(values: np.ndarray) -> np.ndarray:
    """Values of a window's rays by row and column."""
    grid = np.empty((SIDE, SIDE, *values.shape[1:]), values.dtype)
    for cell, value in zip(CELLS, values, strict=True):
        grid[cell] = value
    return grid


def sight(features: np.ndarray, alpha: np.ndarray) -> TracedRays:
    count = len(alpha)
    flat, rows = np.zeros(count, np.float32), np.zeros((count, 3), np.float32)
    seen = TraceResult(
        rows,
        (1 - alpha).astype(np.float32),
        flat,
        flat,
        rows,
        features.astype(np.float32),
        np.zeros(count, np.int32),
    )
    rays = RayBatch(np.zeros((1, 3)), np.tile([0.0, 0.0, 1.0], (count, 1)))
    tracer = make_tracer(TraceSettings(), threads=1)
    return TracedRays(rays, seen, tracer, np.zeros(count, np.int64), ray_patches=RayPatches(0, 1, SIDE))


def penalty(features: np.ndarray, alpha: np.ndarray, metallic: np.ndarray) -> float:
    """The sum whose gradient is asked for; ``metallic`` weighs the albedo and is held."""
    material, metal = in_rows(features / alpha[:, None]), in_rows(metallic)
    total = 0.0
    for (y, x), (v, u) in [
        ((y, x), (y + down, x + 1 - down))
        for down in (0, 1) for y in range(SIDE - down) for x in range(SIDE - 1 + down)
    ]:  # fmt: skip
        size = np.sqrt((material[y, x] - material[v, u]) ** 2 + HUBER_DELTA**2)
        size[:3] *= 1 + METAL * min(metal[y, x], metal[v, u]) ** 2
        total += float((size * WEIGHTS).sum())
    return total / SIDE**2


def test_geometry_gradient_with_metals_fixed() -> None:
    rng = np.random.default_rng(0)
    alpha = rng.uniform(0.92, 1.0, SIDE**2).astype(np.float32).astype(np.float64)
    features = (rng.uniform(0, 1, (SIDE**2, 5)) * alpha[:, None]).astype(np.float32).astype(np.float64)
    metallic = features[:, 3] / alpha
    by_features, by_alpha = np.zeros_like(features), np.zeros_like(alpha)
    add_material_smoothness_gradient(sight(features, alpha), WEIGHTS, METAL, by_features, by_alpha)
    step = 1e-4
    for ray in range(SIDE**2):
        for column in range(5):
            moved = np.zeros_like(features)
            moved[ray, column] = step
            slope = penalty(features + moved, alpha, metallic) - penalty(features - moved, alpha, metallic)
            assert by_features[ray, column] == pytest.approx(slope / (2 * step), abs=2e-5)
        moved_alpha = np.zeros_like(alpha)
        moved_alpha[ray] = step
        slope = penalty(features, alpha + moved_alpha, metallic) - penalty(
            features, alpha - moved_alpha, metallic
        )
        assert by_alpha[ray] == pytest.approx(slope / (2 * step), abs=2e-5)


@pytest.mark.parametrize(("metallic", "times"), [(0.0, 1.0), (0.5, 3.5), (1.0, 11.0)])
def test_metal_albedo_has_larger_weight(metallic: float, times: float) -> None:
    features = np.full((SIDE**2, 5), 0.5)
    features[:, 3] = metallic
    features[MIDDLE, :3] = 0.7
    found = np.zeros_like(features)
    add_material_smoothness_gradient(
        sight(features, np.ones(SIDE**2)), WEIGHTS, METAL, found, np.zeros(SIDE**2)
    )
    slope = 0.2 / np.hypot(0.2, HUBER_DELTA) / SIDE**2  # by each of its four neighbours
    np.testing.assert_allclose(found[MIDDLE, :3], 4 * times * slope * np.array(WEIGHTS[:3]), rtol=1e-5)
    assert (found[:, 3:] == 0).all()


def test_geometry_terms_ignore_translucent_pixels() -> None:
    features = np.random.default_rng(1).uniform(0, 0.5, (SIDE**2, 5))
    found, by_alpha = np.zeros_like(features), np.zeros(SIDE**2)
    add_material_smoothness_gradient(sight(features, np.full(SIDE**2, 0.5)), WEIGHTS, METAL, found, by_alpha)
    assert (found == 0).all() and (by_alpha == 0).all()


def test_dark_metal_gradient_with_albedo_fixed() -> None:
    """The sum is that of metallic, of things as dark as paint wholly and of things as bright as metal not."""
    rng = np.random.default_rng(2)
    alpha = rng.uniform(0.92, 1.0, SIDE**2).astype(np.float32).astype(np.float64)
    features = rng.uniform(0, 1, (SIDE**2, 5))
    features[:, :3] *= np.linspace(0.1, 1.0, SIDE**2)[:, None]
    full, none = DARK_METAL_ALBEDO
    features[0, :3], features[1, :3] = full - 0.1, none + 0.1
    features = (features * alpha[:, None]).astype(np.float32).astype(np.float64)
    darkness = np.clip((none - (features[:, :3] / alpha[:, None]).max(axis=1)) / (none - full), 0, 1)
    by_features, by_alpha = np.zeros_like(features), np.zeros_like(alpha)
    add_dark_metal_gradient(sight(features, alpha), 0.5, by_features, by_alpha)
    expected = 0.5 / SIDE**2 * darkness / alpha
    np.testing.assert_allclose(by_features[:, 3], expected, rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(by_alpha, -expected * features[:, 3] / alpha, rtol=1e-5, atol=1e-9)
    assert expected[0] > 0 and expected[1] == 0 and (by_features[:, [0, 1, 2, 4]] == 0).all()
    found = np.zeros_like(features)
    add_dark_metal_gradient(sight(features * 0.5, alpha * 0.5), 0.5, found, np.zeros_like(alpha))
    assert (found == 0).all()  # translucent


def test_sphere_normals_from_depths() -> None:
    """Windows as the training draws them; the gradient says how far the two are apart."""
    side, windows, focal = 8, 40, 100.0
    sampler = PixelSampler(np.array([0]), np.array([[100, 100]]))
    _, y, x = sampler.ray_patches(np.random.default_rng(0), windows, rays=side * side, side=24)
    directions = np.stack([(x - 49.5) / focal, (y - 49.5) / focal, np.ones(len(x))], axis=1)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    along = 3 * directions[:, 2]  # to a sphere of radius 2 around (0, 0, 3)
    depth = along - np.sqrt(along**2 - 9 + 4)
    normals = (directions * depth[:, None] - [0, 0, 3]) / 2
    count = len(depth)
    numbers = (np.zeros((count, 3)), np.zeros(count), depth, depth, normals, np.zeros((count, 0)))
    seen = TraceResult(*(number.astype(np.float32) for number in numbers), np.ones(count, np.int32))
    looked_at = TracedRays(
        RayBatch(np.zeros((1, 3)), directions),
        seen,
        make_tracer(TraceSettings(), threads=1),
        np.zeros(count, np.int64),
        ray_patches=RayPatches(0, windows, side),
    )
    by_normal = np.zeros((count, 3))
    add_depth_normal_gradient(looked_at, 1.0, np.zeros(count), by_normal, np.zeros(count))
    sines = np.linalg.norm(by_normal, axis=1) * count
    counted = sines[sines > 0]
    # Cells are 3 pixels, 1.1 degrees of the sphere; in the order of the rays it would be 4 times as much.
    assert np.degrees(np.arcsin(counted.mean())) < 2.0

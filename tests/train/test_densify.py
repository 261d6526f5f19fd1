"""Densification: counts, opacities and places after one application, and what a checkpoint keeps."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad

from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.trace.protocol import GaussianGradients
from octasplat.engine.train.config import McmcConfig, RedisplatsConfig
from octasplat.engine.train.densify import Densifier, McmcDensifier, RedisplatsDensifier, make_densifier
from octasplat.engine.train.densify.mcmc import split_opacity, split_scale_factor
from octasplat.engine.train.optimization.adam import Adam


def make(opacities: object, scale: float = 0.1) -> FlatGaussians:
    a = np.asarray(opacities, np.float64)
    rng = np.random.default_rng(0)
    count = len(a)
    return FlatGaussians(
        means_world=rng.normal(size=(count, 3)).astype(np.float32),
        quats_wxyz=rng.normal(size=(count, 4)).astype(np.float32),
        log_scales=np.full((count, 2), np.log(scale), np.float32),
        opacity_logits=np.log(a / (1 - a)).astype(np.float32),
        sh=rng.normal(size=(count, 1, 3)).astype(np.float32),
    )


def seen(count: int, errors: object, steps: object = 0.0) -> tuple[GaussianGradients, np.ndarray]:
    """What a densifier observes: an error for every Gaussian, and every mean's step."""
    empty = FlatGaussians(*(np.zeros((count, *s), np.float32) for s in ((3,), (4,), (2,), (), (1, 3))))
    zeros = np.zeros(count, np.float32)
    gradients = GaussianGradients(
        ids=np.arange(count, dtype=np.int32), means_world=empty.means_world, quats_wxyz=empty.quats_wxyz,
        log_scales=empty.log_scales, opacity_logits=zeros, sh=empty.sh,
        features=np.zeros((count, 0), np.float32), weight_sums=zeros,
        error_sums=np.broadcast_to(np.asarray(errors, np.float32), count).copy(),
        hit_counts=np.ones(count, np.int32),
    )  # fmt: skip
    return gradients, np.broadcast_to(np.asarray(steps, np.float32), (count, 3)).copy()


def mcmc(cap: int = 1000, **changes: object) -> McmcDensifier:
    return McmcDensifier(McmcConfig(**changes), iterations=1000, max_gaussians=cap)


def apply(
    densifier: Densifier, gaussians: FlatGaussians, seed: int = 0, extent: float = 1.0
) -> tuple[FlatGaussians, Adam]:
    after, adam = densifier.apply(
        gaussians, Adam.zeros(gaussians), np.random.default_rng(seed), extent=extent
    )
    assert after.is_finite()
    assert len(adam.steps) == len(adam.first) == len(adam.second) == len(after)
    return after, adam


@pytest.mark.parametrize("copies", [1, 2, 5, 32])
def test_copies_share_the_opacity_and_the_coverage(copies: int) -> None:
    opacity = np.array([0.05, 0.5, 0.95])
    shared = split_opacity(opacity, np.full(3, copies))
    np.testing.assert_allclose(1 - (1 - shared) ** copies, opacity, rtol=1e-12)
    factors = split_scale_factor(opacity, np.full(3, copies))
    for a, one, factor in zip(opacity, shared, factors, strict=True):
        before = quad(lambda x, a=a: a * np.exp(-0.5 * x * x), -12, 12)[0]
        after = quad(
            lambda x, one=one, factor=factor: 1 - (1 - one * np.exp(-0.5 * (x / factor) ** 2)) ** copies,
            -12,
            12,
        )[0]
        assert after == pytest.approx(before, rel=1e-6)


def test_copies_may_share_the_area_instead_and_stay_opaque() -> None:
    before = make([0.9] * 50)
    after, _ = apply(mcmc(copies="area", growth=1.0), before.copy())
    assert len(after) == 100
    np.testing.assert_allclose(after.opacities, 0.9, rtol=1e-5)
    area = np.exp(after.log_scales.sum(axis=1)).sum()
    assert area == pytest.approx(np.exp(before.log_scales.sum(axis=1)).sum(), rel=1e-4)


def test_growth_stops_at_the_cap() -> None:
    assert len(apply(mcmc(growth=0.25), make([0.5] * 40))[0]) == 50
    assert len(apply(mcmc(45, growth=0.25), make([0.5] * 40))[0]) == 45
    assert len(apply(mcmc(40, growth=0.25), make([0.5] * 40))[0]) == 40
    assert len(apply(mcmc(10, growth=0.25), make([0.5] * 40))[0]) == 40


def test_mcmc_relocates_dead_gaussians_and_shares_opacity() -> None:
    dead = 1e-4
    before = make([dead, 0.9, dead, dead])
    source = before.select(np.array([1]))
    after, adam = apply(mcmc(growth=0.0, dead_opacity=0.01), before.copy())
    assert len(after) == 4
    assert 1 - (1 - after.opacities.astype(np.float64)).prod() == pytest.approx(0.9, rel=1e-5)
    assert np.ptp(after.opacities) < 1e-6
    np.testing.assert_array_equal(after.sh, np.repeat(source.sh, 4, axis=0))
    np.testing.assert_array_equal(after.quats_wxyz, np.repeat(source.quats_wxyz, 4, axis=0))
    assert np.ptp(after.log_scales, axis=0).max() == 0 and (after.scales < source.scales).all()
    # Scattered inside the source's plane and extent; the source itself stays.
    np.testing.assert_array_equal(after.means_world[1], source.means_world[0])
    local = (after.means_world - source.means_world) @ source.rotations[0]
    assert np.abs(local[:, 0]).max() < 1e-6
    assert 0 < np.abs(local[[0, 2, 3], 1:]).max() < 5 * 0.1
    assert not adam.steps.any()


def test_mcmc_adds_gaussians_at_error() -> None:
    densifier = mcmc(growth=0.5, error_power=1.0)
    gaussians = make([0.5] * 40)
    errors = np.zeros(40)
    errors[7] = 3.0
    densifier.observe(40, *seen(40, errors))
    after, _ = apply(densifier, gaussians.copy())
    assert len(after) == 60
    np.testing.assert_array_equal(after.sh[40:], np.repeat(gaussians.sh[[7]], 20, axis=0))
    assert densifier.state()["errors"].sum() == 0


def test_errors_stay_with_their_gaussians_in_another_order() -> None:
    densifier = mcmc(growth=0.5, error_power=1.0)
    gaussians = make([0.5] * 40)
    errors = np.zeros(40)
    errors[7] = 3.0
    densifier.observe(40, *seen(40, errors))
    order = np.random.default_rng(1).permutation(40)
    densifier.reorder(order)
    after, _ = apply(densifier, gaussians.select(order))
    np.testing.assert_array_equal(after.sh[40:], np.repeat(gaussians.sh[[7]], 20, axis=0))


def test_moments_of_the_untouched_stay() -> None:
    gaussians = make([0.5] * 10)
    adam = Adam.zeros(gaussians)
    adam.first[:], adam.steps[:] = 1.0, 5
    densifier = mcmc(growth=0.3, error_power=1.0)
    errors = np.zeros(10)
    errors[2] = 1.0
    densifier.observe(10, *seen(10, errors))
    after, adam = densifier.apply(gaussians, adam, np.random.default_rng(0), extent=1.0)
    assert len(after) == 13
    assert adam.steps.tolist() == [5, 5, 0, 5, 5, 5, 5, 5, 5, 5, 0, 0, 0]
    assert (adam.first[[0, 1, 3]] == 1).all() and not adam.first[10:].any()


def weighing(weights: np.ndarray, errors: np.ndarray) -> tuple[GaussianGradients, np.ndarray]:
    gradients, steps = seen(len(weights), errors)
    return replace(gradients, weight_sums=weights.astype(np.float32)), steps


def test_mcmc_relocates_low_weight_gaussians_to_error() -> None:
    """Of forty that may be forty two have no weight, one has little; errors are seen through three others."""
    before = make([0.5] * 40)
    weights, errors = np.full(40, 10.0), np.zeros(40)
    weights[[3, 20]], weights[11], errors[[7, 15, 30]] = 0.0, 0.4, (1000.0, 3.0, 0.5)
    densifier = mcmc(40, relocate_low_weight_below=0.05, relocate_low_weight_fraction=1.0)
    densifier.observe(40, *weighing(weights, errors))
    after, adam = apply(densifier, before.copy())
    assert len(after) == 40
    moved, sources = [3, 11, 20], [7, 15, 30]  # one beside each, however much error there is
    np.testing.assert_array_equal(after.sh[moved], before.sh[sources])
    np.testing.assert_allclose(after.opacities, 0.5, rtol=1e-6)  # the area is shared
    halves = before.scales[sources] / np.sqrt(2)
    np.testing.assert_allclose(after.scales[moved], halves, rtol=1e-6)
    np.testing.assert_allclose(after.scales[sources], halves, rtol=1e-6)
    assert (after.means_world[moved] != before.means_world[sources]).any(axis=1).all()
    others = np.setdiff1d(np.arange(40), moved)
    np.testing.assert_array_equal(after.means_world[others], before.means_world[others])
    assert not densifier.state()["weights"].any() and not adam.steps.any()


def test_mcmc_relocation_follows_error() -> None:
    drawn = np.zeros(40)
    for seed in range(200):
        weights, errors = np.full(40, 10.0), np.ones(40)
        weights[3], errors[7], errors[15] = 0.0, 30.0, 15.0
        densifier = mcmc(40, relocate_low_weight_below=0.05, relocate_low_weight_fraction=1.0)
        densifier.observe(40, *weighing(weights, errors))
        before = make([0.5] * 40)
        after, _ = apply(densifier, before.copy(), seed)
        drawn += (after.scales != before.scales).any(axis=1) & (np.arange(40) != 3)
    assert drawn.sum() == 200
    assert drawn[7] == pytest.approx(200 * 30 / 82, abs=20) and drawn[15] == pytest.approx(
        200 * 15 / 82, abs=17
    )


@pytest.mark.parametrize(("share", "moved"), [(0.0, []), (0.026, [20]), (0.051, [3, 20])])
def test_mcmc_relocation_fraction_is_limited(share: float, moved: list[int]) -> None:
    before = make([0.5] * 40)
    weights, errors = np.full(40, 10.0), np.zeros(40)
    weights[3], weights[11], errors[[7, 8]] = 0.1, 0.2, 3.0
    weights[20] = 0.0
    densifier = mcmc(40, relocate_low_weight_below=0.05, relocate_low_weight_fraction=share)
    densifier.observe(40, *weighing(weights, errors))
    after, _ = apply(densifier, before.copy())
    changed = np.flatnonzero((after.means_world != before.means_world).any(axis=1))
    assert changed.tolist() == moved


def test_mcmc_below_cap_grows_without_relocating() -> None:
    before = make([0.5] * 40)
    weights = np.full(40, 10.0)
    weights[3] = 0.0
    densifier = mcmc(100, relocate_low_weight_below=0.05, relocate_low_weight_fraction=1.0, growth=0.1)
    densifier.observe(40, *weighing(weights, np.ones(40)))
    after, _ = apply(densifier, before.copy())
    assert len(after) == 44
    np.testing.assert_array_equal(after.means_world[:40], before.means_world)


def test_mcmc_rounds_at_cap_are_less_frequent() -> None:
    config = McmcConfig(start=20, interval=10, stop_fraction=0.85, relocate_low_weight_rounds=4)
    densifier = make_densifier(config, iterations=200, max_gaussians=50)
    densifier.observe(40, *seen(40, 0.0))
    assert [k for k in range(1, 201) if densifier.is_due(k)] == list(range(20, 171, 10))
    densifier.observe(50, *seen(50, 0.0))
    assert [k for k in range(1, 201) if densifier.is_due(k)] == [50, 100, 150]


def test_mcmc_all_dead_or_at_cap_changes_nothing() -> None:
    all_dead = make([1e-4] * 5)
    after, _ = apply(mcmc(), all_dead.copy())
    np.testing.assert_array_equal(after.opacity_logits, all_dead.opacity_logits)
    full = make([0.5] * 5)
    after, _ = apply(mcmc(5), full.copy())
    np.testing.assert_array_equal(after.means_world, full.means_world)


def test_densify_is_deterministic_for_seed() -> None:
    results = []
    for seed in (1, 1, 2):
        densifier = mcmc(growth=0.2)
        densifier.observe(50, *seen(50, np.arange(50)))
        results.append(apply(densifier, make(np.linspace(0.001, 0.9, 50)), seed)[0].means_world.tobytes())
    assert results[0] == results[1] != results[2]


def test_densify_repeated_stays_finite() -> None:
    gaussians, rng = make(np.random.default_rng(0).uniform(1e-3, 0.999, 30)), np.random.default_rng(3)
    densifier = mcmc(200, growth=0.3)
    adam = Adam.zeros(gaussians)
    for _ in range(30):
        densifier.observe(len(gaussians), *seen(len(gaussians), rng.random(len(gaussians)) ** 8))
        gaussians, adam = densifier.apply(gaussians, adam, rng, extent=1.0)
        gaussians.opacity_logits += rng.normal(size=len(gaussians)).astype(np.float32)
        assert gaussians.is_finite()
    assert len(gaussians) == 200 == len(adam.steps)


@pytest.mark.parametrize("config", [McmcConfig(start=20, interval=10, stop_fraction=0.5),
                                    RedisplatsConfig(start=20, interval=10, stop_fraction=0.5)])  # fmt: skip
def test_densify_runs_at_configured_iterations(config: McmcConfig | RedisplatsConfig) -> None:
    densifier = make_densifier(config, iterations=100, max_gaussians=10)
    assert [k for k in range(1, 101) if densifier.is_due(k)] == [20, 30, 40, 50]


@pytest.mark.parametrize(
    "config", [McmcConfig(growth=0.1), RedisplatsConfig(step_threshold=0.01, prune_opacity=0.01)]
)
def test_state_travels_through_a_checkpoint(config: McmcConfig | RedisplatsConfig) -> None:
    rng = np.random.default_rng(0)
    first, second = (make_densifier(config, iterations=100, max_gaussians=100) for _ in range(2))
    first.observe(40, *seen(40, rng.random(40), 0.02 * rng.normal(size=(40, 3))))
    second.restore({name: array.copy() for name, array in first.state().items()})
    results = [apply(densifier, make([0.5] * 40))[0] for densifier in (first, second)]
    assert len(results[0]) > 40
    np.testing.assert_array_equal(results[0].means_world, results[1].means_world)


PAPER = RedisplatsConfig(
    step_threshold=0.01, split_scale=0.05, prune_opacity=0.1, min_scale=1e-3, max_scale=2.0, split_shrink=1.6
)


def paper(cap: int = 1000) -> RedisplatsDensifier:
    return RedisplatsDensifier(PAPER, iterations=1000, max_gaussians=cap)


def test_clone_split_and_prune_counts() -> None:
    gaussians = make([0.5] * 10)
    gaussians.log_scales[:5] = np.log(0.02)  # small ones: 0.028 by norm
    gaussians.opacity_logits[9] = -5.0
    gaussians.log_scales[8] = np.log(1e-5)
    gaussians.log_scales[7] = np.log(3.0)
    steps = np.zeros((10, 3))
    steps[[0, 1]] = [0.02, 0, 0]  # small and moving: cloned
    steps[[5]] = [0, 0.02, 0]  # large and moving: split
    steps[[3]] = [0, 0.009, 0]  # too slow
    densifier = paper()
    densifier.observe(10, *seen(10, 0.0, steps))
    before = gaussians.copy()
    after, _ = apply(densifier, gaussians)
    assert len(after) == 10 + 2 + 1 - 3
    np.testing.assert_array_equal(after.means_world[:5], before.means_world[:5])
    # Clones lie where the means were before the step.
    np.testing.assert_allclose(after.means_world[7:9], before.means_world[:2] - [[0.02, 0, 0]] * 2, atol=1e-6)
    np.testing.assert_array_equal(after.log_scales[7:9], before.log_scales[:2])
    # Halves are smaller, inside the plane, and leave the mother's place.
    for half in (5, 9):
        np.testing.assert_allclose(after.scales[half], before.scales[5] / 1.6, rtol=1e-5)
        local = (after.means_world[half] - before.means_world[5]) @ before.rotations[5]
        assert abs(local[0]) < 1e-6 and 0 < np.abs(local[1:]).max() < 0.6
    assert not np.array_equal(after.means_world[5], after.means_world[9])


def test_densify_cap_keeps_largest_gradients() -> None:
    gaussians = make([0.5] * 6, scale=0.02)
    steps = np.zeros((6, 3))
    steps[:, 0] = [0.02, 0.05, 0.0, 0.03, 0.04, 0.02]
    densifier = paper(cap=8)
    densifier.observe(6, *seen(6, 0.0, steps))
    before = gaussians.copy()
    after, _ = apply(densifier, gaussians)
    assert len(after) == 8
    np.testing.assert_array_equal(after.sh[6:], before.sh[[1, 4]])


def test_thresholds_follow_the_extent() -> None:
    for extent, count in ((1.0, 12), (10.0, 6)):
        densifier = paper()
        densifier.observe(6, *seen(6, 0.0, [0.02, 0, 0]))
        assert len(apply(densifier, make([0.5] * 6, scale=0.02), extent=extent)[0]) == count


def test_pruning_can_empty_the_scene() -> None:
    assert len(apply(paper(), make([0.01] * 5))[0]) == 0


def test_moments_are_copied_to_both() -> None:
    gaussians = make([0.5] * 4, scale=0.02)
    adam = Adam.zeros(gaussians)
    adam.first[:] = np.arange(4)[:, None]
    steps = np.zeros((4, 3))
    steps[2] = 0.1
    densifier = paper()
    densifier.observe(4, *seen(4, 0.0, steps))
    _, adam = densifier.apply(gaussians, adam, np.random.default_rng(0), extent=1.0)
    assert adam.first[:, 0].tolist() == [0, 1, 2, 3, 2]

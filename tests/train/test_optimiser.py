"""Adam: that of torch where every Gaussian is hit, and hands off the others."""

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
import torch

from octasplat.engine.gaussians.frames import rotation_matrices
from octasplat.engine.gaussians.model import SH_C0, FlatGaussians
from octasplat.engine.shading.material_settings import MaterialSettings
from octasplat.engine.trace.protocol import GaussianGradients
from octasplat.engine.train.config import LearningRates, LossWeights
from octasplat.engine.train.initialization.initial_gaussians import add_initial_materials
from octasplat.engine.train.optimization.adam import Adam
from tests.support.planar_dataset import random_gaussians

NAMES = ("means_world", "quats_wxyz", "log_scales", "opacity_logits", "sh")
NO_LOSS = LossWeights(opacity=0.0, scale=0.0)


def gaussians(count: int, degree: int = 1) -> FlatGaussians:
    return random_gaussians(count, seed=0, degree=degree)


def quat_product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """One quaternion times each of others, w first."""
    w, v = b[:, :1], b[:, 1:]
    real = a[0] * w - v @ a[1:, None]
    return np.concatenate([real, a[0] * v + w * a[1:] + np.cross(a[1:], v)], axis=1)


def gradients(of: FlatGaussians, ids: np.ndarray, rng: np.random.Generator) -> GaussianGradients:
    ids = ids.astype(np.int32)
    parts = {name: rng.normal(size=getattr(of, name)[ids].shape).astype(np.float32) for name in NAMES}
    zeros = np.zeros(len(ids), np.float32)
    return GaussianGradients(
        ids=ids, features=np.zeros((len(ids), 0), np.float32), weight_sums=zeros, error_sums=zeros,
        hit_counts=np.ones(len(ids), np.int32), **parts,
    )  # fmt: skip


def test_adam_matches_torch_when_all_gaussians_are_hit() -> None:
    rng = np.random.default_rng(1)
    ours, extent = gaussians(50), 2.0
    rates = LearningRates(mean=1e-3, mean_final=1e-3, mean_unit="extent", quat=2e-3, log_scale=3e-3,
                          axes="world", opacity=4e-2, color=5e-3, sh_rest_ratio=0.1, decay=1.0)  # fmt: skip
    color = rates.color / SH_C0
    leaves = {name: torch.tensor(getattr(ours, name), dtype=torch.float64) for name in NAMES}
    leaves["sh0"], leaves["sh_rest"] = leaves["sh"][:, :1].clone(), leaves.pop("sh")[:, 1:].clone()
    steps = {"means_world": rates.mean * extent, "quats_wxyz": rates.quat, "log_scales": rates.log_scale,
             "opacity_logits": rates.opacity, "sh0": color, "sh_rest": 0.1 * color}  # fmt: skip
    judge = torch.optim.Adam([{"params": [leaves[name]], "lr": lr} for name, lr in steps.items()], eps=1e-15)
    adam = Adam.zeros(ours)
    for _ in range(30):
        given = gradients(ours, np.arange(50), rng)
        before = ours.means_world.copy()
        moved = adam.step(ours, given, rates, NO_LOSS, training_progress=0.5, extent=extent)
        np.testing.assert_allclose(moved, ours.means_world - before, atol=1e-6)
        for name, leaf in leaves.items():
            whole = torch.tensor(
                given.sh if name.startswith("sh") else getattr(given, name), dtype=torch.float64
            )
            leaf.grad = (
                {"sh0": whole[:, :1], "sh_rest": whole[:, 1:]}.get(name, whole) if "sh" in name else whole
            )
        judge.step()
    leaves["sh"] = torch.cat([leaves["sh0"], leaves["sh_rest"]], dim=1)
    assert (adam.steps == 30).all()
    for name in NAMES:
        np.testing.assert_allclose(getattr(ours, name), leaves[name].numpy(), atol=2e-6)


def test_adam_local_axes_are_rotation_invariant() -> None:
    """What Adam does to a scene does not depend on how the world is turned."""
    rng = np.random.default_rng(3)
    rates = LearningRates(sh_rest_ratio=0.1)
    ours = gaussians(40, degree=0)
    turned, by = ours.copy(), np.array([0.4, -0.7, 0.2, 0.56])
    by /= np.linalg.norm(by)
    world = rotation_matrices(by[None])[0]
    turned.means_world = (ours.means_world @ world.T).astype(np.float32)
    turned.quats_wxyz = quat_product(by, ours.quats_wxyz).astype(np.float32)
    adams = Adam.zeros(ours), Adam.zeros(turned)
    for _ in range(20):
        given = gradients(ours, np.arange(40), rng)
        along = (ours.quats_wxyz * given.quats_wxyz).sum(axis=1, keepdims=True)
        square = (ours.quats_wxyz**2).sum(axis=1, keepdims=True)
        given.quats_wxyz -= along / square * ours.quats_wxyz  # a rotation has no length
        also = replace(
            given,
            means_world=(given.means_world @ world.T).astype(np.float32),
            quats_wxyz=quat_product(by, given.quats_wxyz).astype(np.float32),
        )
        moved = [
            adam.step(scene, by_scene, rates, NO_LOSS, training_progress=0.5, extent=1.0)
            for adam, scene, by_scene in zip(adams, (ours, turned), (given, also), strict=True)
        ]
        np.testing.assert_allclose(moved[1], moved[0] @ world.T, atol=2e-5)
    np.testing.assert_allclose(turned.means_world, ours.means_world @ world.T, atol=2e-4)
    np.testing.assert_allclose(turned.rotations, world @ ours.rotations, atol=2e-4)
    np.testing.assert_allclose(turned.log_scales, ours.log_scales)


def test_adam_local_axes_have_separate_moments() -> None:
    """A weak steady pull along the normal moves as far as a strong one; in the world's axes it is lost."""
    steps = {}
    for axes in ("own", "world"):
        ours = gaussians(1, degree=0)
        ours.quats_wxyz[0] = np.array([0.8, 0.3, -0.4, 0.33]) / np.linalg.norm([0.8, 0.3, -0.4, 0.33])
        ours.log_scales[:] = 0.0
        adam, frame, total = Adam.zeros(ours), ours.rotations[0], np.zeros(3)
        for k in range(20):
            given = gradients(ours, np.arange(1), np.random.default_rng(k))
            given.quats_wxyz[:], given.log_scales[:] = 0, 0
            pull = 1.0 * frame[:, 0] + (-1.0) ** k * 100.0 * frame[:, 1]
            given.means_world[0] = pull
            total += adam.step(
                ours, given, LearningRates(axes=axes), NO_LOSS, training_progress=0.0, extent=1.0
            )[0]
        steps[axes] = total @ frame
    assert steps["own"][0] == pytest.approx(-20 * LearningRates().mean, rel=1e-2)
    assert abs(steps["world"][0]) < 0.2 * abs(steps["own"][0])


def test_adam_rotation_step_equals_learning_rate() -> None:
    ours = gaussians(30, degree=0)
    before, given = ours.rotations.copy(), gradients(ours, np.arange(30), np.random.default_rng(5))
    wanted = given.quats_wxyz.astype(np.float64)
    quats = ours.quats_wxyz.astype(np.float64)
    Adam.zeros(ours).step(ours, given, LearningRates(), NO_LOSS, training_progress=0.0, extent=1.0)
    length = np.linalg.norm(quats, axis=1, keepdims=True)
    change = ours.quats_wxyz - quats / length
    assert ((change * wanted).sum(axis=1) < 0).all()
    cosine = (np.trace(before.transpose(0, 2, 1) @ ours.rotations, axis1=1, axis2=2) - 1) / 2
    half = np.sqrt(3) * LearningRates().quat  # the first step of each of three axes
    np.testing.assert_allclose(np.arccos(cosine), 2 * np.arctan(half), rtol=1e-3)


def test_unhit_gaussians_are_unchanged() -> None:
    rng = np.random.default_rng(1)
    ours = gaussians(20)
    before, adam = ours.copy(), Adam.zeros(ours)
    hit = np.array([1, 4, 7, 19])
    rest = np.setdiff1d(np.arange(20), hit)
    adam.step(
        ours,
        gradients(ours, hit, rng),
        LearningRates(),
        LossWeights(opacity=1.0, scale=1.0),
        training_progress=0,
        extent=1,
    )
    for name in NAMES:
        np.testing.assert_array_equal(getattr(ours, name)[rest], getattr(before, name)[rest])
        assert (getattr(ours, name)[hit] != getattr(before, name)[hit]).all()
    assert not adam.first[rest].any() and not adam.second[rest].any()
    assert adam.steps[hit].tolist() == [1] * 4 and not adam.steps[rest].any()


def test_adam_first_step_equals_learning_rate() -> None:
    rates, ours = LearningRates(), gaussians(10)
    before, adam = ours.copy(), Adam.zeros(ours)
    # Each Gaussian has its own count of steps: one that is hit late begins as one that is hit at once.
    for _ in range(5):
        adam.step(
            ours,
            gradients(ours, np.arange(9), np.random.default_rng(0)),
            rates,
            NO_LOSS,
            training_progress=0,
            extent=3,
        )
    adam.step(
        ours,
        gradients(ours, np.array([9]), np.random.default_rng(0)),
        rates,
        NO_LOSS,
        training_progress=0,
        extent=3,
    )
    step = np.abs((ours.means_world[9] - before.means_world[9]) @ before.rotations[9])
    size = np.exp(before.log_scales[9].mean())
    np.testing.assert_allclose(step, size * rates.mean, rtol=1e-2)


@pytest.mark.parametrize("unit", ["size", "extent"])
def test_rate_of_the_means_falls_exponentially(unit: Literal["size", "extent"]) -> None:
    rates = LearningRates(mean_unit=unit)
    for progress in (0.0, 0.5, 1.0):
        ours = gaussians(5)
        adam, frames = Adam.zeros(ours), ours.rotations
        lengths = np.exp(ours.log_scales.mean(axis=1)) if unit == "size" else np.full(5, 2.0)
        moved = adam.step(
            ours,
            gradients(ours, np.arange(5), np.random.default_rng(0)),
            rates,
            NO_LOSS,
            training_progress=progress,
            extent=2,
        )
        expected = lengths * rates.mean * (rates.mean_final / rates.mean) ** progress
        along = np.abs(np.einsum("ni,nij->nj", moved, frames))
        np.testing.assert_allclose(along, np.tile(expected[:, None], 3), rtol=1e-4)


@pytest.mark.parametrize("term", ["opacity", "scale"])
def test_adam_regulariser_lowers_its_parameter(term: str) -> None:
    ours = gaussians(10)
    before, adam = ours.copy(), Adam.zeros(ours)
    none = gradients(ours, np.arange(10), np.random.default_rng(0))
    for name in NAMES:
        getattr(none, name)[:] = 0
    adam.step(
        ours,
        none,
        LearningRates(),
        LossWeights(**{"opacity": 0, "scale": 0, term: 0.1}),
        training_progress=0,
        extent=1,
    )
    changed = {"opacity": "opacity_logits", "scale": "log_scales"}[term]
    for name in NAMES:
        difference = getattr(ours, name) - getattr(before, name)
        if name == "quats_wxyz":  # of length 1 from then on
            np.testing.assert_allclose(ours.rotations, before.rotations, atol=1e-6)
        else:
            assert (difference < 0).all() if name == changed else not difference.any()


def test_select_append_reset_widen() -> None:
    ours = gaussians(6, degree=0)
    adam = Adam.zeros(ours)
    adam.step(
        ours,
        gradients(ours, np.arange(6), np.random.default_rng(0)),
        LearningRates(),
        NO_LOSS,
        training_progress=0,
        extent=1,
    )
    both = adam.select(np.array([4, 1])).append(adam)
    np.testing.assert_array_equal(both.first, adam.first[[4, 1, 0, 1, 2, 3, 4, 5]])
    wide = adam.with_sh_basis(9)
    assert wide.first.shape == (6, 10 + 27)
    np.testing.assert_array_equal(wide.second[:, :13], adam.second)
    assert not wide.second[:, 13:].any()
    adam.reset(np.array([2]))
    assert not adam.first[2].any() and adam.steps.tolist() == [1, 1, 0, 1, 1, 1]


def test_adam_channel_step_matches_torch() -> None:
    rng = np.random.default_rng(8)
    scene = add_initial_materials(gaussians(6), MaterialSettings()).with_channels(
        {"label": np.full((6, 1), 7.0, np.float32)}
    )
    leaf = torch.full((6, 3), 0.0, dtype=torch.float64, requires_grad=True)  # the logit of 0.5
    judge = torch.optim.Adam([leaf], lr=0.05, eps=1e-15)
    adam, rates = Adam.zeros(scene), LearningRates(albedo=0.05, decay=1.0)
    for _ in range(5):
        given = gradients(scene, np.arange(6), rng)
        given.features = rng.normal(size=(6, adam.channel_first.shape[1])).astype(np.float32)
        judge.zero_grad()
        (torch.sigmoid(leaf) * torch.from_numpy(given.features[:, :3]).double()).sum().backward()
        judge.step()
        adam.step(scene, given, rates, LossWeights(), training_progress=0.0, extent=1.0)
    np.testing.assert_allclose(scene.channels["albedo"], torch.sigmoid(leaf).detach(), rtol=1e-4)
    assert (scene.channels["ambient"] == 1).all() and (scene.channels["label"] == 7).all()
    assert (adam.append(Adam.zeros(scene)).channel_first[6:] == 0).all()


def test_long_trainings_take_smaller_steps_of_means_and_turns() -> None:
    rates = LearningRates(mean=0.1, mean_final=0.03, quat=0.02, scale_after=1000)
    assert rates.scaled_for(1000) == rates
    four_times = rates.scaled_for(4000)
    assert (four_times.mean, four_times.quat) == pytest.approx((0.05, 0.01))
    assert four_times.model_copy(update={"mean": 0.1, "quat": 0.02}) == rates
    assert rates.scaled_for(100_000).mean == 0.03  # which they fall to in any case
    assert rates.model_copy(update={"scale_after": 0}).scaled_for(100_000).quat == 0.02

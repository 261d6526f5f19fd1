"""Exposures of the views: their gradients, and that they explain photographs of unlike brightness."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.core.events import Event, HeldOutMeasured
from octasplat.engine.core.rays import RayBatch
from octasplat.engine.dataset.model import Observations
from octasplat.engine.render.pinhole_camera import PinholeCamera
from octasplat.engine.render.renderer import render_rays
from octasplat.engine.render.supersampling import render_filtered
from octasplat.engine.shading.exposure import ExposureModel
from octasplat.engine.shading.exposure_estimation import times_from_names
from octasplat.engine.shading.material_settings import MaterialSettings, Recipe
from octasplat.engine.shading.protocol import ShadedRayGradients, ShadingStep, TracedRays
from octasplat.engine.shading.recipes import material_shading
from octasplat.engine.trace.cpu.tracer import CpuTracer
from octasplat.engine.trace.protocol import GaussianGradients, TraceResult
from octasplat.engine.train.config import TrainConfig
from octasplat.engine.train.initialization.initial_gaussians import add_initial_materials
from octasplat.engine.train.loop.state import TrainState, initial_state
from octasplat.engine.train.loop.trainer import Trainer
from octasplat.engine.train.views import exposure_changes
from octasplat.engine.train.views.exposure_changes import (
    exposure_change_notice,
    relative_log_brightness,
    resolve_exposure,
)
from tests.support.planar_dataset import PlanarDataset, small_config
from tests.support.stopped_run import train_with_a_stop

NO_GRADIENTS = GaussianGradients(
    ids=np.zeros(0, np.int32),
    means_world=np.zeros((0, 3), np.float32), quats_wxyz=np.zeros((0, 4), np.float32),
    log_scales=np.zeros((0, 2), np.float32), opacity_logits=np.zeros(0, np.float32),
    sh=np.zeros((0, 1, 3), np.float32), features=np.zeros((0, 0), np.float32),
    weight_sums=np.zeros(0, np.float32), error_sums=np.zeros(0, np.float32), hit_counts=np.zeros(0, np.int32),
)  # fmt: skip


class UnevenWorld(PlanarDataset):
    """Every training photograph has a brightness of its own; the held-out one has the mean of them."""

    def __init__(self) -> None:
        super().__init__()
        self.log_gains = np.array([0.0, 0.35, -0.3, 0.2, -0.25, 0.1, -0.1], np.float32)

    def pixels(
        self, view: np.ndarray, y: np.ndarray, x: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        rgb, alpha, weight = super().pixels(view, y, x)
        return 0.6 * rgb * np.exp(self.log_gains[view])[:, None], alpha, weight


def run(folder: Path, config: TrainConfig, *, stop_after: int | None = None) -> tuple[Trainer, list[Event]]:
    """Train on the uneven world; with ``stop_after``, stop there and go on from the checkpoint."""
    world, events = UnevenWorld(), list[Event]()
    state = initial_state(world.initial_gaussians(), config.seed)

    def trainer(state: TrainState, last: float) -> Trainer:
        return Trainer(
            world, config, state, folder=folder, fingerprint="test", progress=events.append, threads=1,
            should_stop=lambda: state.iteration >= last,
        )  # fmt: skip

    return train_with_a_stop(trainer, state, folder, stop_after)[0], events


def last_psnr(events: list[Event]) -> float:
    return [event.psnr for event in events if isinstance(event, HeldOutMeasured)][-1]


def sight(view: np.ndarray, rgb: np.ndarray, alpha: np.ndarray) -> TracedRays:
    """A sight of given colors and alphas; Gaussians and rays do not matter to exposures."""
    zeros, three = np.zeros(len(view), np.float32), np.zeros((len(view), 3), np.float32)
    seen = TraceResult(
        rgb_srgb=rgb, transmittance=np.float32(1) - alpha, depth_sum=zeros, depth_median=zeros,
        normal_world=three, features=three[:, :0], hit_counts=np.zeros(len(view), np.int32),
    )  # fmt: skip
    return TracedRays(RayBatch(three, three), seen, CpuTracer(), view)


def made_exposures(views: int, rng: np.random.Generator) -> ExposureModel:
    exposures = ExposureModel(views, rate=0.02, decay=0.01)
    exposures.log_gains[:] = rng.normal(0, 0.3, (views, 3))
    exposures.offsets[:] = rng.normal(0, 0.1, (views, 3))
    return exposures


def test_gradients_agree_with_finite_differences() -> None:
    rng = np.random.default_rng(0)
    exposures = made_exposures(3, rng)
    view = np.array([0, 2, 2, 1])
    rgb, alpha = rng.random((4, 3), dtype=np.float32), rng.random(4, dtype=np.float32)
    by_rgb = rng.normal(size=(4, 3)).astype(np.float32)
    by_transmittance = rng.normal(size=4).astype(np.float32)
    seen = sight(view, rgb, alpha)
    grad = ShadedRayGradients(by_rgb, by_transmittance)
    found = exposures.backward(seen, exposures.shade(seen), grad)

    def loss(rgb: np.ndarray = rgb, alpha: np.ndarray = alpha) -> float:
        developed = exposures.shade(sight(view, rgb, alpha))
        terms = (developed.rgb_srgb * by_rgb).sum() + developed.transmittance @ by_transmittance
        return float(terms)

    step = np.float32(0.5)  # the map is linear, so that a large step is exact
    assert found.trace.transmittance is not None
    for ray in range(4):
        more = alpha.copy()
        more[ray] += step
        assert -found.trace.transmittance[ray] == pytest.approx((loss(alpha=more) - loss()) / step, abs=1e-5)
        for channel in range(3):
            brighter = rgb.copy()
            brighter[ray, channel] += step
            moved = (loss(rgb=brighter) - loss()) / step
            assert found.trace.rgb_srgb[ray, channel] == pytest.approx(moved, abs=1e-5)
    views, sums = found.parameters["exposure.views"], found.parameters["exposure.sums"]
    assert views.tolist() == [0, 1, 2]
    for column in range(6):
        parameter, channel = (exposures.log_gains, exposures.offsets)[column // 3], column % 3
        parameter[2, channel] += 1e-2
        above = loss()
        parameter[2, channel] -= 2e-2
        moved = (above - loss()) / 2e-2
        parameter[2, channel] += 1e-2
        assert sums[2, column] == pytest.approx(moved, abs=1e-3)


def test_untrained_views_keep_exposure() -> None:
    rng = np.random.default_rng(0)
    seen = sight(np.arange(3), rng.random((3, 3), dtype=np.float32), rng.random(3, dtype=np.float32))
    developed = made_exposures(3, rng).shade(replace(seen, view=None))
    assert developed.rgb_srgb is seen.result.rgb_srgb and developed.transmittance is seen.result.transmittance


def test_known_gains_and_offsets_are_found() -> None:
    rng = np.random.default_rng(1)
    log_gains = rng.normal(0, 0.2, (4, 3))
    offsets = rng.normal(0, 0.05, (4, 3))
    log_gains -= log_gains.mean(axis=0)
    offsets -= offsets.mean(axis=0)
    exposures = ExposureModel(4, rate=0.02, decay=0.01)
    gaussians, nothing = PlanarDataset().initial_gaussians(1), np.zeros(256, np.float32)
    for iteration in range(2000):
        view = rng.integers(0, 4, 256)
        rgb, alpha = rng.random((256, 3)).astype(np.float32), np.ones(256, np.float32)
        seen = sight(view, rgb, alpha)
        developed = exposures.shade(seen)
        error = (developed.rgb_srgb - (np.exp(log_gains[view]) * rgb + offsets[view])).astype(np.float32)
        found = exposures.backward(seen, developed, ShadedRayGradients(error, nothing))
        exposures.step(ShadingStep(gaussians, NO_GRADIENTS, found.parameters, iteration / 2000))
    np.testing.assert_allclose(exposures.log_gains, log_gains, atol=2e-3)
    np.testing.assert_allclose(exposures.offsets, offsets, atol=2e-3)


def test_uneven_photographs_are_explained_by_their_exposure(tmp_path: Path) -> None:
    config = small_config(iterations=240, exposure=True, lr={"exposure": 0.02})
    trainer, events = run(tmp_path / "learnt", config)
    _, plain = run(tmp_path / "plain", small_config(iterations=240))
    assert last_psnr(events) > last_psnr(plain) + 2
    found = trainer.shading
    assert isinstance(found, ExposureModel)
    world = UnevenWorld()
    true = world.log_gains[world.train_indices]
    mid = 0.3  # where offsets and gains are told apart by little, compare what they do to a middle tone
    shown = np.exp(found.log_gains[world.train_indices]) * mid + found.offsets[world.train_indices]
    expected = np.exp(true - true.mean())[:, None] * mid
    np.testing.assert_allclose(shown, np.repeat(expected, 3, axis=1), atol=0.02)
    assert (found.log_gains[world.test_indices] == 0).all()


def test_resumed_run_has_same_exposures(tmp_path: Path) -> None:
    config = small_config(exposure=True)
    whole, _ = run(tmp_path / "whole", config)
    parts, _ = run(tmp_path / "parts", config, stop_after=50)
    assert (
        whole.state.shading.keys() == parts.state.shading.keys() >= {"exposure.log_gains", "exposure.steps"}
    )
    for name, values in whole.state.shading.items():
        assert values.tobytes() == parts.state.shading[name].tobytes(), name
    assert whole.state.gaussians.sh.tobytes() == parts.state.gaussians.sh.tobytes()


NAMES = [f"view_{k:03}.png" for k in range(65)]


def test_exposure_of_held_out_frame_follows_neighbouring_names() -> None:
    """A film of which few frames are kept: the held-out one is like the frame just before it."""
    names = ["take2_0001.jpg", "take2_0002.jpg", "take2_0090.jpg", "take2_0091.jpg", "take2_0180.jpg"]
    np.testing.assert_array_equal(times_from_names(names), [1, 2, 90, 91, 180])
    for other in (names[::-1], ["a.jpg", "b2.jpg", "c3.jpg"], ["a1.jpg", "b1.jpg", "c2.jpg"]):
        np.testing.assert_array_equal(times_from_names(other), np.arange(len(other)))
    times = np.sort(np.random.default_rng(2).choice(400, 40, replace=False))
    exposures = ExposureModel(40, rate=0.02)
    known, trained = np.sin(times / 40)[:, None] * np.ones(3), np.arange(40) % 8 != 0
    exposures.log_gains[trained], exposures.steps[trained] = known[trained], 1
    off = []
    for names in ([f"{time:04}.jpg" for time in times], NAMES[:40]):
        exposures.estimate_untrained(names)
        off.append(np.abs(exposures.log_gains - known)[~trained][1:-1].max())
    assert off[0] < 0.03 < off[1]


def test_exposure_of_held_out_view_is_interpolated() -> None:
    places = np.arange(33)
    smooth, anew = np.sin(places / 5)[:, None] * np.ones(3), np.random.default_rng(0).normal(size=(33, 3))
    for known, told in ((smooth, True), (anew, False)):
        exposures = ExposureModel(33, rate=0.02)
        trained = places % 8 != 0
        exposures.log_gains[trained], exposures.steps[trained] = known[trained], 1
        exposures.estimate_untrained(NAMES[:33])
        np.testing.assert_array_equal(exposures.log_gains[trained], known[trained].astype(np.float32))
        off = np.abs(exposures.log_gains[~trained] - known[~trained])
        if told:
            assert off[1:-1].max() < 0.05
        else:
            assert np.abs(exposures.log_gains[~trained]).max() < 0.4 * np.abs(known).max()
        assert (exposures.offsets == 0).all()


def test_test_view_exposure_follows_brightness() -> None:
    """Log gains that fall with the brightness, and jump once, are found."""
    rng = np.random.default_rng(4)
    places, brightness = np.arange(65), rng.uniform(0.2, 0.7, 65)
    known = (0.4 * (0.45 - brightness) + 0.1 * (places >= 37))[:, None] * np.array([1.0, 0.9, 1.1])
    trained = places % 8 != 0
    known -= known[trained].mean(axis=0)
    off = []
    for shown in (None, brightness):
        exposures = ExposureModel(65, rate=0.02)
        exposures.log_gains[trained], exposures.steps[trained] = known[trained], 1
        exposures.estimate_untrained(NAMES[:65], shown)
        off.append(np.sqrt(np.mean((exposures.log_gains - known)[~trained] ** 2)))
    assert off[1] < 0.01 < 0.04 < off[0]


def test_exposure_uncorrelated_brightness_keeps_mean() -> None:
    """Where each photograph is exposed anew, whatever it shows, held-out views keep about the mean."""
    rng = np.random.default_rng(5)
    places = np.arange(65)
    trained = places % 8 != 0
    sizes = []
    for _ in range(20):
        exposures = ExposureModel(65, rate=0.02)
        exposures.log_gains[trained], exposures.steps[trained] = rng.normal(0, 0.1, (56, 3)), 1
        exposures.estimate_untrained(NAMES[:65], rng.uniform(0.2, 0.7, 65))
        sizes.append(float(np.abs(exposures.log_gains[~trained]).max()))
    assert np.median(sizes) < 0.04


class AutomaticWorld(UnevenWorld):
    """A camera that exposes by the mean of what it looks at, so that all its photographs are as bright.

    The plane is brighter to the right; the held-out photographs were exposed in the same way.
    """

    def __init__(self) -> None:
        PlanarDataset.__init__(self, count=16, held_out=3)
        rng = np.random.default_rng(6)
        self.origins[:, 0] = rng.permutation(np.linspace(-0.5, 0.5, 16))
        self.views = tuple(
            replace(view, translation_cam_from_world=-origin)
            for view, origin in zip(self.views, self.origins, strict=True)
        )
        self.log_gains = np.zeros(16, np.float32)
        y, x = np.divmod(np.arange(self.side_px**2), self.side_px)
        means = [float(self.pixels(np.full(len(x), k), y, x)[0].mean()) for k in range(16)]
        self.log_gains = np.log(np.mean(means) / np.array(means)).astype(np.float32)

    def shown(self, rays: RayBatch) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        rgb, alpha, weight = super().shown(rays)
        points = rays.origins_world - rays.directions_world * (
            rays.origins_world[:, 2:] / rays.directions_world[:, 2:]
        )
        return rgb * (1 + 0.4 * np.clip(points[:, :1], -1.4, 1.4)).astype(np.float32), alpha, weight


@pytest.mark.exhaustive
def test_test_photographs_with_auto_exposure_are_matched(tmp_path: Path) -> None:
    world = AutomaticWorld()
    assert world.log_gains.std() > 0.08
    config = small_config(iterations=400, exposure=True, lr={"exposure": 0.02})
    trainer = Trainer(
        world, config, initial_state(world.initial_gaussians(), config.seed),
        folder=tmp_path, fingerprint="test",
        progress=lambda _event: None, threads=1,
    )  # fmt: skip
    trainer.run()
    found = trainer.shading
    assert isinstance(found, ExposureModel)
    mean = world.log_gains[world.train_indices].mean()
    mid = 0.3
    shown = (np.exp(found.log_gains) * mid + found.offsets).mean(axis=1)
    expected = np.exp(world.log_gains - mean) * mid
    off = np.abs(shown - expected)
    spread = float(np.abs(expected[world.test_indices] - mid).max())
    assert off[world.test_indices].max() < 0.4 * spread


def test_named_view_is_rendered_with_its_exposure() -> None:
    rng = np.random.default_rng(0)
    exposures = made_exposures(3, rng)
    views = np.array([1, 1, 1])
    seen = sight(views, rng.random((3, 3), dtype=np.float32), rng.random(3, dtype=np.float32))
    shown = exposures.for_view(1).shade(replace(seen, view=None)).rgb_srgb
    np.testing.assert_array_equal(shown, exposures.shade(seen).rgb_srgb)
    again = ExposureModel(3, rate=0.02)
    again.load_known(["a", "b", "c"], {**exposures.as_dict(["a", "b", "x"]), "d": {}})
    np.testing.assert_array_equal(again.log_gains[:2], exposures.log_gains[:2])
    assert (again.log_gains[2] == 0).all()


@pytest.mark.parametrize("recipe", ["split_sum", "near_field", "ref_gaussian"])
def test_materials_are_measured_with_the_exposure_of_the_view(recipe: Recipe) -> None:
    """A measured picture is a mean over rays of radiance, which is exposed as the colors of one ray are."""
    settings = MaterialSettings(learn=True, environment_height=16, recipe=recipe)
    model = material_shading(recipe)(settings, extent_world=1.0)
    exposures = ExposureModel(3, rate=0.0, inner=model)
    exposures.log_gains[1], exposures.offsets[1] = [-0.7, -0.5, 0.1], [0.02, -0.01, 0.03]
    gaussians = add_initial_materials(PlanarDataset().initial_gaussians(400, opacity=0.9), settings)
    tracer = CpuTracer(threads=1)
    tracer.build(gaussians, exposures.features(gaussians))
    rays = PinholeCamera.looking_at((0, 0, -2), (0, 0, 0), 8, 8, fov_y_degrees=20).rays()
    black = np.zeros(3, np.float32)
    for view in (0, 1):
        one_ray = render_rays(tracer, rays, black, exposures.for_view(view)).rgb_srgb.mean(axis=(0, 1))
        measured = render_filtered(tracer, rays, black, exposures.for_view(view), 2).rgb_srgb.mean(
            axis=(0, 1)
        )
        np.testing.assert_allclose(measured, one_ray, atol=0.02)


def test_changing_brightness_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    world = UnevenWorld()
    rng = np.random.default_rng(3)
    points = rng.uniform(-1, 1, (400, 2))
    parts = []
    for index, origin in enumerate(world.origins):
        # A point of the plane in the pixels of a view, two units before it.
        xy = (points - origin[:2]) / 2 * world.side_px + world.side_px / 2
        inside = np.flatnonzero(((xy > 0) & (xy < world.side_px)).all(axis=1))
        parts.append((np.full(len(inside), index), inside, xy[inside]))
    world.observations = Observations(*(np.concatenate(column) for column in zip(*parts, strict=True)))
    found = relative_log_brightness(world)
    assert np.isnan(found[world.test_indices]).all()
    true = world.log_gains[world.train_indices]
    np.testing.assert_allclose(found[world.train_indices], true - np.median(true), atol=0.08)
    half = len(world.observations) * len(world.train_indices) // len(world.views) // 2
    monkeypatch.setattr(exposure_changes, "MAX_OBSERVATIONS", half)
    of_some = relative_log_brightness(world)
    assert (of_some != found)[world.train_indices].any()
    np.testing.assert_allclose(of_some[world.train_indices], true - np.median(true), atol=0.08)
    monkeypatch.undo()
    learns, reason = resolve_exposure("auto", world, has_materials=False)
    assert learns is True and reason is not None and "1.9 times" in reason
    assert resolve_exposure(False, world, has_materials=False) == (False, None)
    assert resolve_exposure("auto", world, has_materials=True) == (False, None)
    world.log_gains[:] = 0
    assert exposure_change_notice(relative_log_brightness(world)) is None
    assert resolve_exposure("auto", world, has_materials=False)[0] is False
    world.observations = Observations(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 2)))
    assert exposure_change_notice(relative_log_brightness(world)) is None


def test_exposure_disabled_learns_nothing(tmp_path: Path) -> None:
    trainer, _ = run(tmp_path, small_config(exposure=False))
    assert trainer.state.shading == {}


def test_photograph_is_normalised_to_mean_exposure() -> None:
    rng = np.random.default_rng(8)
    exposures = ExposureModel.from_known(
        ["a", "b"], {"b": {"log_gains": [0.1, -0.2, 0.3], "offsets": [0.02, 0, -0.05]}}
    )
    scene = rng.uniform(0.2, 0.6, (4, 5, 3)).astype(np.float32)
    seen = sight(np.ones(20, np.int64), scene.reshape(-1, 3), np.ones(20, np.float32))
    photograph = exposures.shade(seen).rgb_srgb.reshape(scene.shape)
    assert np.abs(photograph - scene).max() > 0.02
    np.testing.assert_allclose(exposures.remove_exposure(photograph, 1), scene, atol=1e-6)
    np.testing.assert_array_equal(exposures.remove_exposure(scene, 0), scene)

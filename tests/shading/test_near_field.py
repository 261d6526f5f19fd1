"""Mirrors among what they reflect: what reflected rays see of it, what stays on harmonics, and gradients."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks import mirror_room
from octasplat.engine.core.color import linear_to_srgb, srgb_to_linear
from octasplat.engine.core.rays import RayBatch
from octasplat.engine.dataset import Dataset
from octasplat.engine.gaussians.model import SH_C0, FlatGaussians, concatenate
from octasplat.engine.shading import near_field
from octasplat.engine.shading.deferred import DeferredShading
from octasplat.engine.shading.material_settings import MaterialSettings
from octasplat.engine.shading.protocol import ShadedRays, TracedRays
from octasplat.engine.shading.recipes import material_shading
from octasplat.engine.trace.cpu.tracer import CpuTracer
from octasplat.engine.trace.protocol import TraceSettings
from octasplat.engine.train.initialization.initial_gaussians import add_initial_materials
from octasplat.engine.train.loop.iteration import loss_and_gradients
from tests.shading.test_deferred import BARE, floor, wall
from tests.support.planar_dataset import PlanarDataset, batch_source, small_config

SH_C1 = 0.4886025
"""Of the harmonic along z."""
LID_SRGB = np.array([0.7, 0.4, 0.2])
TINT = np.array([0.9, 0.8, 0.7])


def settings(**more: object) -> MaterialSettings:
    return MaterialSettings.model_validate(
        {**BARE, "recipe": "near_field", "blur": 0.0, "reflection_ray_slope": (1e-3, 1e-3), **more}
    )


def mirror_below_lid() -> FlatGaussians:
    """A mirror at z = 0, and a matt lid of one color half a unit above it, closed as far as rays go."""
    mirror = wall((0, 0, 1), floor(0.6, 0.05), [*TINT.tolist(), 1.0, 0.02])
    lid = wall((0, 0, -1), floor(1.2, 0.05, above=0.5), [0.5, 0.5, 0.5, 0.0, 1.0])
    lid.sh[:, 0] = (LID_SRGB - 0.5) / SH_C0
    return concatenate([mirror, lid])


def seen(scene: FlatGaussians, model: DeferredShading, rays: RayBatch, view: int | None = None) -> ShadedRays:
    tracer = CpuTracer(TraceSettings(q=30.0, transmittance_min=1e-6), threads=1)
    tracer.build(scene, model.features(scene))
    views = None if view is None else np.full(len(rays), view, np.int64)
    return model.shade(TracedRays(rays, tracer.trace(rays), tracer, views))


def rays_along(z: float) -> RayBatch:
    """Rays from between mirror and lid, down or up."""
    x, y = (values.ravel() for values in np.meshgrid(*[np.linspace(-0.2, 0.2, 5)] * 2))
    ways = np.stack([0.2 * x, 0.2 * y, np.full(len(x), z)], axis=1)
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    return RayBatch(np.stack([x, y, np.full(len(x), 0.25)], axis=1), ways)


def test_mirror_shows_harmonics_of_what_stands_around_it_in_no_light() -> None:
    scene, given = mirror_below_lid(), settings(ray_bias=0.01)
    near = material_shading("near_field")(given, extent_world=1.0)
    near.light.set_radiance(np.zeros((16, 32, 3), np.float32))
    up, down = rays_along(1.0), rays_along(-1.0)
    # the lid itself, as without materials
    np.testing.assert_allclose(seen(scene, near, up).rgb_srgb, np.tile(LID_SRGB, (25, 1)), atol=5e-3)
    # what a metal of this color mirrors head-on
    expected = linear_to_srgb(TINT * srgb_to_linear(LID_SRGB))
    shaded = seen(scene, near, down)
    np.testing.assert_allclose(shaded.rgb_srgb, np.tile(expected, (25, 1)), atol=0.02)
    np.testing.assert_allclose(shaded.layers["metallic"], 1.0, atol=1e-3)
    # the model of distant light alone sees nothing there
    far = DeferredShading(given, extent_world=1.0)
    far.light.set_radiance(np.zeros((16, 32, 3), np.float32))
    assert seen(scene, far, down).rgb_srgb.max() < 0.02


def test_mirrored_harmonics_are_those_in_the_direction_of_the_reflected_ray() -> None:
    scene = mirror_below_lid()
    sh = np.zeros((len(scene), 4, 3), np.float32)
    sh[:, 0], sh[:, 2] = scene.sh[:, 0], 0.4  # brighter where it is seen along z
    scene = FlatGaussians(
        scene.means_world, scene.quats_wxyz, scene.log_scales, scene.opacity_logits, sh, scene.channels
    )
    model = material_shading("near_field")(settings(ray_bias=0.01), extent_world=1.0)
    model.light.set_radiance(np.zeros((16, 32, 3), np.float32))
    expected = LID_SRGB + 0.4 * SH_C1
    np.testing.assert_allclose(
        seen(scene, model, rays_along(-1.0)).rgb_srgb.mean(axis=0),
        linear_to_srgb(TINT * srgb_to_linear(expected)),
        atol=0.02,
    )


def test_matt_surfaces_send_no_reflected_rays(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = mirror_below_lid()
    model = material_shading("near_field")(settings(), extent_world=1.0)
    traced: list[int] = []
    whole = CpuTracer.trace

    def counted(self: CpuTracer, rays: RayBatch, *, record: bool = False) -> object:
        traced.append(len(rays))
        return whole(self, rays, record=record)

    monkeypatch.setattr(CpuTracer, "trace", counted)
    seen(scene, model, rays_along(1.0))
    assert sum(traced) == 25
    traced.clear()
    seen(scene, model, rays_along(-1.0))
    assert sum(traced) == 3 * 25


def test_near_field_gradients_agree_with_finite_differences(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(near_field, "ALBEDO_WEIGHT", 0.0)  # a regulariser is not in the loss
    rng = np.random.default_rng(5)
    world = PlanarDataset()
    given = settings(roughness_probe_fraction=0.0)
    gaussians = add_initial_materials(world.initial_gaussians(opacity=0.6), given)
    gaussians.means_world[:, 2] = rng.permutation(np.linspace(-0.4, 0.4, len(gaussians)))
    gaussians.sh[:] = rng.uniform(-0.3, 0.3, gaussians.sh.shape)
    for values in gaussians.channels.values():
        values[:] = rng.uniform(0.2, 0.8, values.shape)
    model = material_shading("near_field")(given, extent_world=1.0)
    model.light.log_radiance[:] = rng.normal(-1, 0.4, model.light.log_radiance.shape)
    tracer = CpuTracer(TraceSettings(q=30.0, transmittance_min=1e-6), threads=1)
    config = small_config(loss={"l1": 0.0, "l2": 1.0})
    batch = batch_source(world, config).draw(rng)

    def look() -> tuple[float, dict[str, np.ndarray]]:
        tracer.build(gaussians, model.features(gaussians))
        found = loss_and_gradients(batch, tracer, model, config.loss, training_progress=1.0)
        features = np.zeros((len(gaussians), 6))
        features[found.gaussians.ids] = found.gaussians.features
        sh = np.zeros(gaussians.sh.shape)
        sh[found.gaussians.ids] = found.gaussians.sh
        return found.loss.value, {"albedo": features[:, :3], "metallic": features[:, 3:4], "sh": sh}

    for name, gradient in look()[1].items():
        parameter = gaussians.sh if name == "sh" else gaussians.channels[name]
        before = parameter.copy()
        direction = (gradient / np.linalg.norm(gradient)).astype(np.float32)
        values = []
        for sign in (1, -1):
            parameter[:] = before + sign * np.float32(0.02) * direction
            values.append(look()[0])
        parameter[:] = before
        expected = float((gradient * direction).sum())
        assert (values[0] - values[1]) / 0.04 == pytest.approx(expected, rel=0.03), name


def test_generated_room_is_a_dataset_whose_ball_mirrors_its_walls(tmp_path: Path) -> None:
    mirror_room.write_room(tmp_path / "room", views=4, side=24, points=300)
    dataset = Dataset.open(tmp_path / "room", tmp_path / "cache", threads=1)
    assert len(dataset.views) == 4
    # straight at the ball it shows the wall behind the camera
    eye, ahead = np.array([[1.7, -0.1, 1.1]]), np.array([[-1.0, 0.0, 0.0]])
    wall_behind = mirror_room.wall_colors(np.array([[2.0, -0.1, 1.1]]))
    np.testing.assert_allclose(mirror_room.radiance(eye, ahead), mirror_room.TINT * wall_behind, rtol=1e-6)
    np.testing.assert_allclose(mirror_room.radiance(eye, -ahead), wall_behind, rtol=1e-6)
    assert mirror_room.compare(tmp_path / "room" / "images", tmp_path / "room")["ball"] == np.inf

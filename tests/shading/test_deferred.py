"""The model of materials: its gradients through the tracer, a scene of known light, stopping and going on."""

from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.core.events import Event, HeldOutMeasured
from octasplat.engine.core.rays import RayBatch
from octasplat.engine.gaussians.channels import stack_channels
from octasplat.engine.gaussians.frames import frames_from_normals, quaternions_from_matrices
from octasplat.engine.gaussians.model import FlatGaussians, concatenate
from octasplat.engine.shading import deferred
from octasplat.engine.shading.ambient_occlusion import ambient_visibility, diffuse_interreflection
from octasplat.engine.shading.deferred import DeferredShading
from octasplat.engine.shading.gbuffer import RayOffset
from octasplat.engine.shading.material_settings import MaterialSettings
from octasplat.engine.shading.protocol import ShadedRayGradients, TracedRays
from octasplat.engine.trace.cpu.tracer import CpuTracer
from octasplat.engine.trace.gradient_sums import add_gradients
from octasplat.engine.trace.protocol import TraceResult, TraceSettings
from octasplat.engine.train.initialization.initial_gaussians import add_initial_materials
from octasplat.engine.train.loop.iteration import loss_and_gradients
from octasplat.engine.train.loop.state import TrainState, initial_state
from octasplat.engine.train.loop.trainer import Trainer
from octasplat.engine.train.shading_factory import ShadingOptions, make_shading
from tests.support.planar_dataset import PlanarDataset, batch_source, small_config
from tests.support.stopped_run import train_with_a_stop

BARE = {
    "learn": True,
    "environment_height": 16,
    "ambient_occlusion_rays": 4,
    "normal_weight": 0.0,
    "depth_normal_weight": 0.0,
    "smooth_weight": 0.0,
    "smooth_gloss_weight": 0.0,
    "smooth_normal_weight": 0.0,
    "harmonics_weight": 0.0,
    "white_weight": 0.0,
    "environment_smoothness_weight": 0.0,
}


def wall(normal: tuple[float, float, float], points: np.ndarray, material: list[float]) -> FlatGaussians:
    count = len(points)
    gaussians = FlatGaussians(
        points.astype(np.float32),
        quaternions_from_matrices(frames_from_normals(np.tile(np.array(normal, float), (count, 1)))).astype(
            np.float32
        ),
        np.full((count, 2), np.log(0.1), np.float32),
        np.full(count, 5.0, np.float32),
        np.zeros((count, 1, 3), np.float32),
    )
    gaussians = add_initial_materials(gaussians, MaterialSettings())
    for name, values in {
        "albedo": material[:3],
        "metallic": material[3:4],
        "roughness": material[4:],
    }.items():
        gaussians.channels[name][:] = values
    return gaussians


def floor(side: float, step: float, above: float = 0.0) -> np.ndarray:
    x, y = np.meshgrid(*[np.arange(-side, side, step)] * 2)
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, above)], axis=1)


@pytest.mark.parametrize("indirect", ["shaded", "harmonics"])
def test_gradients_agree_with_finite_differences(indirect: str) -> None:
    rng = np.random.default_rng(5)
    world = PlanarDataset()
    settings = MaterialSettings(
        **BARE, indirect=indirect, blur=0.0, ambient_occlusion=False, roughness_probe_fraction=0.0
    )
    gaussians = add_initial_materials(world.initial_gaussians(opacity=0.6), settings)
    gaussians.means_world[:, 2] = rng.permutation(np.linspace(-0.4, 0.4, len(gaussians)))
    for values in gaussians.channels.values():
        values[:] = rng.uniform(0.2, 0.8, values.shape)
    model = DeferredShading(settings, extent_world=1.0)
    model.light.log_radiance[:] = rng.normal(-1, 0.4, model.light.log_radiance.shape)
    tracer = CpuTracer(TraceSettings(q=30.0, transmittance_min=1e-6), threads=1)
    config = small_config(loss={"l1": 0.0, "l2": 1.0})
    batch = batch_source(world, config).draw(rng)

    def look() -> tuple[float, dict[str, np.ndarray]]:
        tracer.build(gaussians, model.features(gaussians))
        found = loss_and_gradients(batch, tracer, model, config.loss, training_progress=1.0)
        by_light = model.light._prefilter.backward(found.shading["materials.texels"])
        whole = {"light": by_light * model.light.radiance_linear}
        features = np.zeros((len(gaussians), 9))
        features[found.gaussians.ids] = found.gaussians.features
        whole |= {"albedo": features[:, :3], "metallic": features[:, 3:4], "roughness": features[:, 4:5]}
        return found.loss.value, whole

    for name, gradient in look()[1].items():
        if indirect == "shaded" and name == "roughness":
            continue  # no gradient goes through where the facets lie, which follows from it
        parameter = model.light.log_radiance if name == "light" else gaussians.channels[name]
        before = parameter.copy()
        direction = (gradient / np.linalg.norm(gradient)).astype(np.float32)
        values = []
        for sign in (1, -1):
            parameter[:] = before + sign * np.float32(0.02) * direction
            model.light._levels = None
            values.append(look()[0])
        parameter[:] = before
        model.light._levels = None
        expected = float((gradient * direction).sum())
        assert (values[0] - values[1]) / 0.04 == pytest.approx(expected, rel=0.03), name


def test_deferred_reflected_gaussians_have_opacity_gradients() -> None:
    mirror = wall((0, 0, 1), floor(0.6, 0.1), [0.9, 0.8, 0.7, 1.0, 0.02])
    lid = wall((0, 0, 1), floor(0.3, 0.1, above=0.5), [0.5, 0.3, 0.1, 0.0, 1.0])
    lid.opacity_logits[:] = np.random.default_rng(1).uniform(-2, 0, len(lid))
    scene, hung = concatenate([mirror, lid]), slice(len(mirror), None)
    settings = MaterialSettings(
        **BARE, blur=0.0, ambient_occlusion=False, reflection_ray_slope=(1e-3, 1e-3), ray_bias=0.01
    )
    model = DeferredShading(settings, extent_world=1.0)
    model.light.set_radiance(np.full((16, 32, 3), 0.5, np.float32))
    x, y = (values.ravel() for values in np.meshgrid(*[np.linspace(-0.2, 0.2, 9)] * 2))
    ways = np.stack([0.2 * x, 0.2 * y, np.full(len(x), -1.0)], axis=1)
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    rays = RayBatch(np.stack([x, y, np.full(len(x), 0.3)], axis=1), ways)  # begun below the lid
    target = np.float32(0.4)
    tracer = CpuTracer(TraceSettings(q=30.0, transmittance_min=1e-6), threads=1)

    def look() -> tuple[float, np.ndarray]:
        tracer.build(scene, model.features(scene))
        seen = tracer.trace(rays, record=True)
        assert seen.recording is not None
        sight = TracedRays(rays, seen, tracer, np.zeros(len(rays), np.int64))
        developed = model.shade(sight)
        error = developed.rgb_srgb - target
        back = model.backward(
            sight, developed, ShadedRayGradients(2 * error, np.zeros(len(rays), np.float32))
        )
        recorded = [(seen.recording, back.trace), *back.recorded_traces]
        found = add_gradients([tracer.backward(hits, by).numpy() for hits, by in recorded])
        whole = np.zeros(len(scene))
        whole[found.ids] = found.opacity_logits
        return float((error.astype(np.float64) ** 2).sum()), whole[hung]

    _, gradient = look()
    direction = (gradient / np.linalg.norm(gradient)).astype(np.float32)
    before, values = scene.opacity_logits[hung].copy(), []
    for sign in (1, -1):
        scene.opacity_logits[hung] = before + sign * np.float32(0.05) * direction
        values.append(look()[0])
    assert (values[0] - values[1]) / 0.1 == pytest.approx(float((gradient * direction).sum()), rel=0.03)


def test_deferred_roughness_gradient_follows_reflection_sharpness() -> None:
    rough = wall((0, 0, 1), floor(0.8, 0.1), [0.9, 0.9, 0.9, 1.0, 0.35])
    lid = wall((0, 0, 1), floor(0.25, 0.1, above=0.6), [0.4, 0.4, 0.4, 0.0, 1.0])
    scene = concatenate([rough, lid])
    model = DeferredShading(
        MaterialSettings(**BARE, ambient_occlusion=False, roughness_probe_fraction=1.0, ray_bias=0.01),
        extent_world=1.0,
    )
    model.light.set_radiance(np.full((16, 32, 3), 0.2, np.float32))
    rng = np.random.default_rng(2)
    ways = np.concatenate([rng.uniform(-0.05, 0.05, (3000, 2)), np.full((3000, 1), -1.0)], axis=1)
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    places = np.concatenate([rng.uniform(-0.05, 0.05, (3000, 2)), np.full((3000, 1), 0.3)], axis=1)
    rays, ones = RayBatch(places, ways), np.ones((3000, 3), np.float32)
    tracer = CpuTracer(threads=1)

    def look() -> tuple[float, float]:
        """The sum of what is shown, and its gradient by all roughnesses together."""
        tracer.build(scene, model.features(scene))
        seen = tracer.trace(rays, record=True)
        assert seen.recording is not None
        sight = TracedRays(rays, seen, tracer, np.zeros(3000, np.int64))
        developed = model.shade(sight)
        back = model.backward(sight, developed, ShadedRayGradients(ones, np.zeros(3000, np.float32)))
        found = tracer.backward(seen.recording, back.trace).numpy()
        return float(developed.rgb_srgb.sum(dtype=np.float64)), float(found.features[:, 4].sum())

    _, found = look()
    values = []
    for sign in (1, -1):
        scene.channels["roughness"][: len(rough)] = 0.35 + sign * 0.02
        values.append(look()[0])
    expected = (values[0] - values[1]) / 0.04
    # Straight above is the lid, which is darker; a wider lobe sees more of what is around. Its edge is no
    # parabola, so that the gradient is right in its sign and about its size.
    assert expected > 100
    assert 0.3 < found / expected < 3


def test_deferred_mirror_reflects_gaussians_and_environment() -> None:
    mirror = wall((0, 0, 1), floor(1.0, 0.1), [1, 1, 1, 1, 0.05])
    red = wall((0, 0, 1), floor(1.0, 0.1, above=1.0), [1, 0, 0, 0.0, 1.0])
    settings = MaterialSettings(**BARE, up_world=(0, 0, 1))
    model = DeferredShading(settings, extent_world=1.0)
    radiance = np.full((16, 32, 3), 0.05, np.float32)
    radiance[:8] = 0.5  # the upper half
    model.light.set_radiance(radiance)
    down = np.array([[0.0, 0.05, -1.0]]) / np.hypot(1, 0.05)
    rays = RayBatch(np.array([[0, 0, 0.5]]), down)
    # The red wall's lower side: matt, lit by the lower half, and four percent of gloss.
    for scene, expected in (
        (mirror, [0.5] * 3),
        (concatenate([mirror, red]), [0.05 * 1.02, 0.0012, 0.0012]),
    ):
        tracer = CpuTracer(threads=1)
        tracer.build(scene, model.features(scene))
        shown = model.shade(TracedRays(rays, tracer.trace(rays), tracer)).rgb_srgb[0]
        linear = np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)
        np.testing.assert_allclose(linear, expected, atol=0.012)


class CountingTracer(CpuTracer):
    """A tracer that counts the rays that it records."""

    recorded_rays = 0

    def trace(self, rays: RayBatch, *, record: bool = False) -> TraceResult:
        self.recorded_rays += len(rays) if record else 0
        return super().trace(rays, record=record)


def test_views_that_are_only_measured_record_no_reflected_rays() -> None:
    """Recordings take memory for each hit, and a grid over all training views has many rays."""
    mirrors = concatenate(
        [wall((0, 0, 1), floor(1.0, 0.1, above=above), [1, 1, 1, 1, 0.3]) for above in (0.0, 1.0)]
    )
    settings = MaterialSettings(**{**BARE, "roughness_probe_fraction": 1.0}, up_world=(0, 0, 1))
    model = DeferredShading(settings, extent_world=1.0)
    model.light.set_radiance(np.full((16, 32, 3), 0.5, np.float32))
    rays = RayBatch(np.tile([[0, 0, 0.5]], (8, 1)), np.tile([[0.0, 0.6, -0.8]], (8, 1)))
    tracer, views = CountingTracer(threads=1), np.zeros(8, np.int64)
    tracer.build(mirrors, model.features(mirrors))
    measured = model.shade(TracedRays(rays, tracer.trace(rays), tracer, views))
    assert tracer.recorded_rays == 0
    learnt = model.shade(TracedRays(rays, tracer.trace(rays, record=True), tracer, views))
    assert tracer.recorded_rays > 3 * 8  # two from each point, and on from the other mirror
    np.testing.assert_array_equal(measured.rgb_srgb, learnt.rgb_srgb)


def test_many_rays_that_are_only_measured_are_shaded_some_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """A picture of 800 px has half a million rays, and each takes kilobytes with those that it sends on."""
    mirrors = concatenate(
        [wall((0, 0, 1), floor(1.0, 0.1, above=above), [1, 1, 1, 1, 0.3]) for above in (0.0, 1.0)]
    )
    model = DeferredShading(MaterialSettings(**BARE, up_world=(0, 0, 1)), extent_world=1.0)
    model.light.set_radiance(np.random.default_rng(0).random((16, 32, 3), np.float32))
    ways = np.random.default_rng(1).normal((0.0, 0.6, -0.8), 0.2, (1000, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    rays, tracer = RayBatch(np.array([[0, 0, 0.5]]), ways), LargestTraceTracer(threads=1)
    tracer.build(mirrors, model.features(mirrors))
    traced = TracedRays(rays, tracer.trace(rays), tracer, dither=np.random.default_rng(2).random((2, 1000)))
    together = model.shade(traced)
    monkeypatch.setattr(deferred, "MEASURED_RAYS_AT_ONCE", 128)
    tracer.most_rays = 0
    parts = model.shade(traced)
    assert 128 < tracer.most_rays <= 2 * 128  # a pair from each point
    np.testing.assert_array_equal(parts.rgb_srgb, together.rgb_srgb)
    np.testing.assert_array_equal(parts.transmittance, together.transmittance)
    assert parts.layers.keys() == together.layers.keys() != set()
    for name, layer in together.layers.items():
        np.testing.assert_array_equal(parts.layers[name], layer)


class LargestTraceTracer(CpuTracer):
    """A tracer that keeps the largest number of rays that it traced at once."""

    most_rays = 0

    def trace(self, rays: RayBatch, *, record: bool = False) -> TraceResult:
        self.most_rays = max(self.most_rays, len(rays))
        return super().trace(rays, record=record)


def test_deferred_reflection_rays_skip_own_surface() -> None:
    places = floor(1.0, 0.05)
    places[:, 2] = np.random.default_rng(3).uniform(-0.03, 0.03, len(places))
    mirror = wall((0, 0, 1), places, [1, 1, 1, 1, 0.05])
    mirror.opacity_logits[:] = -1.5
    down = np.array([[0.6, 0.0, -0.8]])
    rays = RayBatch(np.array([[-0.3, 0, 0.4]]), down)
    seen = []
    for leaves in (0.0, 0.1):
        model = DeferredShading(
            MaterialSettings(**BARE, ray_bias=1e-3, backface_cull_distance=leaves), extent_world=1.0
        )
        model.light.set_radiance(np.full((16, 32, 3), 0.5, np.float32))
        tracer = CpuTracer(TraceSettings(flip_normal_cos=0.5), threads=1)
        tracer.build(mirror, model.features(mirror))
        seen.append(model.shade(TracedRays(rays, tracer.trace(rays), tracer)).layers["visibility"][0, 0])
    assert seen[0] < 0.9
    assert seen[1] > 0.99


def test_ambient_visibility_under_a_lid_is_its_form_factor() -> None:
    ground = wall((0, 0, 1), np.zeros((1, 3)), [0.5] * 5)
    lid = wall((0, 0, 1), floor(2.0, 0.08, above=1.0) + 0.04, [0.5] * 5)
    lid = lid.select(np.linalg.norm(lid.means_world[:, :2], axis=1) < 1)
    below = lid.copy()  # so that no side of the ground is open
    below.means_world[:, 2] = -0.2
    both = concatenate([ground, lid, below])
    tracer = CpuTracer(threads=1)
    tracer.build(both)
    one = np.array([0])
    found, side = ambient_visibility(both, one, tracer, rays=2000, offset=RayOffset(0.01))
    bounced = diffuse_interreflection(
        both, one, side, lambda rays: (1 - tracer.transmittance(rays))[:, None] * np.array([[3.0, 2.0, 1.0]]),
        rays=2000, offset=RayOffset(0.01),
    )  # fmt: skip
    # A lid that shines evenly sends what it hides.
    np.testing.assert_allclose(bounced[0], (1 - found[0]) * np.array([3, 2, 1]), rtol=1e-4)
    radius = 1.1  # the disc and what of its outermost Gaussians is about opaque
    assert found[0] == pytest.approx(1 - radius**2 / (radius**2 + 1), abs=0.05)


@pytest.mark.parametrize("rebuilds", [128, 100, 64, 20])
def test_ambient_visibility_updates_every_gaussian(rebuilds: int, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = MaterialSettings(learn=True, ambient_occlusion_rebuilds=20, secondary_from=0.0)
    gaussians = add_initial_materials(wall((0, 0, 1), floor(2, 0.25), [0.5, 0.5, 0.5, 0, 0.5]), settings)
    looked: list[np.ndarray] = []

    def look_around(
        model: DeferredShading, gaussians: FlatGaussians, ids: np.ndarray, tracer: object
    ) -> np.ndarray:
        looked.append(ids)
        return np.ones(len(ids), np.float32)

    monkeypatch.setattr(DeferredShading, "measure_ambient_occlusion", look_around)
    monkeypatch.setattr(DeferredShading, "measure_diffuse_interreflection", lambda *_: None)
    model, tracer = DeferredShading(settings, extent_world=1.0), CpuTracer(TraceSettings())
    for turn in range(20):
        model.on_rebuild(gaussians, tracer, training_progress=turn / rebuilds)
        if turn == 7:  # stopped and gone on with
            again = DeferredShading(settings, extent_world=1.0)
            again.restore(model.state())
            model = again
            model.on_rebuild(gaussians, tracer, training_progress=turn / rebuilds)
            np.testing.assert_array_equal(looked.pop(), looked[-1])
    assert sorted(np.concatenate(looked).tolist()) == list(range(len(gaussians)))


def train(
    folder: Path, *, stop_after: int | None = None, threads: int = 1, recipe: str = "split_sum"
) -> tuple[DeferredShading, TrainState, list[float]]:
    """Train materials; with ``stop_after``, stop there and go on from the checkpoint with a fresh model."""
    world, events = PlanarDataset(), list[Event]()
    materials = {
        "learn": True,
        "environment_height": 16,
        "ambient_occlusion_rays": 4,
        "ambient_occlusion_rebuilds": 2,
        "recipe": recipe,
        "normal_propagation": True,
    }
    config = small_config(
        materials=materials,
        sh_degree=0,
        iterations=72,
        trace={"flip_normal_cos": 0.0 if recipe == "ref_gaussian" else 0.5},
    )
    first = add_initial_materials(world.initial_gaussians(opacity=0.6), config.materials)
    state = initial_state(first, config.seed)

    models: list[DeferredShading] = []

    def trainer(state: TrainState, last: float) -> Trainer:
        model = make_shading(ShadingOptions.from_config(config), len(world.views), world.extent)
        assert isinstance(model, DeferredShading)
        models.append(model)
        return Trainer(
            world, config, state, folder=folder, fingerprint="test", progress=events.append, threads=threads,
            should_stop=lambda: state.iteration >= last, shading=models[-1],
        )  # fmt: skip

    _, state = train_with_a_stop(trainer, state, folder, stop_after)
    model = models[-1]
    return model, state, [event.psnr for event in events if isinstance(event, HeldOutMeasured)]


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    ("recipe", "stop_after"), [("split_sum", 40), ("split_sum", 50), ("ref_gaussian", 50), ("near_field", 50)]
)
def test_deferred_training_resumes_to_same_bytes_on_any_threads(
    tmp_path: Path, recipe: str, stop_after: int
) -> None:
    whole, state, psnr = train(tmp_path / "whole", recipe=recipe)
    assert psnr[-1] > psnr[0] + (1 if recipe == "split_sum" else 0.3)
    parts, resumed, _ = train(tmp_path / "parts", stop_after=stop_after, threads=2, recipe=recipe)
    assert parts.light.log_radiance.tobytes() == whole.light.log_radiance.tobytes()
    assert (
        stack_channels(resumed.gaussians.channels).tobytes()
        == stack_channels(state.gaussians.channels).tobytes()
    )
    assert resumed.gaussians.quats_wxyz.tobytes() == state.gaussians.quats_wxyz.tobytes()
    assert np.ptp(state.gaussians.channels["albedo"]) > 0.05

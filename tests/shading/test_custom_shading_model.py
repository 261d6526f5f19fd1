"""A model that uses everything the protocol has trains through the real trainer, its gradients are right.

It shades by a channel of the Gaussians, their normals and a lamp that belongs to the scene, and adds what
further rays of its own see. So nothing in the loop has to change for a model of materials.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from jaxtyping import Float32

from octasplat.engine.core.events import Event, HeldOutMeasured
from octasplat.engine.core.rays import RayBatch
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.shading.exposure import ExposureModel
from octasplat.engine.shading.protocol import (
    ShadedRayGradients,
    ShadedRays,
    ShadingGradients,
    ShadingModel,
    ShadingStep,
    TracedRays,
)
from octasplat.engine.trace.cpu.tracer import CpuTracer
from octasplat.engine.trace.protocol import (
    TraceGradients,
    Tracer,
    TraceResult,
    TraceSettings,
)
from octasplat.engine.train.config import McmcConfig
from octasplat.engine.train.loop.iteration import loss_and_gradients
from octasplat.engine.train.loop.state import TrainState, initial_state
from octasplat.engine.train.loop.trainer import Trainer
from octasplat.engine.train.sampling.batches import Batch
from tests.support.planar_dataset import PlanarDataset, batch_source, small_config
from tests.support.stopped_run import train_with_a_stop

SHARE = np.float32(0.3)
ASIDE = np.array([0.2, 0.1, 0.0], np.float32)


class Lamp:
    """rgb = albedo * lamp * (1 - <normal, direction>) / 2 + 0.3 * what parallel rays see of the Gaussians."""

    name = "lamp"

    def __init__(self, gaussians: FlatGaussians) -> None:
        self.albedo = np.full((len(gaussians), 3), 0.4, np.float32)
        self.lamp = np.ones(3, np.float32)

    def features(self, gaussians: FlatGaussians) -> Float32[np.ndarray, "n 3"]:
        assert len(gaussians) == len(self.albedo)
        return self.albedo

    def on_rebuild(self, gaussians: FlatGaussians, tracer: Tracer, *, training_progress: float) -> None:
        self.settled = training_progress

    def _facing(self, traced: TracedRays) -> Float32[np.ndarray, "r 1"]:
        return (1 - (traced.result.normal_world * traced.rays.directions_world).sum(axis=1))[:, None] / 2

    def shade(self, traced: TracedRays) -> ShadedRays:
        rays = RayBatch(traced.rays.origins_world + ASIDE, traced.rays.directions_world, traced.rays.t_min)
        beside = traced.tracer.trace(rays, record=True)
        rgb = traced.result.features * self.lamp * self._facing(traced) + SHARE * beside.rgb_srgb
        return ShadedRays(rgb, traced.result.transmittance, beside)

    def backward(self, traced: TracedRays, shaded: ShadedRays, grad: ShadedRayGradients) -> ShadingGradients:
        grad_rgb, beside = grad.rgb_srgb, shaded.ctx
        assert isinstance(beside, TraceResult) and beside.recording is not None
        facing, features = self._facing(traced), traced.result.features
        grad_facing = (grad_rgb * features * self.lamp).sum(axis=1, keepdims=True)
        return ShadingGradients(
            TraceGradients(
                rgb_srgb=np.zeros_like(grad_rgb),
                transmittance=grad.transmittance,
                features=grad_rgb * self.lamp * facing,
                normal_world=-grad_facing / 2 * traced.rays.directions_world,
            ),
            recorded_traces=((beside.recording, TraceGradients(rgb_srgb=SHARE * grad_rgb)),),
            parameters={"lamp.lamp": (grad_rgb * features * facing).sum(axis=0)},
        )

    def step(self, update: ShadingStep) -> None:
        assert 0 <= self.settled <= update.training_progress < 1
        self.lamp -= np.float32(0.1) * update.parameters["lamp.lamp"]
        self.albedo[update.gradients.ids] -= np.float32(10) * update.gradients.features

    def state(self) -> dict[str, np.ndarray]:
        return {"lamp.albedo": self.albedo, "lamp.lamp": self.lamp}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        self.albedo, self.lamp = state["lamp.albedo"], state["lamp.lamp"]


def made(rng: np.random.Generator) -> tuple[FlatGaussians, Lamp, Batch]:
    world = PlanarDataset()
    gaussians = world.initial_gaussians(opacity=0.6)
    gaussians.sh += rng.normal(0, 0.3, gaussians.sh.shape).astype(np.float32)
    # Apart in depth, so that turning them a little changes no order.
    gaussians.means_world[:, 2] = rng.permutation(np.linspace(-0.4, 0.4, len(gaussians)))
    model = Lamp(gaussians)
    model.albedo[:] = rng.uniform(0.1, 0.9, model.albedo.shape)
    model.lamp[:] = (0.9, 0.7, 1.1)
    return gaussians, model, batch_source(world, small_config()).draw(rng)


def test_gradients_of_several_traces_agree_with_finite_differences() -> None:
    rng = np.random.default_rng(5)
    gaussians, lamp, batch = made(rng)
    # Exposures around it, so that models can be put into each other.
    model = ExposureModel(7, rate=0.01, inner=lamp)
    model.log_gains[:] = rng.normal(0, 0.2, (7, 3))
    # Octagons so wide that Gaussians have faded at their edges, through which no gradient goes.
    tracer = CpuTracer(TraceSettings(q=30.0, transmittance_min=1e-6), threads=1)
    weights = small_config(loss={"l1": 0.0, "l2": 1.0}).loss

    def look() -> tuple[float, dict[str, np.ndarray]]:
        tracer.build(gaussians, model.features(gaussians))
        found = loss_and_gradients(batch, tracer, model, weights, training_progress=0.5)
        whole = {"lamp": found.shading["lamp.lamp"]}
        for name, like in (
            ("features", lamp.albedo),
            ("sh", gaussians.sh),
            ("opacity_logits", gaussians.opacity_logits),
            ("quats_wxyz", gaussians.quats_wxyz),
        ):
            whole[name] = np.zeros_like(like)
            whole[name][found.gaussians.ids] = getattr(found.gaussians, name)
        return found.loss.value, whole

    _, gradients = look()
    for name, gradient in gradients.items():
        parameter = {"lamp": lamp.lamp, "features": lamp.albedo}.get(name)
        if parameter is None:
            parameter = getattr(gaussians, name)
        before = parameter.copy()
        direction = (gradient / np.linalg.norm(gradient)).astype(np.float32)
        step = np.float32(0.001 if name == "quats_wxyz" else 0.02)  # so small that no order changes
        parameter[:] = before + step * direction
        above, _ = look()
        parameter[:] = before - step * direction
        below, _ = look()
        parameter[:] = before
        expected = float((gradient * direction).sum())
        assert (above - below) / (2 * step) == pytest.approx(expected, rel=0.02), name


def train(folder: Path, *, stop_after: int | None = None) -> tuple[Lamp, TrainState, list[float]]:
    """Train the lamp; with ``stop_after``, stop there and go on from the checkpoint with a fresh model."""
    world, events = PlanarDataset(), list[Event]()
    config = small_config(densify=McmcConfig(start=10_000).model_dump(), sh_degree=0)
    state = initial_state(world.initial_gaussians(opacity=0.6), config.seed)

    models: list[Lamp] = []

    def trainer(state: TrainState, last: float) -> Trainer:
        models.append(Lamp(state.gaussians))
        return Trainer(
            world, config, state, folder=folder, fingerprint="test", progress=events.append, threads=1,
            should_stop=lambda: state.iteration >= last, shading=models[-1],
        )  # fmt: skip

    _, state = train_with_a_stop(trainer, state, folder, stop_after)
    model = models[-1]
    assert isinstance(model, ShadingModel)
    return model, state, [event.psnr for event in events if isinstance(event, HeldOutMeasured)]


@pytest.mark.exhaustive
def test_custom_shading_model_trains_and_resumes(tmp_path: Path) -> None:
    whole, state, psnr = train(tmp_path / "whole")
    assert psnr[-1] > psnr[0] + 4
    assert np.ptp(whole.albedo) > 0.1 and (whole.lamp != 1).all()
    parts, resumed, _ = train(tmp_path / "parts", stop_after=50)
    assert parts.albedo.tobytes() == whole.albedo.tobytes() and parts.lamp.tobytes() == whole.lamp.tobytes()
    assert resumed.gaussians.sh.tobytes() == state.gaussians.sh.tobytes()

"""The fit of residual colors after a training with materials: all but these is kept.

Materials and light explain a part of each photograph; the rest is fitted by harmonics of each Gaussian
(:mod:`octasplat.engine.shading.residual_colors`). Given geometry and shading, that is a linear problem, and
an iteration takes a fraction of one that shades, as what materials show along a ray is computed once.
"""

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32, Int64

from octasplat.engine.core.errors import CancelledError
from octasplat.engine.core.progress import ProgressCallback, no_progress
from octasplat.engine.core.threads import use_threads
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.shading.protocol import (
    ShadedRayGradients,
    ShadedRays,
    ShadingGradients,
    ShadingModel,
    TracedRays,
)
from octasplat.engine.shading.residual_colors import residual_of, with_residual
from octasplat.engine.shading.wrapper import WrapperModel
from octasplat.engine.trace.factory import make_tracer
from octasplat.engine.trace.protocol import TraceGradients
from octasplat.engine.train.config import (
    ITERATIONS_PER_BATCH,
    KEPT_BATCHES,
    LearningRates,
    LossWeights,
    TrainConfig,
)
from octasplat.engine.train.optimization.adam import Adam
from octasplat.engine.train.optimization.losses import pixel_loss
from octasplat.engine.train.optimization.weight_averaging import AVERAGING_INTERVAL, WeightAverage
from octasplat.engine.train.sampling.batches import Batch, BatchOptions, BatchSource
from octasplat.engine.train.sampling.pixel_sampler import TrainingData
from octasplat.engine.train.shading_factory import find_exposures

WEIGHT_DECAY = np.float32(0.001)
"""Share of the harmonics that each step takes off, so that what few rays tell stays small."""
AVERAGED_SHARE = 0.2
"""Of the iterations, the last ones, whose mean is taken."""
RATES = LearningRates(color=0.003, sh_rest_ratio=0.3, decay=0.1, quat=0, log_scale=0, opacity=0).model_copy(
    update={"mean": 1e-38, "mean_final": 1e-38}  # as good as none
)
"""Steps of the harmonics; nothing else moves."""
NO_REGULARIZATION = LossWeights().model_copy(update={"opacity": 0.0, "scale": 0.0})
PROGRESS_SECONDS = 0.5
"""Between two reports of the progress."""
_SEED_STREAM = 1
"""Tells this generator from that of the training, which has the seed alone."""


@dataclass(frozen=True)
class _ShadedBatch:
    """A batch with what materials show along its rays."""

    batch: Batch
    shaded: ShadedRays


class _ShadedPlusResidual(WrapperModel):
    """What was shaded before and the residual that is traced now, as a model that exposures can be put on."""

    name = "residual_fit"
    state_names = ()

    def __init__(self, inner: ShadingModel, shaded: ShadedRays) -> None:
        super().__init__(inner)
        self._shaded = shaded

    def shade(self, traced: TracedRays) -> ShadedRays:
        shaded = self._shaded
        return ShadedRays(shaded.rgb_srgb + residual_of(traced.result), shaded.transmittance)

    def backward(self, traced: TracedRays, shaded: ShadedRays, grad: ShadedRayGradients) -> ShadingGradients:
        # geometry is kept, so that the share of the residual in alpha does not matter
        return ShadingGradients(TraceGradients(grad.rgb_srgb))


def fit_residual_colors(
    gaussians: FlatGaussians,
    dataset: TrainingData,
    shading: ShadingModel,
    config: TrainConfig,
    *,
    iterations: int,
    excluded_views: Int64[np.ndarray, " m"],
    threads: int = 0,
    should_stop: Callable[[], bool] = lambda: False,
    progress: ProgressCallback = no_progress,
) -> Float32[np.ndarray, "n k 3"]:
    """Return harmonics of the residual color of each Gaussian, display values.

    Squared differences from the photographs are minimized by Adam; the mean of the last states is returned.

    Args:
        gaussians: as trained; they are kept.
        dataset: the photographs.
        shading: as trained: materials in their light, and exposures over them where these are learnt.
        config: settings of the training.
        iterations: so many steps.
        excluded_views: training views of which nothing is drawn.
        threads: for everything; 0 means all cores.
        should_stop: asked before each iteration.
        progress: called with the iterations done at the beginning, now and then, and at the end.

    Raises:
        CancelledError: stopped as asked.
    """
    threads = use_threads(threads)
    sh_shape = (len(gaussians), (config.sh_degree + 1) ** 2, 3)
    scene = with_residual(gaussians.copy(), np.zeros(sh_shape, np.float32))
    shaded_tracer = make_tracer(config.trace, threads=threads)
    shaded_tracer.build(gaussians, shading.features(gaussians))
    # one order for the rays of a packet: residual colors are small, and so is what it changes of them
    tracer = make_tracer(config.trace.model_copy(update={"sort": "packet"}), threads=threads)
    tracer.build(scene)
    exposures = find_exposures(shading)
    materials = shading if exposures is None else exposures.inner
    source = BatchSource(dataset, _batch_options(config, dataset))
    if len(excluded_views):
        source.exclude_views(excluded_views)
    rng = np.random.default_rng([config.seed, _SEED_STREAM])
    adam, average, kept = Adam.zeros(scene), WeightAverage(), deque[_ShadedBatch](maxlen=KEPT_BATCHES)
    reported_at = -PROGRESS_SECONDS
    for iteration in range(iterations):
        if time.monotonic() - reported_at >= PROGRESS_SECONDS:
            reported_at = time.monotonic()
            progress(iteration, iterations)
        if should_stop():
            raise CancelledError(
                "Stopped while fitting residual colors; the same command with --resume goes on."
            )
        if iteration % ITERATIONS_PER_BATCH == 0:
            batch = source.draw(rng, iteration // ITERATIONS_PER_BATCH)
            traced = TracedRays(batch.rays, shaded_tracer.trace(batch.rays), shaded_tracer)
            given = _ShadedBatch(batch, replace(materials.shade(traced), ctx=None, layers={}))
            kept.append(given)
        else:
            given = kept[int(rng.integers(len(kept)))]
        batch, known = given.batch, given.shaded
        result = tracer.trace(batch.rays, record=True)
        assert result.recording is not None
        traced = TracedRays(batch.rays, result, tracer, batch.view)
        model: ShadingModel = _ShadedPlusResidual(materials, known)
        if exposures is not None:
            model = exposures.over(model)
        shaded = model.shade(traced)
        render = shaded.composite_over(batch.background_srgb)
        loss = pixel_loss(render, batch.target_srgb, batch.weight, l1=0.0, l2=1.0)
        grad = ShadedRayGradients(loss.gradient, np.zeros(len(render), np.float32))
        gradients = tracer.backward(result.recording, model.backward(traced, shaded, grad).trace).numpy()
        adam.step(
            scene, gradients, RATES, NO_REGULARIZATION,
            training_progress=iteration / iterations, extent=dataset.extent,
        )  # fmt: skip
        scene.sh[gradients.ids] *= 1 - WEIGHT_DECAY
        left = iterations - 1 - iteration
        if left < AVERAGED_SHARE * iterations and left % AVERAGING_INTERVAL == 0:
            average.add(scene)
    progress(iterations, iterations)
    mean = average.gaussians
    return scene.sh if mean is None else mean.sh


def _batch_options(config: TrainConfig, dataset: TrainingData) -> BatchOptions:
    """Return how batches are drawn: as in the training, without what only geometry asks for."""
    return replace(
        BatchOptions.from_config(config, dataset),
        background="white" if config.background == "white" else "black",
        ssim_patch_fraction=None,
        visibility_ray_fraction=0.0,
        reads_depths=False,
        has_edge_rays=False,
    )

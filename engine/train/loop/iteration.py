"""One iteration of the training.

batch -> trace -> shade -> loss -> backward of shading and trace -> steps of the Gaussians and the shading
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from octasplat.engine.core.errors import TrainingError
from octasplat.engine.shading.protocol import (
    ShadedRayGradients,
    ShadingModel,
    ShadingStep,
    TracedRays,
)
from octasplat.engine.trace.gradient_sums import add_gradients, drop_low_weight
from octasplat.engine.trace.protocol import GaussianGradients, Tracer
from octasplat.engine.train.config import LearningRates, LossWeights
from octasplat.engine.train.densify import Densifier
from octasplat.engine.train.loop.state import TrainState
from octasplat.engine.train.optimization.depth_loss import add_depth_gradient
from octasplat.engine.train.optimization.edge_loss import edge_gradient
from octasplat.engine.train.optimization.losses import BatchLoss, batch_loss, ray_errors
from octasplat.engine.train.sampling.batches import Batch
from octasplat.engine.train.sampling.visibility_rays import free_space_gradient

MSE_SMOOTHING = 0.98
"""Weight of the past in the smoothed squared error."""


@dataclass(frozen=True)
class TrainComponents:
    """Tracer, shading model and densification strategy of a training."""

    tracer: Tracer
    shading: ShadingModel
    densifier: Densifier


@dataclass(frozen=True)
class LossGradients:
    """A loss on one batch with its gradients.

    Attributes:
        loss: the loss on the shaded colors.
        gaussians: gradients by the Gaussians' parameters.
        shading: gradients by the shading model's own parameters.
        hits_per_ray: mean number of Gaussians on a ray.
    """

    loss: BatchLoss
    gaussians: GaussianGradients
    shading: Mapping[str, np.ndarray]
    hits_per_ray: float


def loss_and_gradients(
    batch: Batch,
    tracer: Tracer,
    shading: ShadingModel,
    weights: LossWeights,
    *,
    training_progress: float,
    with_errors: bool = False,
    min_blend_weight: float = 0.0,
) -> LossGradients:
    """Return the loss of the Gaussians that ``tracer`` holds, and its gradients; changes nothing.

    Args:
        batch: rays and what the photographs show there.
        tracer: built around the Gaussians.
        shading: makes photographs of what is traced.
        weights: of the loss terms.
        training_progress: share of the training that is done.
        with_errors: share the rays' errors out to their Gaussians.
        min_blend_weight: Gaussians whose weights over all rays add up to less get no gradients.
    """
    result = tracer.trace(batch.rays, record=True)
    assert result.recording is not None
    traced = TracedRays(
        batch.rays, result, tracer, batch.view, training_progress, ray_patches=batch.ray_patches
    )
    shaded = shading.shade(traced)
    render = shaded.composite_over(batch.background_srgb)
    loss = batch_loss(render, batch, weights)
    # render = rgb + T background, so that dL/dT = <dL/drender, background>
    grad = ShadedRayGradients(loss.gradient, loss.gradient @ batch.background_srgb)
    grad_shading = shading.backward(traced, shaded, grad)
    grad_trace = grad_shading.trace
    if batch.known_distances is not None and weights.depth:
        grad_trace = add_depth_gradient(grad_trace, result, batch.known_distances, weights.depth)
    if with_errors:
        grad_trace = replace(grad_trace, ray_errors=ray_errors(render, batch.target_srgb, batch.weight))
    recorded = [(result.recording, grad_trace), *grad_shading.recorded_traces]
    if batch.visibility_rays is not None:
        recorded.append(
            free_space_gradient(
                batch.visibility_rays, tracer, weights.free_space, min_hidden=weights.free_space_from or 0.0
            )
        )
    if batch.edge_batch is not None:
        recorded.append(
            edge_gradient(batch.edge_batch, tracer, shading, weights, training_progress=training_progress)
        )
    # What several recordings say has to be added up first.
    min_trace_weight = min_blend_weight if len(recorded) == 1 else 0.0
    gradients = [
        tracer.backward(hits, by, min_blend_weight=min_trace_weight).numpy() for hits, by in recorded
    ]
    return LossGradients(
        loss=loss,
        gaussians=drop_low_weight(add_gradients(gradients), min_blend_weight),
        shading=grad_shading.parameters,
        hits_per_ray=float(result.hit_counts.mean()),
    )


def train_step(
    state: TrainState,
    batch: Batch,
    components: TrainComponents,
    *,
    loss: LossWeights,
    lr: LearningRates,
    min_blend_weight: float,
    training_progress: float,
    extent: float,
) -> LossGradients:
    """Take one step of the optimisers; changes ``state`` and tells the tracer of it.

    Args:
        state: Gaussians and their optimiser.
        batch: what to look at.
        components: the tracer, built around the state's Gaussians, and what else takes part.
        loss: weights of the terms of the loss.
        lr: step sizes.
        min_blend_weight: Gaussians whose weights over all rays add up to less keep still.
        training_progress: 0 at the first iteration, 1 at the last.
        extent: scene extent, world units.

    Returns:
        What was found before the step.

    Raises:
        TrainingError: the loss is no number.
    """
    tracer, shading = components.tracer, components.shading
    densifier = components.densifier
    step_gradients = loss_and_gradients(
        batch, tracer, shading, loss,
        training_progress=training_progress, with_errors=densifier.wants_errors,
        min_blend_weight=min_blend_weight,
    )  # fmt: skip
    if not np.isfinite(step_gradients.loss.value):
        raise TrainingError(
            f"The loss became {step_gradients.loss.value} at iteration {state.iteration + 1}; lower the "
            "learning rates (--set lr.mean=...) or look for damaged photographs. The last checkpoint is kept."
        )
    gradients = step_gradients.gaussians
    moved = state.adam.step(
        state.gaussians, gradients, lr, loss, training_progress=training_progress, extent=extent
    )
    # also writes the materials that the tracer holds as features
    shading.step(ShadingStep(state.gaussians, gradients, step_gradients.shading, training_progress))
    tracer.refresh(gradients.ids)
    densifier.observe(len(state.gaussians), gradients, moved)
    state.iteration += 1
    # a plain mean at first, as there is no past to smooth with
    keep = min(MSE_SMOOTHING, 1 - 1 / state.iteration)
    state.running_mse = keep * state.running_mse + (1 - keep) * step_gradients.loss.squared_error
    return step_gradients

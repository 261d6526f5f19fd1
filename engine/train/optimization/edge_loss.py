"""The term of the loss for edges in trainings with materials, by its gradients alone.

A ray with materials and what it reflects takes several times as long as one that shows harmonics. So a
training with materials sees each pixel a few times only, and when it ends, thin parts and outlines are not
yet where they belong. Harmonics tell a thing from what is behind it as well. So further rays show harmonics,
and where they pass an edge the difference from the photographs moves the Gaussians. Elsewhere it does not:
harmonics explain reflections by Gaussians behind the surface.
"""

import numpy as np
from jaxtyping import Bool, Float32

from octasplat.engine.shading.plain import PLAIN_SHADING
from octasplat.engine.shading.protocol import ShadedRayGradients, ShadingModel, TracedRays
from octasplat.engine.trace.protocol import Recording, TraceGradients, Tracer, TraceResult
from octasplat.engine.train.config import LossWeights
from octasplat.engine.train.optimization.losses import pixel_loss
from octasplat.engine.train.sampling.batches import Batch
from octasplat.engine.train.shading_factory import find_exposures

MIN_DEPTH_DIFFERENCE = 0.01
"""Between mean and median depth, of the latter, from which on a ray passes an edge."""
MIN_TRANSMITTANCE = 0.02
"""From which on a ray that meets a thing passes its edge, however faint what it meets is."""


def passes_edge(result: TraceResult) -> Bool[np.ndarray, " r"]:
    """Return which rays pass an edge: of a thing before nothing, or of one surface before another.

    Faint haze before nothing counts as well: the median depth is 0 where more than half is let through.
    """
    difference = np.abs(result.expected_depth - result.depth_median)
    is_partly_met = (result.transmittance > MIN_TRANSMITTANCE) & (result.expected_depth > 0)
    return np.asarray(is_partly_met | (difference > MIN_DEPTH_DIFFERENCE * result.depth_median))


def edge_gradient(
    batch: Batch, tracer: Tracer, shading: ShadingModel, weights: LossWeights, *, training_progress: float
) -> tuple[Recording, TraceGradients]:
    """Return the recording of rays that show harmonics, and gradients of their loss where they pass an edge.

    The loss is ``weights.edges`` times that of :func:`pixel_loss` over the whole batch, of which rays that
    pass no edge leave out their part. Harmonics are exposed as the views are, where that is learnt.
    """
    result = tracer.trace(batch.rays, record=True)
    assert result.recording is not None
    traced = TracedRays(batch.rays, result, tracer, batch.view, training_progress)
    exposures = find_exposures(shading)
    plain: ShadingModel = PLAIN_SHADING if exposures is None else exposures.over(PLAIN_SHADING)
    shaded = plain.shade(traced)
    render = shaded.composite_over(batch.background_srgb)
    loss = pixel_loss(render, batch.target_srgb, batch.weight, l1=weights.l1, l2=weights.l2)
    chosen = np.float32(weights.edges or 0.0) * passes_edge(result).astype(np.float32)
    by_color: Float32[np.ndarray, "r 3"] = loss.gradient * chosen[:, None]
    gradients = ShadedRayGradients(by_color, by_color @ batch.background_srgb)
    return result.recording, plain.backward(traced, shaded, gradients).trace

"""The plain model: a photograph shows the radiance that the tracer composited, as it is."""

from collections.abc import Mapping

import numpy as np

from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.shading.protocol import (
    ShadedRayGradients,
    ShadedRays,
    ShadingGradients,
    ShadingStep,
    TracedRays,
)
from octasplat.engine.trace.protocol import TraceGradients, Tracer


class PlainShading:
    """Changes nothing and learns nothing; follows :class:`octasplat.engine.shading.protocol.ShadingModel`."""

    name = "plain"

    def features(self, gaussians: FlatGaussians) -> None:
        """Return None: nothing is blended beside the color."""

    def on_rebuild(self, gaussians: FlatGaussians, tracer: Tracer, *, training_progress: float) -> None:
        """Do nothing."""

    def shade(self, traced: TracedRays) -> ShadedRays:
        """Return the colors that were traced."""
        return ShadedRays(traced.result.rgb_srgb, traced.result.transmittance)

    def backward(self, traced: TracedRays, shaded: ShadedRays, grad: ShadedRayGradients) -> ShadingGradients:
        """Return the same gradients."""
        return ShadingGradients(TraceGradients(grad.rgb_srgb, grad.transmittance))

    def step(self, update: ShadingStep) -> None:
        """Do nothing: there are no parameters."""

    def state(self) -> dict[str, np.ndarray]:
        """Return no state."""
        return {}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Do nothing: there is no state."""


PLAIN_SHADING = PlainShading()
"""The one that all can share, since it has no state."""

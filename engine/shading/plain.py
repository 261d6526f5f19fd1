"""The plain model: a photograph shows the radiance that the tracer composited, as it is."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float32

from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.shading.protocol import Developed, Reversed, Sight
from octasplat.engine.trace.protocol import GaussianGradients, TraceGradients, Tracer


class Plain:
    """Changes nothing and learns nothing; follows :class:`octasplat.engine.shading.protocol.ShadingModel`."""

    name = "plain"

    def features(self, gaussians: FlatGaussians) -> None:
        """No features."""

    def settle(self, gaussians: FlatGaussians, tracer: Tracer, *, progress: float) -> None:
        """Nothing to see."""

    def develop(self, sight: Sight) -> Developed:
        """What was seen."""
        return Developed(sight.seen.rgb_srgb, sight.seen.transmittance)

    def reverse(
        self,
        sight: Sight,
        developed: Developed,
        by_rgb: Float32[np.ndarray, "r 3"],
        by_transmittance: Float32[np.ndarray, " r"],
    ) -> Reversed:
        """The same gradients."""
        return Reversed(TraceGradients(rgb_srgb=by_rgb, transmittance=by_transmittance))

    def step(
        self,
        gaussians: FlatGaussians,
        gradients: GaussianGradients,
        parameters: Mapping[str, np.ndarray],
        *,
        progress: float,
    ) -> None:
        """Nothing to do."""

    def state(self) -> dict[str, np.ndarray]:
        """Nothing to keep."""
        return {}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Nothing to take back."""


PLAIN = Plain()
"""The one that all can share, since it has no state."""

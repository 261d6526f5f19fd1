"""The Gaussians of a stage as the path tracer sees them: layers on rays, and what they keep off."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from engine.rays import RayBatch
from engine.trace.protocol import Tracer, TraceResult


@dataclass(frozen=True)
class GaussianLayers:
    """Gaussians, with features that say how they take light.

    Attributes:
        tracer: all Gaussians, with the features of :mod:`engine.light.kernels_layer`.
        spent_below: transmittance at which a ray counts as ended.
        on_meshes: those that cast shadows on meshes; None where none do.
        on_gaussians: those that cast shadows on Gaussians.
        not_on_gaussians: those that do not; the light that they keep off is in the colours already.
        shadow_bias: Gaussians nearer than this to a lit layer keep nothing off it, world units.
    """

    tracer: Tracer
    spent_below: float
    on_meshes: Tracer | None = None
    on_gaussians: Tracer | None = None
    not_on_gaussians: Tracer | None = None
    shadow_bias: float = 0.0

    def trace(self, rays: RayBatch, t_max: Float32[np.ndarray, " r"]) -> TraceResult:
        """What lies on rays up to a distance each."""
        return self.tracer.trace(RayBatch(rays.origins_world, rays.directions_world, rays.t_min, t_max))

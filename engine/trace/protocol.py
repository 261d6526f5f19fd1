"""What a tracer is: settings, what it returns, and the small protocol that every tracer follows."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, Int32, Int64
from pydantic import BaseModel, ConfigDict, Field

from engine.gaussians.model import FlatGaussians
from engine.gaussians.octagon import CHI2_2_99


class TraceSettings(BaseModel):
    """How rays are cut off. All distances are along unit ray directions, in world units.

    Attributes:
        q: squared radius of an opaque octagon in standard deviations; Q of paper Eq. 6.
        transmittance_min: a ray ends behind the Gaussian that takes its transmittance below this (eps1).
        second_phase_min: None for that single threshold. Otherwise Algorithm 1's eps2: behind eps1 a second
            transmittance starts at 1 and the ray goes on until it falls below this, so that the Gaussians
            just behind the visible ones still receive a gradient.
        t_min: nearest distance at which a Gaussian is seen.
        max_hits: most Gaussians on a ray.
        alpha_max: alpha is clamped to this, with zero gradient above it, so that 1/(1 - alpha) stays finite.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    q: float = Field(CHI2_2_99, gt=0, le=30)
    transmittance_min: float = Field(1e-3, gt=0, lt=1)
    second_phase_min: float | None = Field(None, gt=0, lt=1)
    t_min: float = Field(0.0, ge=0)
    max_hits: int = Field(512, ge=1, le=4096)
    alpha_max: float = Field(0.999, gt=0, le=0.9999)


@dataclass
class TraceResult:
    """Radiance and geometry along ``r`` rays, with no background added.

    Attributes:
        rgb_srgb: sum of weight times colour; display values.
        transmittance: what is left behind the last Gaussian; accumulated alpha is one minus this.
        depth_sum: sum of weight times distance; the expected depth is this over the accumulated alpha.
        depth_median: distance of the Gaussian at which the transmittance falls to one half, 0 where it
            never does.
        normal_world: sum of weight times the normal turned towards the viewer.
        features: sum of weight times the Gaussians' extra channels.
        hit_counts: Gaussians on each ray.
        hits: what :meth:`Tracer.backward` needs; None unless the trace was asked to record.
    """

    rgb_srgb: Float32[np.ndarray, "r 3"]
    transmittance: Float32[np.ndarray, " r"]
    depth_sum: Float32[np.ndarray, " r"]
    depth_median: Float32[np.ndarray, " r"]
    normal_world: Float32[np.ndarray, "r 3"]
    features: Float32[np.ndarray, "r f"]
    hit_counts: Int32[np.ndarray, " r"]
    hits: "HitLists | None" = None

    @property
    def alpha(self) -> Float32[np.ndarray, " r"]:
        """Accumulated alpha in [0, 1]."""
        return np.float32(1.0) - self.transmittance

    @property
    def expected_depth(self) -> Float32[np.ndarray, " r"]:
        """Weighted mean distance, 0 where the ray met nothing."""
        alpha = self.alpha
        return np.divide(self.depth_sum, alpha, out=np.zeros_like(alpha), where=alpha > 1e-8)


@dataclass
class HitLists:
    """The Gaussians of each ray, front to back: hits ``starts[r]`` to ``starts[r] + counts[r]``.

    The arrays are scratch memory of the tracer: the next recording trace overwrites them.
    """

    origins_world: Float32[np.ndarray, "r 3"]
    directions_world: Float32[np.ndarray, "r 3"]
    starts: Int64[np.ndarray, " r"]
    counts: Int32[np.ndarray, " r"]
    ids: Int32[np.ndarray, " h"]
    alphas: Float32[np.ndarray, " h"]
    distances: Float32[np.ndarray, " h"]
    rgb_srgb: Float32[np.ndarray, "h 3"]

    def of_ray(self, ray: int) -> Int32[np.ndarray, " k"]:
        """Ids of the Gaussians of one ray, front to back."""
        return self.ids[self.starts[ray] : self.starts[ray] + self.counts[ray]]


@dataclass
class TraceGradients:
    """Gradients of a loss with respect to the outputs of a trace; None means zero.

    ``ray_errors`` is no gradient: any non-negative number a ray, shared out to its Gaussians by weight.
    """

    rgb_srgb: Float32[np.ndarray, "r 3"]
    transmittance: Float32[np.ndarray, " r"] | None = None
    depth_sum: Float32[np.ndarray, " r"] | None = None
    depth_median: Float32[np.ndarray, " r"] | None = None
    normal_world: Float32[np.ndarray, "r 3"] | None = None
    features: Float32[np.ndarray, "r f"] | None = None
    ray_errors: Float32[np.ndarray, " r"] | None = None

    @property
    def with_geometry(self) -> bool:
        """Whether depth or normals have a gradient."""
        return any(x is not None for x in (self.depth_sum, self.depth_median, self.normal_world))


@dataclass
class GaussianGradients:
    """Gradients of the raw parameters of the ``u`` Gaussians that were hit, in ascending order of id.

    ``weight_sums`` is the sum of the weights alpha T over all rays, ``error_sums`` that of the weights times
    the rays' errors, ``hit_counts`` the number of rays.
    """

    ids: Int32[np.ndarray, " u"]
    means_world: Float32[np.ndarray, "u 3"]
    quats_wxyz: Float32[np.ndarray, "u 4"]
    log_scales: Float32[np.ndarray, "u 2"]
    opacity_logits: Float32[np.ndarray, " u"]
    sh: Float32[np.ndarray, "u k 3"]
    features: Float32[np.ndarray, "u f"]
    weight_sums: Float32[np.ndarray, " u"]
    error_sums: Float32[np.ndarray, " u"]
    hit_counts: Int32[np.ndarray, " u"]


@runtime_checkable
class Tracer(Protocol):
    """Traces rays through a set of flat Gaussians and differentiates what they see."""

    def build(self, gaussians: FlatGaussians, features: Float32[np.ndarray, "n f"] | None = None) -> None:
        """Take over ``gaussians`` and build the acceleration structure around them."""
        ...

    def refresh(self, ids: Int32[np.ndarray, " u"] | None = None) -> None:
        """Read the changed parameters of the Gaussians ``ids`` (None: all) without rebuilding.

        Hits are evaluated from the new parameters; a Gaussian that has left the box it was built with is
        seen only inside that box until the next :meth:`build`.
        """
        ...

    def trace(
        self,
        origins_world: Float32[np.ndarray, "r 3"],
        directions_world: Float32[np.ndarray, "r 3"],
        *,
        record: bool = False,
    ) -> TraceResult:
        """Follow rays with unit directions; ``record`` keeps what :meth:`backward` needs."""
        ...

    def backward(self, hits: HitLists, gradients: TraceGradients) -> GaussianGradients:
        """Gradients of the parameters for the rays of the last recording trace."""
        ...

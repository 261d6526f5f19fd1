"""The tracer protocol: settings, results, gradients, and the methods that every tracer has."""

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, Int32
from pydantic import Field

from octasplat.engine.core.rays import RayBatch
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.octagon import CHI2_2_99
from octasplat.engine.settings import renamed_settings
from octasplat.engine.settings.base import FormerSetting, Settings
from octasplat.engine.settings.fields import ADVANCED, EXPERIMENTAL, Unit

RECORDED_RAYS_PER_BATCH = 1 << 15
"""Rays at once where their hits are kept: each has room for all that it could meet."""


class TraceSettings(Settings):
    """Choice of the tracer and its limits; where a ray begins is a property of the ray."""

    former_names: ClassVar[renamed_settings.FormerNames] = renamed_settings.TRACE

    tracer: Annotated[Literal["cpu", "reference"], EXPERIMENTAL] = Field(
        "cpu",
        description="Tracer: cpu, or reference, a slow one in plain Python for a few hundred rays and "
        "Gaussians.",
    )
    q: Annotated[float, Unit("squared standard deviations"), ADVANCED] = Field(
        CHI2_2_99,
        gt=0,
        le=30,
        description="Squared radius of an opaque octagon in standard deviations; Q of RaySplats, Eq. 6. "
        "Larger ones fall off farther and are hit by more rays.",
    )
    transmittance_min: Annotated[float, Unit("transmittance"), ADVANCED] = Field(
        1e-3,
        gt=0,
        lt=1,
        description="A ray ends behind the Gaussian that takes its transmittance below this (eps1). Larger "
        "ones are faster and leave a little of what lies behind out.",
    )
    second_phase_min: Annotated[float | None, Unit("transmittance"), ADVANCED] = Field(
        None,
        gt=0,
        lt=1,
        description="None for that single threshold. Otherwise Algorithm 1's eps2: behind eps1 a second "
        "transmittance starts at 1 and the ray goes on until it falls below this, so that the "
        "Gaussians just behind the visible ones still receive a gradient.",
    )
    max_hits: Annotated[int, Unit("Gaussians per ray"), ADVANCED] = Field(
        512,
        ge=1,
        le=4096,
        description="Most Gaussians on a ray; it ends there. Raise it for very transparent scenes.",
    )
    alpha_max: Annotated[float, Unit("opacity"), ADVANCED] = Field(
        0.999,
        gt=0,
        le=0.9999,
        description="Alpha is clamped to this, with zero gradient above it, so that 1/(1 - alpha) stays "
        "finite.",
    )
    flip_normal_cos: Annotated[float, Unit("cosine"), ADVANCED] = Field(
        0.0,
        ge=0,
        le=1,
        description="A normal that points away from the viewer is turned towards it if its cosine to the "
        "direction from the ray's origin to the mean is larger than this: 0 turns all, which "
        "suits normals without a side. Where they point outwards, those just behind an outline "
        "had better stay: turned, they would cancel the ones just before it.",
    )
    sort: Annotated[Literal["ray", "packet"], ADVANCED] = Field(
        "ray",
        description="Order in which Gaussians are composited: that of each ray, or one for all rays of a "
        "packet, which is faster and a little wrong. A training decides it by shared_sort_until.",
    )

    former_settings: ClassVar = {"t_min": FormerSetting(0)}


@dataclass
class TraceResult:
    """Radiance and geometry along ``r`` rays, with no background added.

    Attributes:
        rgb_srgb: sum of weight times color; display values.
        transmittance: what is left behind the last Gaussian; accumulated alpha is one minus this.
        depth_sum: sum of weight times distance; the expected depth is this over the accumulated alpha.
        depth_median: distance of the Gaussian at which the transmittance falls to one half, 0 where it
            never does.
        normal_world: sum of weight times the normal, turned towards the viewer as the settings say.
        features: sum of weight times the Gaussians' extra channels.
        hit_counts: Gaussians on each ray.
        recording: the recording, which :meth:`Tracer.backward` needs; None unless the trace was asked for it.
    """

    rgb_srgb: Float32[np.ndarray, "r 3"]
    transmittance: Float32[np.ndarray, " r"]
    depth_sum: Float32[np.ndarray, " r"]
    depth_median: Float32[np.ndarray, " r"]
    normal_world: Float32[np.ndarray, "r 3"]
    features: Float32[np.ndarray, "r f"]
    hit_counts: Int32[np.ndarray, " r"]
    recording: "Recording | None" = None

    def __getitem__(self, part: slice) -> "TraceResult":
        """Return the result of consecutive rays, without a recording."""
        return TraceResult(
            rgb_srgb=self.rgb_srgb[part],
            transmittance=self.transmittance[part],
            depth_sum=self.depth_sum[part],
            depth_median=self.depth_median[part],
            normal_world=self.normal_world[part],
            features=self.features[part],
            hit_counts=self.hit_counts[part],
        )

    @property
    def alpha(self) -> Float32[np.ndarray, " r"]:
        """Return the accumulated alpha in [0, 1]."""
        return np.float32(1.0) - self.transmittance

    @property
    def expected_depth(self) -> Float32[np.ndarray, " r"]:
        """Return the weighted mean distance, 0 where the ray hit nothing."""
        alpha = self.alpha
        return np.divide(self.depth_sum, alpha, out=np.zeros_like(alpha), where=alpha > 1e-8)


@runtime_checkable
class Recording(Protocol):
    """The Gaussians that each ray hit, front to back, as its tracer stores them.

    A recording owns its memory: any number may live at once, and each may be differentiated in any order, as
    long as the parameters are those it was made with.
    """

    def ids_of_ray(self, ray: int) -> Int32[np.ndarray, " k"]:
        """Return the ids of one ray's Gaussians, front to back."""
        ...

    def ids_by_ray(self) -> tuple[Int32[np.ndarray, " r"], Int32[np.ndarray, " h"]]:
        """Return the hit count of each ray, and the ids of all hits, ray by ray and front to back."""
        ...

    def alphas_by_ray(self) -> Float32[np.ndarray, " h"] | None:
        """Return the opacities at all hits, in the order of the ids; None where they are not kept."""
        ...


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
    def has_geometry(self) -> bool:
        """Return whether depth or normals have a gradient."""
        return any(x is not None for x in (self.depth_sum, self.depth_median, self.normal_world))


@dataclass
class GaussianGradients:
    """Gradients of the raw parameters of the ``u`` Gaussians that were hit, in ascending order of id.

    Those that weighed less than was asked for are left out.

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

    def numpy(self) -> "GaussianGradients":
        """Return this object, as :class:`GradientsHandle` requires."""
        return self


@runtime_checkable
class GradientsHandle(Protocol):
    """Gradients of the parameters, in whatever memory their tracer stores them."""

    def numpy(self) -> GaussianGradients:
        """Return the gradients as numpy arrays; a copy if they are stored elsewhere."""
        ...


@runtime_checkable
class Tracer(Protocol):
    """Tracer of rays through flat Gaussians that also differentiates its outputs.

    Rays and outputs are numpy arrays: an iteration has about a megabyte of them, and losses and shading work
    on them here. Data of the size of the Gaussians or of their hits is opaque: recordings are only passed
    back, and gradients are read through :meth:`GradientsHandle.numpy`. So a tracer may store the parameters
    on a device: it uploads them in :meth:`build` and the changed rows in :meth:`refresh`, and its gradients
    stay there, for an optimiser on the same device or until they are read. (Not chosen: a learner with trace,
    step and download, which would duplicate optimiser, densification and checkpoints in every tracer.)

    A tracer is used by one thread at a time.
    """

    settings: TraceSettings

    def build(self, gaussians: FlatGaussians, features: Float32[np.ndarray, "n f"] | None = None) -> None:
        """Build the acceleration structure; ``gaussians`` and ``features`` are kept by reference.

        Earlier recordings can no longer be differentiated.
        """
        ...

    def refresh(self, ids: Int32[np.ndarray, " u"] | None = None) -> None:
        """Read the changed parameters and features of the Gaussians ``ids`` (None: all) without rebuilding.

        What is seen afterwards is what would be after :meth:`build`, however far Gaussians have moved; only
        the time that it takes may grow.
        """
        ...

    def trace(self, rays: RayBatch, *, record: bool = False) -> TraceResult:
        """Trace rays of unit directions; ``record`` stores what :meth:`backward` needs.

        A Gaussian is seen where ``t_min < t < t_max``, in its color as the ray's viewer has it
        (``t_view_origin`` of :class:`octasplat.engine.core.rays.RayBatch`).
        """
        ...

    def transmittance(self, rays: RayBatch) -> Float32[np.ndarray, " r"]:
        """Return the transmittance along each ray between its limits, for shadows: no order, no color.

        It is 0 where less than ``transmittance_min`` is left, whatever ``max_hits`` and the second phase say.
        """
        ...

    def backward(
        self, recording: Recording, gradients: TraceGradients, *, min_blend_weight: float = 0.0
    ) -> GradientsHandle:
        """Return gradients of the parameters for a recording of this tracer since its last build.

        Gaussians whose blending weights alpha T over these rays sum to less than ``min_blend_weight`` are
        left out.

        Raises:
            ValueError: the recording is another tracer's, or older than the last build.
        """
        ...

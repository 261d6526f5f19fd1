"""The protocol of shading models: they turn what was traced along rays into the colors of a photograph.

    batch of rays -> trace -> shade -> loss -> backward of the shading -> backward of the trace -> steps

The training loop and the renderer know models by this protocol alone. A model may look at all that a trace
gives (colors, transmittance, depths, normals, blended features), may trace further rays through the same
Gaussians, and may have parameters of its own: of the views, or of the scene as a whole.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, Float64, Int64

from octasplat.engine.core.rays import RayBatch
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.shading.ray_patches import RayPatches
from octasplat.engine.trace.protocol import GaussianGradients, Recording, TraceGradients, Tracer, TraceResult

LINEAR = "linear"
"""The layer of a shading model that holds radiance."""


@dataclass(frozen=True)
class TracedRays:
    """Rays and what was traced along them, to be shaded.

    Attributes:
        rays: the rays.
        result: what was traced along them.
        tracer: for further rays, mirrored ones say, through the same Gaussians.
        view: number of each ray's training view; None for views that were not trained on.
        training_progress: share of the training that is done; 1 for a finished scene.
        dither: two numbers in [0, 1) for each ray, for models that draw anything at random; they are evenly
            spread over the rays of a pixel. None: models find some by themselves.
        ray_patches: those of the rays that form patches of neighbours; None if none do.
    """

    rays: RayBatch
    result: TraceResult
    tracer: Tracer
    view: Int64[np.ndarray, " r"] | None = None
    training_progress: float = 1.0
    dither: Float64[np.ndarray, "2 r"] | None = None
    ray_patches: RayPatches | None = None

    @property
    def is_recorded(self) -> bool:
        """Return whether a backward pass may follow: what was traced is recorded."""
        return self.result.recording is not None

    def split(self, most: int) -> Iterator["TracedRays"]:
        """Yield at most so many of the rays at a time, in order; they must not be recorded."""
        assert not self.is_recorded
        for start in range(0, len(self.rays), most):
            part = slice(start, start + most)
            yield replace(
                self,
                rays=self.rays[part],
                result=self.result[part],
                view=None if self.view is None else self.view[part],
                dither=None if self.dither is None else self.dither[:, part],
                ray_patches=None,
            )


@dataclass(frozen=True)
class ShadedRays:
    """Colors as a photograph shows them, in front of no background yet.

    Attributes:
        rgb_srgb: display color, premultiplied by 1 - ``transmittance``.
        transmittance: share of the background that shines through; 0 where a model brings its own.
        ctx: whatever the model needs to :meth:`ShadingModel.backward` this.
        layers: what else can be looked at, by name, a row a ray, 0 where there is nothing; only for views
            that were not trained on.
    """

    rgb_srgb: Float32[np.ndarray, "r 3"]
    transmittance: Float32[np.ndarray, " r"]
    ctx: object = None
    layers: Mapping[str, Float32[np.ndarray, "r _"]] = field(default_factory=dict)

    def composite_over(self, background_srgb: Float32[np.ndarray, "3"]) -> Float32[np.ndarray, "r 3"]:
        """Return display colors in front of a background."""
        if not background_srgb.any():
            return self.rgb_srgb.copy()
        return self.rgb_srgb + self.transmittance[:, None] * background_srgb


def concatenate_shaded(parts: Iterable[ShadedRays]) -> ShadedRays:
    """Return shaded rays one after the other, for no backward pass; all parts have the same layers."""
    kept = list(parts)
    return ShadedRays(
        np.concatenate([part.rgb_srgb for part in kept]),
        np.concatenate([part.transmittance for part in kept]),
        layers={name: np.concatenate([part.layers[name] for part in kept]) for name in kept[0].layers},
    )


class ShadedRayGradients(NamedTuple):
    """Gradients of a loss with respect to what :meth:`ShadingModel.shade` returned."""

    rgb_srgb: Float32[np.ndarray, "r 3"]
    transmittance: Float32[np.ndarray, " r"]


@dataclass(frozen=True)
class ShadingGradients:
    """Gradients of a loss with respect to all that went into :meth:`ShadingModel.shade`.

    Attributes:
        trace: of the outputs of the trace that was shaded.
        recorded_traces: of those of the traces that the model recorded itself.
        parameters: of the model's own parameters, in whatever form its ``step`` wants them; names begin
            with the model's.
    """

    trace: TraceGradients
    recorded_traces: tuple[tuple[Recording, TraceGradients], ...] = ()
    parameters: Mapping[str, np.ndarray] = field(default_factory=dict)


@dataclass(frozen=True)
class ShadingStep:
    """Gaussians, gradients and progress that one step of the optimiser goes by.

    Attributes:
        gaussians: those traced, after their own step.
        gradients: of the Gaussians' parameters and features, those of all traces added up.
        parameters: gradients that :meth:`ShadingModel.backward` found for the model's own parameters.
        training_progress: 0 at the first iteration, 1 at the last.
    """

    gaussians: FlatGaussians
    gradients: GaussianGradients
    parameters: Mapping[str, np.ndarray]
    training_progress: float


@runtime_checkable
class ShadingModel(Protocol):
    """Shade what was traced; trained beside the Gaussians.

    Attributes:
        name: begins the names of the model's arrays in checkpoints.
    """

    name: str

    def features(self, gaussians: FlatGaussians) -> Float32[np.ndarray, "n f"] | None:
        """Return what to blend of each Gaussian beside its color, e.g. its material; None: nothing.

        The array stays the same one until the next call: :meth:`step` may change its values.
        """
        ...

    def on_rebuild(self, gaussians: FlatGaussians, tracer: Tracer, *, training_progress: float) -> None:
        """Prepare for a scene of which ``tracer`` has just built the hierarchy.

        Channels of the Gaussians, and the features, may be changed: to what follows from their geometry,
        ``training_progress`` and :meth:`state` alone, and no further by a second call with the same
        ``training_progress``, so that a training that goes on finds the same.
        """
        ...

    def shade(self, traced: TracedRays) -> ShadedRays:
        """Return what photographs show of ``traced``; depends on nothing else but the model's parameters."""
        ...

    def backward(self, traced: TracedRays, shaded: ShadedRays, grad: ShadedRayGradients) -> ShadingGradients:
        """Return the gradients of what went into ``shaded`` from those of its outputs; changes nothing."""
        ...

    def step(self, update: ShadingStep) -> None:
        """Take one step of the optimiser for the model's own parameters."""
        ...

    def state(self) -> dict[str, np.ndarray]:
        """Return parameters and optimiser state, for a checkpoint; names begin with the model's and a dot."""
        ...

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Take back what :meth:`state` gave."""
        ...

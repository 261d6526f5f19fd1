"""The reference implementation behind the tracer protocol, for small scenes."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int32
from torch import Tensor

from octasplat.engine.core.rays import RayBatch
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.trace.gradient_sums import drop_low_weight
from octasplat.engine.trace.protocol import (
    GaussianGradients,
    Recording,
    TraceGradients,
    TraceResult,
    TraceSettings,
)
from octasplat.engine.trace.reference import ReferenceParameters, ReferenceResult, trace_reference

PAIRS_PER_BATCH = 1 << 17
"""Rays times Gaussians of one piece; each pair takes about a kilobyte while its gradient is kept."""
_OUTPUTS = ("rgb_srgb", "transmittance", "depth_sum", "depth_median", "normal_world", "features")
_PARAMETERS = ("means_world", "quats_wxyz", "log_scales", "opacity_logits", "sh", "features")


@dataclass(frozen=True)
class ReferenceRecording:
    """Rays and their hits; :meth:`ReferenceTracer.backward` traces the rays again."""

    rays: RayBatch
    ids: list[np.ndarray]
    build_id: object

    def ids_of_ray(self, ray: int) -> Int32[np.ndarray, " k"]:
        """Return the ids of one ray's Gaussians, front to back."""
        return self.ids[ray].astype(np.int32)

    def ids_by_ray(self) -> tuple[Int32[np.ndarray, " r"], Int32[np.ndarray, " h"]]:
        """Return the hit count of each ray, and the ids of all hits, ray by ray and front to back."""
        counts = np.array([len(ids) for ids in self.ids], np.int32)
        return counts, np.concatenate([np.empty(0, np.int32), *self.ids]).astype(np.int32)

    def alphas_by_ray(self) -> None:
        """Return None: opacities are not kept."""


class ReferenceTracer:
    """The reference implementation behind the tracer protocol.

    See :func:`octasplat.engine.trace.reference.trace_reference` and
    :class:`octasplat.engine.trace.protocol.Tracer`.

    Args:
        settings: where rays are cut off.
    """

    def __init__(self, settings: TraceSettings | None = None) -> None:
        self.settings = settings or TraceSettings(tracer="reference")
        self._gaussians: FlatGaussians | None = None
        self._features = np.empty((0, 0), np.float32)
        self._build_id = object()

    def build(self, gaussians: FlatGaussians, features: Float32[np.ndarray, "n f"] | None = None) -> None:
        """Set ``gaussians``; there is no structure to build."""
        self._features = np.empty((len(gaussians), 0), np.float32) if features is None else features
        self._gaussians = gaussians
        self._build_id = object()

    def refresh(self, ids: Int32[np.ndarray, " u"] | None = None) -> None:
        """Do nothing: parameters are read at each trace."""

    def trace(self, rays: RayBatch, *, record: bool = False) -> TraceResult:
        """Trace rays; see the protocol."""
        parameters = self._reference_parameters()
        with torch.no_grad():
            parts = [
                trace_reference(parameters, rays[piece], self.settings) for piece in self._ray_slices(rays)
            ]
        hit_ids = [ids for part in parts for ids in part.hit_ids]
        shapes = {"rgb_srgb": (3,), "normal_world": (3,), "features": (self._features.shape[1] + 1,)}
        found = {
            name: np.concatenate(
                [np.empty((0, *shapes.get(name, ()))), *(getattr(part, name).numpy() for part in parts)]
            ).astype(np.float32)
            for name in _OUTPUTS
        }
        found["features"] = np.ascontiguousarray(found["features"][:, :-1])
        counts = np.array([len(ids) for ids in hit_ids], np.int32)
        hits = ReferenceRecording(rays, hit_ids, self._build_id) if record else None
        return TraceResult(**found, hit_counts=counts, recording=hits)

    def transmittance(self, rays: RayBatch) -> Float32[np.ndarray, " r"]:
        """Return the transmittance along each ray; see the protocol."""
        parameters = self._reference_parameters()
        # all hits count here; the threshold is applied to the result
        unlimited = self.settings.model_copy(
            update={"transmittance_min": 0.0, "second_phase_min": None, "max_hits": 2**31}
        )
        found = np.empty(len(rays), np.float32)
        with torch.no_grad():
            for piece in self._ray_slices(rays):
                found[piece] = trace_reference(parameters, rays[piece], unlimited).transmittance.numpy()
        found[found < self.settings.transmittance_min] = 0.0
        return found

    def backward(
        self, recording: Recording, gradients: TraceGradients, *, min_blend_weight: float = 0.0
    ) -> GaussianGradients:
        """Return gradients of the raw parameters by autograd; see the protocol."""
        if not isinstance(recording, ReferenceRecording) or recording.build_id is not self._build_id:
            raise ValueError("the recording is not of this tracer, or older than its last build")
        parameters = self._reference_parameters()
        leaves = [getattr(parameters, name) for name in _PARAMETERS]
        sums = [np.zeros(leaf.shape) for leaf in leaves]
        weights, errors = np.zeros(len(parameters.means_world)), np.zeros(len(parameters.means_world))
        for piece in self._ray_slices(recording.rays):
            result = trace_reference(parameters, recording.rays[piece], self.settings)
            for total, found in zip(
                sums, _leaf_gradients(_objective_of_gradients(result, gradients, piece), leaves), strict=True
            ):
                total += found
            visibility = result.features[:, -1]
            # dL by the channel of ones is the weight of each Gaussian
            weights += _leaf_gradients(visibility.sum(), leaves)[-1][:, -1]
            if gradients.ray_errors is not None:
                shared = (visibility * torch.tensor(gradients.ray_errors[piece], dtype=torch.float64)).sum()
                errors += _leaf_gradients(shared, leaves)[-1][:, -1]
        ids, counts = np.unique(np.concatenate([np.empty(0, np.int64), *recording.ids]), return_counts=True)
        rows = {name: total[ids].astype(np.float32) for name, total in zip(_PARAMETERS, sums, strict=True)}
        rows["features"] = np.ascontiguousarray(rows["features"][:, :-1])
        everything = GaussianGradients(
            ids=ids.astype(np.int32),
            **rows,
            weight_sums=weights[ids].astype(np.float32),
            error_sums=errors[ids].astype(np.float32),
            hit_counts=counts.astype(np.int32),
        )
        return drop_low_weight(everything, min_blend_weight)

    def _reference_parameters(self) -> ReferenceParameters:
        assert self._gaussians is not None, "build first"
        # One channel more than asked for, whose sum along a ray is the sum of the weights.
        ones = np.ones((len(self._gaussians), 1), np.float32)
        return ReferenceParameters.from_gaussians(
            self._gaussians, np.concatenate([self._features, ones], axis=1, dtype=np.float32)
        )

    def _ray_slices(self, rays: RayBatch) -> list[slice]:
        size = max(1, PAIRS_PER_BATCH // max(1, len(self._features)))
        return [slice(start, min(start + size, len(rays))) for start in range(0, len(rays), size)]


def _objective_of_gradients(result: ReferenceResult, gradients: TraceGradients, batch: slice) -> Tensor:
    """Return the scalar whose gradients by the outputs are ``gradients``."""
    loss = torch.zeros((), dtype=torch.float64)
    for name in _OUTPUTS:
        given = getattr(gradients, name)
        if given is not None:
            output = getattr(result, name)
            output = output[:, :-1] if name == "features" else output
            loss = loss + (output * torch.tensor(given[batch], dtype=torch.float64)).sum()
    return loss


def _leaf_gradients(loss: Tensor, leaves: list[Tensor]) -> list[Float64[np.ndarray, "..."]]:
    """Return gradients of ``loss``, zero where it does not depend on a leaf."""
    if not loss.requires_grad:
        return [np.zeros(leaf.shape) for leaf in leaves]
    found = torch.autograd.grad(loss, leaves, retain_graph=True, allow_unused=True)
    return [np.zeros(leaf.shape) if g is None else g.numpy() for g, leaf in zip(found, leaves, strict=True)]

"""Tracer of Gaussians among others that stay as they are."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int32

from octasplat.engine.core.rays import RayBatch
from octasplat.engine.gaussians.channels import Channels
from octasplat.engine.gaussians.flattening import row_slices
from octasplat.engine.gaussians.merge import with_sh_degree
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.rows import allocate_rows, select_rows
from octasplat.engine.trace.protocol import GaussianGradients, Recording, TraceGradients, Tracer, TraceResult


class PartlyFixedTracer:
    """Trace Gaussians and fixed ones around them as one scene; only the former get gradients.

    Follows :class:`octasplat.engine.trace.protocol.Tracer`. The fixed ones come after the others, have no
    extra channels, and show the degree of harmonics that the others have.

    Args:
        tracer: traces all of them.
        fixed_gaussians: the fixed Gaussians.
        folder: for files that hold all Gaussians together; None for memory.
    """

    def __init__(self, tracer: Tracer, fixed_gaussians: FlatGaussians, folder: Path | None = None) -> None:
        self._tracer = tracer
        self._folder = folder
        self._fixed_gaussians = replace(fixed_gaussians, channels=Channels())
        self.settings = tracer.settings
        self._gaussians: FlatGaussians | None = None
        self._features: Float32[np.ndarray, "n f"] | None = None
        self._all: FlatGaussians | None = None
        self._all_features: Float32[np.ndarray, "m f"] | None = None

    def build(self, gaussians: FlatGaussians, features: Float32[np.ndarray, "n f"] | None = None) -> None:
        """Build the hierarchy of the Gaussians and those around them."""
        self._gaussians, self._features = gaussians, features
        self._all = self._with_fixed(gaussians)
        self._all_features = None
        if features is not None:
            empty = np.zeros((len(self._fixed_gaussians), features.shape[1]), np.float32)
            self._all_features = np.concatenate([features, empty])
        self._tracer.build(self._all, self._all_features)

    def _with_fixed(self, gaussians: FlatGaussians) -> FlatGaussians:
        """Return the Gaussians with the fixed ones after them, in the arrays of before where these fit."""
        own = replace(gaussians, channels=Channels())
        count = len(own)
        total, found = count + len(self._fixed_gaussians), self._all
        if found is None or len(found) != total or found.sh_degree != own.sh_degree:
            found = allocate_rows(own, total, self._folder)
            for rows in row_slices(total - count):
                some = with_sh_degree(self._fixed_gaussians.view(rows), own.sh_degree)
                found.put(slice(count + rows.start, count + rows.stop), some)
        found.put(slice(0, count), own)
        return found

    def refresh(self, ids: Int32[np.ndarray, " u"] | None = None) -> None:
        """Read the changed parameters of the Gaussians ``ids`` (None: all)."""
        assert self._gaussians is not None and self._all is not None, "nothing has been built"
        rows = np.arange(len(self._gaussians), dtype=np.int32) if ids is None else ids
        self._all.put(rows, replace(self._gaussians, channels=Channels()).select(rows))
        if self._features is not None and self._all_features is not None:
            self._all_features[rows] = self._features[rows]
        self._tracer.refresh(rows)

    def trace(self, rays: RayBatch, *, record: bool = False) -> TraceResult:
        """Trace rays through all Gaussians."""
        return self._tracer.trace(rays, record=record)

    def transmittance(self, rays: RayBatch) -> Float32[np.ndarray, " r"]:
        """Return the transmittance along each ray, all Gaussians considered."""
        return self._tracer.transmittance(rays)

    def backward(
        self, recording: Recording, gradients: TraceGradients, *, min_blend_weight: float = 0.0
    ) -> GaussianGradients:
        """Return the gradients of the Gaussians that are not fixed."""
        assert self._gaussians is not None, "nothing has been built"
        found = self._tracer.backward(recording, gradients, min_blend_weight=min_blend_weight).numpy()
        own_count = int(np.searchsorted(found.ids, len(self._gaussians)))
        return select_rows(found, slice(own_count))

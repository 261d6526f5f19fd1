"""Base of shading models that change what another model shades, such as its exposure or its background."""

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
from jaxtyping import Float32

from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.shading.protocol import ShadingModel, ShadingStep
from octasplat.engine.trace.protocol import Tracer


class WrapperModel:
    """Pass on what concerns an inner model alone, and keep the state of both.

    Subclasses define ``shade`` and ``backward``, and extend ``step``; then they follow
    :class:`octasplat.engine.shading.protocol.ShadingModel`.

    Args:
        inner: the model whose result is changed.

    Attributes:
        name: begins the names of the model's arrays in checkpoints.
        state_names: attributes that checkpoints keep, arrays.
        inner: the model whose result is changed.
    """

    name: str
    state_names: ClassVar[tuple[str, ...]]

    def __init__(self, inner: ShadingModel) -> None:
        self.inner = inner

    def features(self, gaussians: FlatGaussians) -> Float32[np.ndarray, "n f"] | None:
        """Return the features of the inner model."""
        return self.inner.features(gaussians)

    def on_rebuild(self, gaussians: FlatGaussians, tracer: Tracer, *, training_progress: float) -> None:
        """Prepare the inner model for the scene."""
        self.inner.on_rebuild(gaussians, tracer, training_progress=training_progress)

    def step(self, update: ShadingStep) -> None:
        """Step the inner model."""
        self.inner.step(update)

    def state(self) -> dict[str, np.ndarray]:
        """Return the state of the inner model, and the arrays of this one."""
        own = {f"{self.name}.{name}": getattr(self, name) for name in self.state_names}
        return {**self.inner.state(), **own}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Take the state that :meth:`state` returned."""
        self.inner.restore(state)
        for name in self.state_names:
            setattr(self, name, state[f"{self.name}.{name}"].copy())

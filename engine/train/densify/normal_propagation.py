"""A densification strategy that also hands normals on to neighbours now and then."""

from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, Int64

from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.shading.material_settings import PROPAGATION_EVERY, PROPAGATION_UNTIL
from octasplat.engine.shading.normal_propagation import NEIGHBOURS
from octasplat.engine.trace.protocol import GaussianGradients
from octasplat.engine.train.densify.protocol import Densifier
from octasplat.engine.train.optimization.adam import Adam


@runtime_checkable
class Propagation(Protocol):
    """Changes Gaussians in place by what their neighbours' materials say of their normals."""

    def __call__(
        self, gaussians: FlatGaussians, rng: np.random.Generator, *, training_progress: float
    ) -> None:
        """Propagate once, at this share of the training."""
        ...


class NormalPropagation:
    """Another strategy, followed by a propagation of normals at regular intervals.

    Args:
        inner: the strategy.
        propagate: the propagation.
        iterations: of the whole training.
    """

    def __init__(self, inner: Densifier, propagate: Propagation, *, iterations: int) -> None:
        self.wants_errors = inner.wants_errors
        self._inner = inner
        self._propagate = propagate
        self._every = max(1, round(PROPAGATION_EVERY * iterations))
        self._until = PROPAGATION_UNTIL * iterations
        self._total = iterations
        self._iteration = 0

    def observe(
        self, count: int, gradients: GaussianGradients, mean_steps_world: Float32[np.ndarray, "u 3"]
    ) -> None:
        """Let the inner strategy observe."""
        self._inner.observe(count, gradients, mean_steps_world)

    def is_due(self, iteration: int) -> bool:
        """Return whether the inner strategy is due, or it is time to propagate."""
        self._iteration = iteration
        return self._inner.is_due(iteration) or self._is_due(iteration)

    def apply(
        self, gaussians: FlatGaussians, adam: Adam, rng: np.random.Generator, *, extent: float
    ) -> tuple[FlatGaussians, Adam]:
        """Apply the inner strategy and propagate, each where it is due."""
        iteration = self._iteration
        if self._inner.is_due(iteration):
            gaussians, adam = self._inner.apply(gaussians, adam, rng, extent=extent)
        # a Gaussian needs that many others around it
        if self._is_due(iteration) and len(gaussians) > NEIGHBOURS:
            self._propagate(gaussians, rng, training_progress=iteration / self._total)
        return gaussians, adam

    def reorder(self, order: Int64[np.ndarray, " n"]) -> None:
        """Reorder what the inner strategy has observed."""
        self._inner.reorder(order)

    def state(self) -> dict[str, np.ndarray]:
        """Return the state of the inner strategy."""
        return self._inner.state()

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Take the state that :meth:`state` returned."""
        self._inner.restore(state)

    def _is_due(self, iteration: int) -> bool:
        return iteration <= self._until and iteration % self._every == 0

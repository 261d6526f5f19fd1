"""What a densification strategy is."""

from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, Int64

from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.trace.protocol import GaussianGradients
from octasplat.engine.train.optimization.adam import Adam


@runtime_checkable
class Densifier(Protocol):
    """Watches the training and changes the set of Gaussians at some iterations.

    Attributes:
        wants_errors: whether :meth:`observe` looks at the errors seen through each Gaussian.
    """

    wants_errors: bool

    def observe(
        self, count: int, gradients: GaussianGradients, mean_steps_world: Float32[np.ndarray, "u 3"]
    ) -> None:
        """Take note of one iteration over ``count`` Gaussians."""
        ...

    def is_due(self, iteration: int) -> bool:
        """Return whether :meth:`apply` is to be called after this iteration (counted from 1)."""
        ...

    def apply(
        self, gaussians: FlatGaussians, adam: Adam, rng: np.random.Generator, *, extent: float
    ) -> tuple[FlatGaussians, Adam]:
        """Return the new set and its optimiser state; may change the old ones in place."""
        ...

    def reorder(self, order: Int64[np.ndarray, " n"]) -> None:
        """Take note that the Gaussian at place k is from now on the one that was at ``order[k]``."""
        ...

    def state(self) -> dict[str, np.ndarray]:
        """Return everything that was observed, for a checkpoint."""
        ...

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Take back what :meth:`state` gave."""
        ...

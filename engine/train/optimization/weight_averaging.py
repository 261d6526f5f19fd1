"""The mean of the Gaussians over the last iterations, which is what is exported.

Steps of Adam do not get smaller where gradients are noise, so that parameters wander around the best ones:
their mean lies nearer (Polyak and Juditsky, "Acceleration of Stochastic Approximation by Averaging",
https://doi.org/10.1137/0330046).
"""

from dataclasses import dataclass

import numpy as np

from octasplat.engine.core.compilation import run_ranges
from octasplat.engine.core.threads import threads_in_use
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.rows import row_arrays
from octasplat.engine.train.kernels.averaging import move_towards

AVERAGING_INTERVAL = 10
"""Iterations between two of the states that are averaged."""


@dataclass
class WeightAverage:
    """The mean of some states of the same Gaussians, in order.

    Attributes:
        gaussians: the mean, None where there is no state yet.
        count: states in it.
    """

    gaussians: FlatGaussians | None = None
    count: int = 0

    def add(self, now: FlatGaussians) -> None:
        """Take in one more state; begin anew where there are other parameters than before."""
        if self.gaussians is None or _parameter_shapes(self.gaussians) != _parameter_shapes(now):
            # Rows one after the other, so that flat views of them can be written to.
            self.gaussians, self.count = now.copy(), 1
            return
        self.count += 1
        share = np.float32(1.0 / self.count)  # mean_k = mean_(k-1) + (now - mean_(k-1)) / k
        values = row_arrays(now)
        for name, mean in row_arrays(self.gaussians).items():
            flat, new = mean.reshape(-1), np.ascontiguousarray(values[name]).reshape(-1)
            run_ranges(move_towards, threads_in_use(), len(flat), flat, new, share)

    def clear(self) -> None:
        """Forget all states, as rows now belong to other Gaussians."""
        self.gaussians, self.count = None, 0


def _parameter_shapes(gaussians: FlatGaussians) -> dict[str, tuple[int, ...]]:
    return {name: array.shape for name, array in row_arrays(gaussians).items()}

"""Clone, split and prune by the Adam step of the mean, as the authors of REdiSplats do.

"REdiSplats: Ray Tracing for Editable Gaussian Splatting" (https://arxiv.org/abs/2503.12284).
"""

import numpy as np
from jaxtyping import Float32, Int64

from octasplat.engine.gaussians.model import FlatGaussians, concatenate
from octasplat.engine.trace.protocol import GaussianGradients
from octasplat.engine.train.config import RedisplatsConfig
from octasplat.engine.train.optimization.adam import Adam


class RedisplatsDensifier:
    """Duplicates a Gaussian whose mean makes a long Adam step at the densification iteration.

    A small one is cloned: the copy stays where the mean was before the step. A large one is split in two
    drawn from its own distribution, scales divided by 1.6. Moments are copied to both. Faint, tiny and
    huge ones are removed. Nothing is duplicated once the cap is reached. No opacity reset, and no clamp of
    the opacity after the last densification.
    """

    wants_errors = False

    def __init__(self, config: RedisplatsConfig, *, iterations: int, max_gaussians: int) -> None:
        self._config = config
        self._stop = int(config.stop_fraction * iterations)
        self._cap = max_gaussians
        self._steps: Float32[np.ndarray, "n 3"] = np.zeros((0, 3), np.float32)

    def observe(
        self, count: int, gradients: GaussianGradients, mean_steps_world: Float32[np.ndarray, "u 3"]
    ) -> None:
        """Keep this iteration's steps only."""
        if len(self._steps) != count:
            self._steps = np.empty((count, 3), np.float32)
        self._steps[:] = 0
        self._steps[gradients.ids] = mean_steps_world

    def is_due(self, iteration: int) -> bool:
        """Return whether ``interval`` iterations have passed, between the start and the stop."""
        return self._config.start <= iteration <= self._stop and iteration % self._config.interval == 0

    def apply(
        self, gaussians: FlatGaussians, adam: Adam, rng: np.random.Generator, *, extent: float
    ) -> tuple[FlatGaussians, Adam]:
        """Duplicate, then prune."""
        config = self._config
        lengths = np.linalg.norm(self._steps, axis=1)
        chosen = np.flatnonzero(lengths >= config.step_threshold * extent)
        room = max(0, self._cap - len(gaussians))
        if len(chosen) > room:
            # The longest steps first; ties by index, so that the choice is one for all machines.
            chosen = np.sort(chosen[np.argsort(-lengths[chosen], kind="stable")[:room]])
        size = np.linalg.norm(gaussians.scales, axis=1)
        large = size[chosen] > config.split_scale * extent
        split, clone = chosen[large], chosen[~large]
        clones = gaussians.select(clone)
        clones.means_world -= self._steps[clone]  # back to before the step, while the original keeps it
        halves = gaussians.select(split)
        axes = halves.rotations[:, :, 1:] * halves.scales[:, None, :]
        # both halves are drawn from the Gaussian's own distribution
        for target in (gaussians.means_world, halves.means_world):
            index = split if target is gaussians.means_world else slice(None)
            offset = np.einsum("nij,nj->ni", axes, rng.standard_normal((len(split), 2)))
            target[index] += offset.astype(np.float32)
        shrink = np.float32(np.log(config.split_shrink))
        gaussians.log_scales[split] -= shrink
        halves.log_scales -= shrink
        gaussians = concatenate([gaussians, clones, halves])
        adam = adam.append(adam.select(clone)).append(adam.select(split))
        size = np.linalg.norm(gaussians.scales, axis=1)
        keep = gaussians.opacities >= config.prune_opacity
        keep &= (size >= config.min_scale * extent) & (size <= config.max_scale * extent)
        self._steps = np.zeros((0, 3), np.float32)
        return gaussians.select(np.flatnonzero(keep)), adam.select(np.flatnonzero(keep))

    def reorder(self, order: Int64[np.ndarray, " n"]) -> None:
        """Bring the last steps into the new order."""
        if len(self._steps) == len(order):
            self._steps = self._steps[order]

    def state(self) -> dict[str, np.ndarray]:
        """Return the last steps."""
        return {"steps": self._steps}

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Take the last steps back."""
        self._steps = state["steps"]

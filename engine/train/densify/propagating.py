"""Material-aware normal propagation: what reflects well grows over its neighbours and turns them.

A Gaussian whose normal is right shows right reflections; raised in opacity and grown, it hides neighbours
whose normals are wrong, so that these are trimmed or learn. After "Reflective Gaussian Splatting"
(https://arxiv.org/abs/2412.19282), whose code also throws the colours of all else about by chance; here they
are left alone.
"""

import numpy as np
from jaxtyping import Float32

from engine.gaussians.materials import METALLIC, ROUGHNESS
from engine.gaussians.model import SH_C0, FlatGaussians
from engine.shading.material_settings import MaterialSettings
from engine.trace.protocol import GaussianGradients
from engine.train.densify.protocol import Densifier
from engine.train.optimiser import Adam

METALLIC_FROM = 0.02
SEED_ROUGHNESS, SEED_NOISE = 0.01, 0.4


class Propagating:
    """Another strategy, with propagation now and then.

    Args:
        inner: the strategy.
        settings: when, and how much.
        iterations: of the whole training.
    """

    def __init__(self, inner: Densifier, settings: MaterialSettings, *, iterations: int) -> None:
        self.wants_errors = inner.wants_errors
        self._inner = inner
        self._settings = settings
        self._every = max(1, round(settings.propagation_every * iterations))
        self._until = settings.propagation_until * iterations
        self._total = iterations
        self._iteration = np.zeros(1, np.int64)

    def observe(
        self, count: int, gradients: GaussianGradients, mean_steps_world: Float32[np.ndarray, "u 3"]
    ) -> None:
        """The strategy inside takes note."""
        self._inner.observe(count, gradients, mean_steps_world)

    def due(self, iteration: int) -> bool:
        """When the strategy inside says so, or it is time to propagate."""
        self._iteration[0] = iteration
        return self._inner.due(iteration) or self._spreads(iteration)

    def apply(
        self, gaussians: FlatGaussians, adam: Adam, rng: np.random.Generator, *, extent: float
    ) -> tuple[FlatGaussians, Adam]:
        """Propagate, then do what the strategy inside does."""
        iteration = int(self._iteration[0])
        if self._spreads(iteration):
            self._spread(gaussians, rng, progress=iteration / self._total)
        if self._inner.due(iteration):
            return self._inner.apply(gaussians, adam, rng, extent=extent)
        return gaussians, adam

    def state(self) -> dict[str, np.ndarray]:
        """That of the strategy inside."""
        return self._inner.state()

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Take it back."""
        self._inner.restore(state)

    def _spreads(self, iteration: int) -> bool:
        return iteration <= self._until and iteration % self._every == 0

    def _spread(self, gaussians: FlatGaussians, rng: np.random.Generator, *, progress: float) -> None:
        settings = self._settings
        seed = settings.recipe == "seed"
        least = settings.propagation_opacity
        raised = np.float32(np.log(least / (1 - least)))
        gaussians.opacity_logits[:] = np.maximum(gaussians.opacity_logits, raised)
        metallic = gaussians.channels[METALLIC][:, 0] >= METALLIC_FROM
        smoothest = SEED_ROUGHNESS if seed else settings.propagation_roughness
        smooth = gaussians.channels[ROUGHNESS][:, 0] <= smoothest
        gaussians.log_scales[metallic & smooth] += np.float32(np.log(settings.propagation_growth))
        if settings.is_seed_deferred(progress):
            matt = np.flatnonzero(~metallic)
            noise = rng.uniform(-SEED_NOISE, SEED_NOISE, (len(matt), 3)) / SH_C0
            gaussians.sh[matt, 0] += noise.astype(np.float32)

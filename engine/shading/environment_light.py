"""An environment that is learnt: its radiance by the logarithm, its optimiser, and its levels."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float32, Float64, Int64

from octasplat.engine.shading.adam_map import adam_update, smoothness_gradient
from octasplat.engine.shading.environment_levels import prefilter_for, resample_environment, solid_angles
from octasplat.engine.shading.kernels.environment_levels import EnvironmentLevels
from octasplat.engine.shading.material_settings import ENVIRONMENT_EVERY

INITIAL_RADIANCE = 0.5
_DARKEST, _BRIGHTEST = np.log(1e-4), np.log(1e4)
_STATE = ("log_radiance", "first", "second", "sums", "steps")


class EnvironmentLight:
    """The environment of a scene.

    It takes a step only every few iterations, for the gradients of all of them, since making the levels of
    the new one takes as long as tracing a batch.

    Args:
        height: texels from up to down; there are twice as many around.
        hdr: whether the radiance may be more than 1.
        white_weight: weight of the distance of the colors to grey.
        smoothness_weight: weight of differences between neighbouring texels.

    Attributes:
        log_radiance: logarithm of the linear radiance.
        first: first moments of Adam; ``second`` holds the second ones.
        sums: gradients by the texels of all levels since the last step.
        steps: iterations so far.
    """

    def __init__(
        self, height: int, *, hdr: bool = True, white_weight: float = 0.0, smoothness_weight: float = 0.0
    ) -> None:
        self._brightest = _BRIGHTEST if hdr else 0.0
        self._white_weight, self._smoothness_weight = white_weight, smoothness_weight
        self._prefilter = prefilter_for(height)
        shape = (height, 2 * height, 3)
        self.log_radiance: Float32[np.ndarray, "h w 3"] = np.full(shape, np.log(INITIAL_RADIANCE), np.float32)
        self.first: Float32[np.ndarray, "h w 3"] = np.zeros(shape, np.float32)
        self.second: Float32[np.ndarray, "h w 3"] = np.zeros(shape, np.float32)
        self.sums: Float64[np.ndarray, "t 3"] = np.zeros((int(self._prefilter.offsets[-1]), 3))
        self.steps: Int64[np.ndarray, " 1"] = np.zeros(1, np.int64)
        self._levels: EnvironmentLevels | None = None

    def reset(self) -> None:
        """Forget all that was learnt."""
        self.log_radiance[:] = np.log(INITIAL_RADIANCE)
        for sums in (self.first, self.second, self.sums, self.steps):
            sums[:] = 0
        self._levels = None

    @property
    def radiance_linear(self) -> Float32[np.ndarray, "h w 3"]:
        """Return the radiance of the environment."""
        return np.exp(self.log_radiance)

    def set_radiance(self, radiance_linear: Float32[np.ndarray, "h w 3"]) -> None:
        """Take another environment instead, of any size."""
        radiance = resample_environment(radiance_linear, self._prefilter.height)
        # the logarithm of black is cut off
        self.log_radiance = np.log(np.maximum(radiance, np.exp(_DARKEST))).astype(np.float32)
        self._levels = None

    @property
    def levels(self) -> EnvironmentLevels:
        """Return the prefiltered levels, computed when they are asked for after a change."""
        if self._levels is None:
            self._levels = self._prefilter.levels(self.radiance_linear)
        return self._levels

    def step(self, grad_texels: Float64[np.ndarray, "t 3"], *, rate: float) -> None:
        """Count an iteration, and take a step if it is time."""
        self.sums += grad_texels
        self.steps += 1
        if self.steps[0] % ENVIRONMENT_EVERY:
            return
        # d radiance / d log radiance = radiance
        gradient = self._prefilter.backward(self.sums) * self.radiance_linear + self._prior_gradients()
        self.sums[:] = 0
        count = self.steps[0] // ENVIRONMENT_EVERY
        self.first, self.second, change = adam_update(self.first, self.second, gradient, int(count))
        radiance = np.clip(self.log_radiance - rate * change, _DARKEST, self._brightest)
        self.log_radiance = radiance.astype(np.float32)
        self._levels = None

    def _prior_gradients(self) -> Float64[np.ndarray, "h w 3"]:
        """Return gradients of the priors: light is nearly white, and nearly as bright as that beside it."""
        x = self.log_radiance.astype(np.float64)
        angles = solid_angles(len(x))[:, None, None] / (4 * np.pi)
        white = x - x.mean(axis=2, keepdims=True)
        return angles * (self._white_weight * white + self._smoothness_weight * smoothness_gradient(x))

    def state(self) -> dict[str, np.ndarray]:
        """Return radiance, moments and sums."""
        return {name: getattr(self, name) for name in _STATE}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Take the state that :meth:`state` returned."""
        for name in _STATE:
            setattr(self, name, state[name].copy())
        self._levels = None

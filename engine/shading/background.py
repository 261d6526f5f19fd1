"""What is infinitely far away: a map of colors in all directions, learnt behind the Gaussians.

The sky has no depth: Gaussians that are to show it stand somewhere in the air, and every photograph that was
not trained on sees them from the side. Here what shines through them all is a map's color instead. As
everywhere these are display values, mixed as such.
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float32, Float64, Int64

from octasplat.engine.core.compilation import run_ranges
from octasplat.engine.core.threads import threads_in_use
from octasplat.engine.shading.adam_map import adam_update, smoothness_gradient
from octasplat.engine.shading.environment_frame import environment_frame
from octasplat.engine.shading.environment_levels import solid_angles
from octasplat.engine.shading.kernels.environment_map import add_to_texels, map_colors
from octasplat.engine.shading.plain import PLAIN_SHADING
from octasplat.engine.shading.protocol import (
    ShadedRayGradients,
    ShadedRays,
    ShadingGradients,
    ShadingModel,
    ShadingStep,
    TracedRays,
)
from octasplat.engine.shading.wrapper import WrapperModel

UP_WORLD = (0.0, -1.0, 0.0)
"""Up in maps, about right for most worlds that COLMAP makes; it only says how the picture of a map lies."""
STEP_INTERVAL = 8
"""Iterations between two steps, each for the gradients of all of them: a map has more texels than rays."""


class LearnedBackground(WrapperModel):
    """Composite the colors of another model over a learnt map.

    Follows :class:`octasplat.engine.shading.protocol.ShadingModel`.

    Args:
        height: texels from up to down; there are twice as many around.
        rate: size of a step at the beginning, display values.
        decay: what is left of that at the end; it falls exponentially.
        smoothness_weight: of differences between neighbouring texels.
        inner: the model that shades the Gaussians.

    Attributes:
        rgb_srgb: the map, display values; rows from up to down, the middle column is forward.
        first: first moments of Adam; ``second`` holds the second ones.
        sums: gradients by the texels since the last step.
        steps: iterations so far.
        frame: right, up and forward of the map in the world, as rows.
        inner: the model that shades the Gaussians.
    """

    name = "background"
    state_names = ("rgb_srgb", "first", "second", "sums", "steps")

    def __init__(
        self,
        height: int,
        *,
        rate: float = 0.0,
        decay: float = 1.0,
        smoothness_weight: float = 0.0,
        inner: ShadingModel = PLAIN_SHADING,
    ) -> None:
        shape = (height, 2 * height, 3)
        self.rgb_srgb: Float32[np.ndarray, "h w 3"] = np.full(shape, 0.5, np.float32)
        self.first: Float32[np.ndarray, "h w 3"] = np.zeros(shape, np.float32)
        self.second: Float32[np.ndarray, "h w 3"] = np.zeros(shape, np.float32)
        self.sums: Float64[np.ndarray, "h w 3"] = np.zeros(shape)
        self.steps: Int64[np.ndarray, " 1"] = np.zeros(1, np.int64)
        self.frame: Float64[np.ndarray, "3 3"] = environment_frame(np.array(UP_WORLD))
        self._rate = rate
        self._decay = decay
        self._smoothness_weight = smoothness_weight
        super().__init__(inner)

    def set_map(self, rgb_srgb: Float32[np.ndarray, "h w 3"]) -> None:
        """Take another map instead, of any size; what the optimizer knows is kept if the size is the same."""
        if rgb_srgb.shape != self.rgb_srgb.shape:
            self.first, self.second = np.zeros((2, *rgb_srgb.shape), np.float32)
            self.sums = np.zeros(rgb_srgb.shape)
        self.rgb_srgb = np.clip(rgb_srgb, 0, 1).astype(np.float32)

    def lookup(self, directions_world: Float32[np.ndarray, "r 3"]) -> Float32[np.ndarray, "r 3"]:
        """Return display colors of unit directions, bilinear between texels."""
        height = len(self.rgb_srgb)
        colors = np.empty((len(directions_world), 3), np.float32)
        run_ranges(
            map_colors, threads_in_use(), len(colors),
            self.rgb_srgb.reshape(-1, 3), height, self.frame, directions_world, colors,
        )  # fmt: skip
        return colors

    def shade(self, traced: TracedRays) -> ShadedRays:
        """Return the inner model's colors over those of the map; nothing stays transparent."""
        inner = self.inner.shade(traced)
        background_srgb = self.lookup(traced.rays.directions_world)
        rgb = inner.rgb_srgb + inner.transmittance[:, None] * background_srgb
        return ShadedRays(rgb, np.zeros_like(inner.transmittance), (inner, background_srgb), inner.layers)

    def backward(self, traced: TracedRays, shaded: ShadedRays, grad: ShadedRayGradients) -> ShadingGradients:
        """Return gradients by what the inner model shaded and by the map's colors along the rays."""
        assert isinstance(shaded.ctx, tuple)
        inner, background_srgb = shaded.ctx
        # rgb = inner + T background
        grad_transmittance = (grad.rgb_srgb * background_srgb).sum(axis=1, dtype=np.float32)
        inner_grad = ShadedRayGradients(grad.rgb_srgb, grad_transmittance)
        below = self.inner.backward(traced, inner, inner_grad)
        map_gradients = {
            "background.directions": traced.rays.directions_world,
            "background.grad_colors": inner.transmittance[:, None] * grad.rgb_srgb,
        }
        return ShadingGradients(below.trace, below.recorded_traces, {**below.parameters, **map_gradients})

    def accumulate(self, parameters: Mapping[str, np.ndarray]) -> None:
        """Add what :meth:`backward` found to the sums over the texels."""
        add_to_texels(
            self.rgb_srgb.reshape(-1, 3),
            len(self.sums),
            self.frame,
            parameters["background.directions"],
            parameters["background.grad_colors"],
            self.sums.reshape(-1, 3),
        )

    def step(self, update: ShadingStep) -> None:
        """Count an iteration, and take a step of Adam if it is time; colors stay what a screen can show."""
        super().step(update)
        self.accumulate(update.parameters)
        self.steps += 1
        if self.steps[0] % STEP_INTERVAL:
            return
        # texels shrink towards the poles; so does their share of the prior
        shares = solid_angles(len(self.sums))[:, None, None] / (4 * np.pi)
        gradient = self.sums / STEP_INTERVAL + self._smoothness_weight * shares * smoothness_gradient(
            self.rgb_srgb
        )
        self.sums[:] = 0
        count = int(self.steps[0]) // STEP_INTERVAL
        self.first, self.second, change = adam_update(self.first, self.second, gradient, count)
        rate = self._rate * self._decay**update.training_progress
        self.rgb_srgb = np.clip(self.rgb_srgb - rate * change, 0, 1).astype(np.float32)

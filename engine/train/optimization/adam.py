"""The optimiser: Adam whose state and work follow the Gaussians that are hit.

After "Adam: A Method for Stochastic Optimization" (https://arxiv.org/abs/1412.6980).
"""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from jaxtyping import Float32, Float64, Int32

from octasplat.engine.core.compilation import run_ranges
from octasplat.engine.core.threads import threads_in_use
from octasplat.engine.gaussians.model import SH_C0, FlatGaussians
from octasplat.engine.gaussians.rows import concatenate_rows, row_arrays, select_rows
from octasplat.engine.trace.protocol import GaussianGradients
from octasplat.engine.train.config import LearningRates, LossWeights
from octasplat.engine.train.kernels.adam import (
    CHUNK,
    GEOMETRY,
    AdamMoments,
    AdamStep,
    BiasCorrection,
    ParameterArrays,
    ParameterGradients,
    Regularization,
    StepRates,
    adam_shares,
    adam_step,
)
from octasplat.engine.train.kernels.adam_lanes import LANES

BETA1, BETA2, EPSILON = 0.9, 0.999, 1e-15


@dataclass
class Adam:
    """First and second moments of every parameter, one row a Gaussian, and each Gaussian's step count.

    Columns: mean 3, quaternion 4, log scales 2, opacity 1, then the harmonics. Where ``lr.axes`` is "own"
    the first are along the normal and the two axes in the Gaussian's plane, and the last three of the
    quaternion's are turns around these: where a Gaussian is in its plane photographs say at once, how deep
    it lies they say by parallax, and each direction has steps of a size of its own. A Gaussian that no ray of
    the batch hits is left alone: neither its moments nor its parameters change. Named channels have columns
    of their own; those are trained for which there is a rate, and only where they are what was traced.
    """

    first: Float32[np.ndarray, "n p"]
    second: Float32[np.ndarray, "n p"]
    channel_first: Float32[np.ndarray, "n c"]
    channel_second: Float32[np.ndarray, "n c"]
    steps: Int32[np.ndarray, " n"]

    @classmethod
    def zeros(cls, gaussians: FlatGaussians) -> "Adam":
        """Return zero moments for ``gaussians``."""
        count, columns = len(gaussians), GEOMETRY + 3 * gaussians.sh.shape[1]
        named = sum(gaussians.channels.widths.values())
        return cls(
            np.zeros((count, columns), np.float32),
            np.zeros((count, columns), np.float32),
            np.zeros((count, named), np.float32),
            np.zeros((count, named), np.float32),
            np.zeros(count, np.int32),
        )

    def select(self, index: np.ndarray) -> "Adam":
        """Return the state of the Gaussians at ``index``, copied."""
        return select_rows(self, index)

    def reset(self, index: np.ndarray) -> None:
        """Forget the past of the Gaussians at ``index``."""
        for array in row_arrays(self).values():
            array[index] = 0

    def append(self, other: "Adam") -> "Adam":
        """Return this state followed by ``other``."""
        return concatenate_rows([self, other])

    def with_sh_basis(self, basis_count: int) -> "Adam":
        """Return a state for ``basis_count`` harmonics; the new ones start with zero moments."""
        extra = GEOMETRY + 3 * basis_count - self.first.shape[1]
        pad = ((0, 0), (0, extra))
        return replace(self, first=np.pad(self.first, pad), second=np.pad(self.second, pad))

    def step(
        self,
        gaussians: FlatGaussians,
        gradients: GaussianGradients,
        rates: LearningRates,
        loss: LossWeights,
        *,
        training_progress: float,
        extent: float,
    ) -> Float32[np.ndarray, "u 3"]:
        """Take one step of Adam for the Gaussians that were hit; changes ``gaussians`` in place.

        Args:
            gaussians: parameters.
            gradients: of the Gaussians that were hit; their features' are those of the channels side by side
                where the channels are trained.
            rates: learning rates.
            loss: weights of the regularisers on those Gaussians.
            training_progress: 0 at the first iteration, 1 at the last.
            extent: scene extent, world units.

        Returns:
            Each hit Gaussian's step of the mean, world units.
        """
        mean_steps = np.empty((len(gradients.ids), 3), np.float32)
        corrections = np.empty((len(gradients.ids), 2))
        hit_count = max(1, len(gradients.ids))
        decay = rates.decay**training_progress
        color_rate = rates.color / SH_C0 * decay
        mean_unit = extent if rates.mean_unit == "extent" else 1.0
        vectors = -(-3 * gaussians.sh.shape[1] // LANES)
        rates_sh = np.full(vectors * LANES, color_rate * rates.sh_rest_ratio, np.float32)
        rates_sh[:3] = color_rate
        # a power of two, so that the cached table is rarely made anew
        powers = _beta_powers(1 << (int(self.steps.max(initial=0)) + 1).bit_length())
        run_ranges(
            adam_step,
            threads_in_use(),
            -(-len(gradients.ids) // CHUNK),
            AdamStep(
                gradients.ids,
                BiasCorrection(self.steps, powers, corrections),
                AdamMoments(self.first, self.second, BETA1, BETA2, EPSILON),
                ParameterArrays(
                    gaussians.means_world,
                    gaussians.quats_wxyz,
                    gaussians.log_scales,
                    gaussians.opacity_logits,
                    gaussians.sh,
                ),
                ParameterGradients(
                    gradients.means_world,
                    gradients.quats_wxyz,
                    gradients.log_scales,
                    gradients.opacity_logits,
                    gradients.sh,
                ),
                # means fall from mean to mean_final in equal ratios
                StepRates(
                    mean=mean_unit * rates.mean * (rates.mean_final / rates.mean) ** training_progress,
                    mean_by_size=rates.mean_unit == "size",
                    own_axes=rates.axes == "own",
                    quat=rates.quat * decay,
                    log_scale=rates.log_scale * decay,
                    opacity=rates.opacity * decay,
                    sh=rates_sh,
                ),
                Regularization(
                    loss.opacity / hit_count,
                    loss.scale / (2 * hit_count * extent),
                    float(np.log(1e-6 * extent)),  # scales between a millionth and ten times the extent
                    float(np.log(10.0 * extent)),
                ),
                mean_steps,
            ),
            grain=1,
        )
        self._step_channels(gaussians, gradients, rates, decay, corrections)
        return mean_steps

    def _step_channels(
        self,
        gaussians: FlatGaussians,
        gradients: GaussianGradients,
        rates: LearningRates,
        decay: float,
        corrections: Float64[np.ndarray, "u 2"],
    ) -> None:
        column = 0
        if gradients.features.shape[1] < self.channel_first.shape[1]:
            return  # the shading model traces something else
        for name, values in gaussians.channels.items():
            rate, width = rates.channel_rate(name), values.shape[1]
            if rate > 0:
                run_ranges(
                    adam_shares, threads_in_use(), len(gradients.ids),
                    gradients.ids, corrections,
                    AdamMoments(self.channel_first, self.channel_second, BETA1, BETA2, EPSILON),
                    column, values, gradients.features[:, column : column + width], rate * decay,
                )  # fmt: skip
            column += width


@cache
def _beta_powers(count: int) -> Float64[np.ndarray, "2 s"]:
    """Return powers 0 to ``count`` - 1 of both betas."""
    return np.array([[beta**k for k in range(count)] for beta in (BETA1, BETA2)])

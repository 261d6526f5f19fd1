"""Relocation and growth up to a cap, for flat Gaussians.

After "3D Gaussian Splatting as Markov Chain Monte Carlo" (https://arxiv.org/abs/2404.09591).
"""

from math import comb

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from octasplat.engine.dataset.region import Region
from octasplat.engine.gaussians.model import FlatGaussians, concatenate
from octasplat.engine.trace.protocol import GaussianGradients
from octasplat.engine.train.config import McmcConfig
from octasplat.engine.train.kernels.row_sums import add_to_rows
from octasplat.engine.train.optimization.adam import Adam

MAX_COPIES = 32


def split_opacity(
    opacity: Float64[np.ndarray, " n"], copies: Int64[np.ndarray, " n"]
) -> Float64[np.ndarray, " n"]:
    """Return the opacity of each of ``copies`` Gaussians as opaque together as one was: 1-(1-a)^(1/N)."""
    return 1.0 - (1.0 - opacity) ** (1.0 / copies)


def split_scale_factor(
    opacity: Float64[np.ndarray, " n"], copies: Int64[np.ndarray, " n"]
) -> Float64[np.ndarray, " n"]:
    """Return the factor on the scales of ``copies`` coincident Gaussians that keeps their integral.

    a / sum_{i=1..N} sum_{k=0..i-1} C(i-1,k) (-1)^k a'^(k+1) / sqrt(k+1), a' = 1-(1-a)^(1/N)
    (the paper's Eq. 9).
    """
    shared = split_opacity(opacity, copies)
    factor = np.ones_like(opacity)
    for n in np.unique(copies):
        is_n = copies == n
        total = np.zeros(int(is_n.sum()))
        for i in range(1, int(n) + 1):
            for k in range(i):
                total += comb(i - 1, k) * (-1.0) ** k * shared[is_n] ** (k + 1) / np.sqrt(k + 1)
        factor[is_n] = opacity[is_n] / total
    return factor


class McmcDensifier:
    """Moves dead Gaussians to, and adds new ones at, places chosen by opacity and by the error seen there.

    A chosen Gaussian and its copies share its opacity and shrink, or keep its opacity and share its area;
    copies are scattered inside it. The count grows by a fixed fraction each time and never passes the cap.
    Once it is there, those that hardly weigh on any ray are moved with the dead
    (``relocate_low_weight_below``), in rounds, to where the error is seen, and share the area there: smaller
    ones are what is missing.

    Where there is a region, places in it are chosen before others that score the same.

    Not done: the paper's noise on the means; the copies are scattered instead.
    """

    def __init__(
        self, config: McmcConfig, *, iterations: int, max_gaussians: int, region: Region | None = None
    ) -> None:
        self._config = config
        self._region = region
        self.wants_errors = config.error_power > 0 or config.relocate_low_weight_below > 0
        self._stop = int(config.stop_fraction * iterations)
        self._cap = max_gaussians
        self._round = config.interval * max(
            1, round(iterations / config.relocate_low_weight_rounds / config.interval)
        )
        self._errors: Float32[np.ndarray, " n"]
        self._weights: Float32[np.ndarray, " n"]
        self._reset_sums(0)

    def observe(
        self, count: int, gradients: GaussianGradients, mean_steps_world: Float32[np.ndarray, "u 3"]
    ) -> None:
        """Add up the error that is seen through each Gaussian and its weight, where that matters."""
        if not self.wants_errors:
            return
        if len(self._errors) != count:
            self._reset_sums(count)  # other Gaussians than before: nothing is known of these
        add_to_rows(gradients.ids, gradients.error_sums, self._errors)
        add_to_rows(gradients.ids, gradients.weight_sums, self._weights)

    def is_due(self, iteration: int) -> bool:
        """Return whether an interval has passed between start and stop; in rounds at the cap."""
        every = self._round if self._relocates_low_weight(len(self._errors)) else self._config.interval
        return self._config.start <= iteration <= self._stop and iteration % every == 0

    def apply(
        self, gaussians: FlatGaussians, adam: Adam, rng: np.random.Generator, *, extent: float
    ) -> tuple[FlatGaussians, Adam]:
        """Relocate the dead, then grow; at the cap, relocate the dead and those of low weight instead."""
        config, count = self._config, len(gaussians)
        opacities = gaussians.opacities.astype(np.float64)
        alive = opacities > config.dead_opacity
        preference = 1.0 if self._region is None else self._region.preference(gaussians.means_world)
        errors, weights = self._errors, self._weights
        self._reset_sums(count)
        if not alive.any():
            return gaussians, adam
        if self._relocates_low_weight(count) and len(weights) == count and errors.any():
            return self._relocate(gaussians, adam, alive, errors * preference, weights, rng)
        score = np.where(alive, opacities * preference, 0.0)
        if config.error_power > 0 and len(errors) == count and errors.any():
            score = np.where(alive, errors.astype(np.float64) ** config.error_power * preference, 0.0)
        dead = np.flatnonzero(~alive)
        born = max(0, min(self._cap - count, round(config.growth * count)))
        wanted = len(dead) + born
        if wanted == 0 or score.sum() <= 0:
            return gaussians, adam
        # with replacement: several copies may go to one place
        chosen = rng.choice(count, size=wanted, p=score / score.sum())
        sources, made = self._make_copies(gaussians, chosen, config.copies == "area", rng)
        adam.reset(sources)
        gaussians.put(dead, made.view(slice(len(dead))))
        adam.reset(dead)
        if born == 0:
            return gaussians, adam
        new = made.select(np.arange(len(dead), wanted))  # the first of those made take the rows of the dead
        self._reset_sums(count + born)
        return concatenate([gaussians, new]), adam.append(Adam.zeros(new))

    def _relocate(
        self, gaussians: FlatGaussians, adam: Adam, alive: Bool[np.ndarray, " n"],
        errors: Float32[np.ndarray, " n"], weights: Float32[np.ndarray, " n"], rng: np.random.Generator,
    ) -> tuple[FlatGaussians, Adam]:  # fmt: skip
        """Put the dead and the idle each beside another one, chosen by the error seen through it.

        Drawn without putting back: through a veil before half of the pictures most of the error may be seen,
        and a hundred copies of it would be a wall.
        """
        alive[self._low_weight_ids(weights)] = False
        error_ids = np.flatnonzero(alive & (errors > 0))
        free = np.flatnonzero(~alive)[: len(error_ids)]
        if len(free) == 0:
            return gaussians, adam
        # Arrival times at rates of the errors: the first to arrive are drawn without replacement.
        arrivals = rng.exponential(size=len(error_ids)) / errors[error_ids]
        chosen = error_ids[np.sort(np.argpartition(arrivals, len(free) - 1)[: len(free)])]
        sources, made = self._make_copies(gaussians, chosen, True, rng)
        adam.reset(sources)
        gaussians.put(free, made)
        adam.reset(free)
        return gaussians, adam

    def _make_copies(
        self, gaussians: FlatGaussians, chosen: Int64[np.ndarray, " w"], area: bool, rng: np.random.Generator
    ) -> tuple[Int64[np.ndarray, " s"], FlatGaussians]:
        """Return the distinct chosen ones and scattered copies, which share their area or opacity."""
        copies = np.minimum(np.bincount(chosen, minlength=len(gaussians)) + 1, MAX_COPIES)
        sources = np.flatnonzero(copies > 1)
        scales = gaussians.scales[chosen]
        if area:
            # area falls by the number of copies, standard deviations by its root
            shrunk = -0.5 * np.log(copies[sources])
        else:
            # neither logarithm nor division by zero
            a = np.clip(gaussians.opacities[sources].astype(np.float64), 1e-4, 1 - 1e-4)
            # copies are not dead at once
            new_a = np.maximum(split_opacity(a, copies[sources]), self._config.dead_opacity * 1.5)
            gaussians.opacity_logits[sources] = np.log(new_a / (1 - new_a))
            shrunk = np.log(split_scale_factor(a, copies[sources]))
        gaussians.log_scales[sources] += shrunk[:, None].astype(np.float32)
        made = gaussians.select(chosen)
        # within the old ellipse where they share its area, else within the shrunk one
        spread = rng.standard_normal((len(chosen), 2)) * (scales if area else made.scales)
        made.means_world += np.einsum("nij,nj->ni", made.rotations[:, :, 1:], spread).astype(np.float32)
        return sources, made

    def reorder(self, order: Int64[np.ndarray, " n"]) -> None:
        """Bring the sums into the new order."""
        if len(self._errors) == len(order):
            self._errors, self._weights = self._errors[order], self._weights[order]

    def state(self) -> dict[str, np.ndarray]:
        """Return the sums of errors and weights."""
        return {"errors": self._errors, "weights": self._weights}

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Take the sums back."""
        self._errors, self._weights = state["errors"], state["weights"]

    def _reset_sums(self, count: int) -> None:
        """Set the sums of errors and weights to zero, for ``count`` Gaussians."""
        self._errors, self._weights = np.zeros(count, np.float32), np.zeros(count, np.float32)

    def _relocates_low_weight(self, count: int) -> bool:
        """Return whether ``count`` Gaussians are the most allowed, so that those of low weight are moved."""
        return self._config.relocate_low_weight_below > 0 and count >= self._cap

    def _low_weight_ids(self, weights: Float32[np.ndarray, " n"]) -> Int64[np.ndarray, " m"]:
        """Return the Gaussians of least weight."""
        max_count = int(self._config.relocate_low_weight_fraction * len(weights))
        lowest = np.argsort(weights, kind="stable")[:max_count]
        return lowest[weights[lowest] < self._config.relocate_low_weight_below * weights.mean()]

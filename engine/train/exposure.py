"""Exposure of the training views: a gain and an offset for each channel of each, learnt beside the Gaussians.

A phone sets its exposure anew for every photograph. Without a model of that, Gaussians learn to look
different from where each photograph was taken. The scene keeps the exposure that is the mean of all.

Not done: held-out views are measured as they are, nothing is fitted to them.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int64

BETA1, BETA2, EPSILON = 0.9, 0.99, 1e-15


@dataclass
class Exposures:
    """Of each view and channel: shown colour = exp(log_gain) * rendered colour + offset.

    ``first`` and ``second`` are the moments of Adam, gains before offsets, and ``steps`` each view's steps.
    """

    log_gains: Float32[np.ndarray, "v 3"]
    offsets: Float32[np.ndarray, "v 3"]
    first: Float32[np.ndarray, "v 6"]
    second: Float32[np.ndarray, "v 6"]
    steps: Int64[np.ndarray, " v"]

    @classmethod
    def neutral(cls, views: int) -> "Exposures":
        """All views exposed alike."""
        three, six = np.zeros((2, views, 3), np.float32), np.zeros((2, views, 6), np.float32)
        return cls(three[0], three[1], six[0], six[1], np.zeros(views, np.int64))

    def develop(
        self, view: Int64[np.ndarray, " r"], rgb: Float32[np.ndarray, "r 3"], alpha: Float32[np.ndarray, " r"]
    ) -> Float32[np.ndarray, "r 3"]:
        """Colours premultiplied by ``alpha`` as the photographs ``view`` would show them."""
        return np.exp(self.log_gains)[view] * rgb + self.offsets[view] * alpha[:, None]

    def undevelop(
        self, view: Int64[np.ndarray, " r"], gradient: Float32[np.ndarray, "r 3"]
    ) -> tuple[Float32[np.ndarray, "r 3"], Float32[np.ndarray, " r"]]:
        """Gradients by ``rgb`` and by ``alpha`` of :meth:`develop` from that by what it returned."""
        return gradient * np.exp(self.log_gains)[view], (gradient * self.offsets[view]).sum(axis=1)

    def step(
        self,
        view: Int64[np.ndarray, " r"],
        rgb: Float32[np.ndarray, "r 3"],
        alpha: Float32[np.ndarray, " r"],
        gradient: Float32[np.ndarray, "r 3"],
        *,
        rate: float,
    ) -> None:
        """One step of Adam for the views of the batch, then the mean over all views so far is taken out.

        Args:
            view: view of each ray.
            rgb: premultiplied colours that were developed.
            alpha: their accumulated alpha.
            gradient: of the loss by what :meth:`develop` returned.
            rate: size of a step.
        """
        used, place = np.unique(view, return_inverse=True)
        gained = gradient * np.exp(self.log_gains)[view] * rgb
        terms = np.concatenate([gained, gradient * alpha[:, None]], axis=1)
        sums = np.stack([np.bincount(place, terms[:, c], len(used)) for c in range(6)], axis=1)
        self.steps[used] += 1
        steps = self.steps[used, None]
        self.first[used] = BETA1 * self.first[used] + (1 - BETA1) * sums
        self.second[used] = BETA2 * self.second[used] + (1 - BETA2) * sums**2
        mean = self.first[used] / (1 - BETA1**steps)
        size = np.sqrt(self.second[used] / (1 - BETA2**steps)) + EPSILON
        change = (rate * mean / size).astype(np.float32)
        self.log_gains[used] -= change[:, :3]
        self.offsets[used] -= change[:, 3:]
        seen = self.steps > 0
        for values in (self.log_gains, self.offsets):
            values[seen] -= values[seen].mean(axis=0, dtype=np.float64).astype(np.float32)

"""Where Gaussians may be: not too near to a camera, and in some training view."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool

from octasplat.engine.dataset.camera_clearance import CameraClearance
from octasplat.engine.dataset.view_frusta import ViewFrusta
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.train.loop.state import TrainState

PRUNED_LOGIT = np.float32(-12.0)
"""Opacity logit of Gaussians that are hidden until the strategy uses them elsewhere: no ray notices them."""
FINAL_CLEARANCE_SCALE = 1.5
"""Factor on the zones around cameras at the end, since Gaussians gather around those of the training."""


@dataclass(frozen=True, eq=False)
class AllowedRegion:
    """The region in which Gaussians stay, whatever the densification strategy does.

    Attributes:
        camera_clearance: zones around cameras in which none stays; None for no such zones.
        view_frusta: frusta of the views outside of all of which none stays; None for no such limit.
    """

    camera_clearance: CameraClearance | None
    view_frusta: ViewFrusta | None

    def hide_outside(self, state: TrainState) -> bool:
        """Hide the Gaussians outside, so that the strategy takes them for dead; return whether any was.

        ``state`` changes in place: their opacity, their moments, and the count of those near to cameras.
        """
        is_near, is_outside = self._prune_masks(state.gaussians, 1.0)
        # those hidden before are not counted again
        is_outside &= state.gaussians.opacity_logits > PRUNED_LOGIT
        state.pruned_near_cameras += int((is_near & is_outside).sum())
        rows = np.flatnonzero(is_outside)
        state.gaussians.opacity_logits[rows] = PRUNED_LOGIT
        state.adam.reset(rows)
        return len(rows) > 0

    def select_final(self, gaussians: FlatGaussians, state: TrainState) -> FlatGaussians:
        """Return the Gaussians to export of ``gaussians``; counts those near to cameras in ``state``."""
        is_near, is_outside = self._prune_masks(gaussians, FINAL_CLEARANCE_SCALE)
        if not is_outside.any():
            return gaussians
        state.pruned_near_cameras += int((is_near & (gaussians.opacity_logits > PRUNED_LOGIT)).sum())
        return gaussians.select(np.flatnonzero(~is_outside))

    def _prune_masks(
        self, gaussians: FlatGaussians, clearance_scale: float
    ) -> tuple[Bool[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
        """Return which Gaussians are in the scaled zone around a camera, and which are that or in no view."""
        is_near = np.zeros(len(gaussians), np.bool_)
        if self.camera_clearance is not None:
            is_near = self.camera_clearance.scaled(clearance_scale).contains(gaussians.means_world)
        if self.view_frusta is None:
            return is_near, is_near.copy()
        return is_near, is_near | ~self.view_frusta.contains(gaussians.means_world)

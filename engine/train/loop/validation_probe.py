"""Probes: fixed rays on which the state is measured now and then; what they show can end a training."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int64

from octasplat.engine.core.color import composite_over
from octasplat.engine.core.errors import TrainingError
from octasplat.engine.core.events import EventListener, HeldOutMeasured, Warned
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.shading.protocol import ShadingModel, TracedRays
from octasplat.engine.trace.protocol import Tracer
from octasplat.engine.train.loop.checkpoint import BestState, load_best, save_best
from octasplat.engine.train.loop.state import TrainState
from octasplat.engine.train.sampling.pixel_sampler import TrainingData, pixel_sampler
from octasplat.engine.train.shading_factory import find_exposures
from octasplat.engine.train.views.view_grids import estimate_untrained_exposures

MIN_COVERAGE = 0.01
"""A state that covers less than this share of what the photographs cover is broken."""


@dataclass(frozen=True)
class RayProbe:
    """Random pixels of some views, over a background.

    Attributes:
        view: of each pixel.
        y: row.
        x: column.
        rgb_srgb: what the photograph shows there, over the background.
        weight: 0 where a mask rules the pixel out.
        background_srgb: the background.
        alpha: mean coverage of the photographs at the pixels that count.
    """

    view: Int64[np.ndarray, " r"]
    y: Int64[np.ndarray, " r"]
    x: Int64[np.ndarray, " r"]
    rgb_srgb: Float32[np.ndarray, "r 3"]
    weight: Float32[np.ndarray, " r"]
    background_srgb: Float32[np.ndarray, "3"]
    alpha: float


def draw_probe(
    dataset: TrainingData,
    indices: Int64[np.ndarray, " v"],
    count: int,
    background_srgb: Float32[np.ndarray, "3"],
    rng: np.random.Generator,
) -> RayProbe:
    """Draw ``count`` pixels of the views ``indices``."""
    view, y, x = pixel_sampler(dataset, indices).pixels(rng, count)
    rgb, alpha, weight = dataset.pixels(view, y, x)
    # all masked out: nothing to average
    covered = float(np.average(alpha, weights=weight)) if weight.any() else 0.0
    return RayProbe(
        view=view,
        y=y,
        x=x,
        rgb_srgb=composite_over(rgb, alpha, background_srgb),
        weight=weight,
        background_srgb=background_srgb,
        alpha=covered,
    )


def measure_probe(
    probe: RayProbe, dataset: TrainingData, tracer: Tracer, shading: ShadingModel
) -> tuple[float, float]:
    """Return the PSNR of all rays that count together, dB, and the mean accumulated alpha.

    Errors are pooled, as few rays fall on each view: in one of which they show nothing but background there
    is no error, and the mean of the views' dB would be that of the empty ones.

    All are seen as new views are, but exposed as each is known or guessed to be where exposures are learnt.
    """
    rays = dataset.rays(probe.view, probe.y, probe.x)
    result = tracer.trace(rays)
    view = probe.view if find_exposures(shading) is not None else None
    shaded = shading.shade(TracedRays(rays, result, tracer, view))
    render = np.clip(shaded.composite_over(probe.background_srgb), 0, 1)
    error = ((render - probe.rgb_srgb) ** 2).mean(axis=1) * probe.weight
    count = float(probe.weight.sum(dtype=np.float64))
    psnr = psnr_from_mse(float(error.sum(dtype=np.float64)) / count) if count > 0 else 0.0
    return psnr, float(result.alpha.mean())


def psnr_from_mse(mse: float) -> float:
    """Return the PSNR of a mean squared error of display values, dB."""
    return float(-10 * np.log10(max(mse, 1e-10)))


def is_best_exported(last_psnr: float, best_psnr: float, margin_db: float) -> bool:
    """Return whether a training ends with its best state instead of its last one, which is much worse.

    >>> is_best_exported(25.0, 25.2, 0.3), is_best_exported(24.8, 25.2, 0.3)
    (False, True)
    """
    return last_psnr < best_psnr - margin_db


class ValidationProbe:
    """Refuses broken states, keeps the best one, and chooses what is exported.

    Args:
        dataset: the photographs; probes are drawn from it.
        folder: the best state goes here.
        progress: receives the measures of the held-out views.
        rays: number of rays of a probe.
        background_srgb: what is behind the photographs.
        best_checkpoint_margin_db: the best state is chosen where the last one is so much worse.
        seed: of the choice of rays.
    """

    def __init__(
        self,
        dataset: TrainingData,
        folder: Path,
        progress: EventListener,
        *,
        rays: int,
        background_srgb: Float32[np.ndarray, "3"],
        best_margin_db: float,
        seed: int,
    ) -> None:
        # A generator of its own, so that measuring never changes the training.
        rng = np.random.Generator(np.random.PCG64([seed, 1]))
        self._probe = draw_probe(dataset, dataset.train_indices, rays, background_srgb, rng)
        self._held_out = None
        if len(dataset.test_indices):
            self._held_out = draw_probe(dataset, dataset.test_indices, rays, background_srgb, rng)
        self._dataset = dataset
        self._folder = folder
        self._background_srgb = background_srgb
        self._best_margin_db = best_margin_db
        self._progress = progress

    def measure(self, state: TrainState, tracer: Tracer, shading: ShadingModel) -> None:
        """Measure a state, note that in it, keep it if it is the best, and tell of the held-out views.

        Raises:
            TrainingError: parameters are no numbers, or nothing is left to see.
        """
        if not state.gaussians.is_finite():
            raise TrainingError(
                f"Parameters became not-a-number by iteration {state.iteration}; nothing is exported. "
                "The last checkpoint is kept."
            )
        estimate_untrained_exposures(self._dataset, self._background_srgb, tracer, shading)
        psnr, alpha = measure_probe(self._probe, self._dataset, tracer, shading)
        if alpha < MIN_COVERAGE * self._probe.alpha and state.iteration > 0:  # a first state may cover little
            raise TrainingError(
                f"After iteration {state.iteration} the scene covers only {100 * alpha:.2g} % of the "
                f"photographs, of which {100 * self._probe.alpha:.2g} % show something; nothing is exported. "
                "Check that poses and photographs belong together."
            )
        state.probes.append((state.iteration, psnr))
        if psnr > state.best_psnr:
            state.best_psnr, state.best_iteration = psnr, state.iteration
            save_best(BestState(state.gaussians, shading.state(), state.pose_corrections), self._folder)
        if self._held_out is not None:
            held_out, _ = measure_probe(self._held_out, self._dataset, tracer, shading)
            self._progress(HeldOutMeasured(state.iteration, held_out, len(state.gaussians), state.seconds))

    def select_final(self, state: TrainState, tracer: Tracer, shading: ShadingModel) -> FlatGaussians:
        """Return the last Gaussians, or the best if those are much worse.

        The shading and the pose corrections of ``state`` become theirs, too.
        """
        last, _ = measure_probe(self._probe, self._dataset, tracer, shading)
        if not is_best_exported(last, state.best_psnr, self._best_margin_db):
            return state.gaussians
        self._progress(
            Warned(
                f"The last state ({last:.1f} dB) is worse than that of iteration {state.best_iteration} "
                f"({state.best_psnr:.1f} dB); the better one is exported."
            )
        )
        best = load_best(self._folder)
        shading.restore(best.shading)
        state.pose_corrections = best.pose_corrections
        return best.gaussians

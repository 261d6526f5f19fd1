"""The training loop: batch, trace, loss, gradients, step, and now and then densify, rebuild, checkpoint."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, Int64

from engine.errors import Cancelled, TrainingFailure
from engine.events import CheckpointWritten, HeldOutMeasured, Listener, TrainingProgress, Warned
from engine.gaussians.model import FlatGaussians
from engine.gaussians.order import morton_order
from engine.rays import RayBatch
from engine.scene import View
from engine.trace.make import make_tracer
from engine.trace.protocol import TraceGradients, Tracer
from engine.train.batches import Batch, Pixels, PixelSampler, draw_batch
from engine.train.checkpoint import TrainState, load_best, save_best, save_checkpoint
from engine.train.config import (
    TrainConfig,
    iteration_count,
    most_gaussians,
    rebuild_interval,
    window_side_px,
)
from engine.train.densify import make_densifier
from engine.train.exposure import Exposures
from engine.train.losses import pixel_loss, ssim_loss
from engine.train.optimiser import Adam

EVENT_EVERY = 10
RUNNING = 0.98
COLLAPSE_DB = 3.0
"""The best checkpoint is taken instead of the last one when the last probe is this much worse."""
EMPTY_ALPHA = 0.01


@runtime_checkable
class TrainingData(Pixels, Protocol):
    """The photographs: pixel access, the views and the split (see :class:`engine.scene.Dataset`)."""

    views: tuple[View, ...]
    train_indices: Int64[np.ndarray, " t"]
    test_indices: Int64[np.ndarray, " h"]
    has_alpha: bool
    extent: float


@dataclass(frozen=True)
class Probe:
    """Fixed rays on which the state is measured between iterations."""

    rays: RayBatch
    rgb_srgb: Float32[np.ndarray, "r 3"]
    weight: Float32[np.ndarray, " r"]
    view: Int64[np.ndarray, " r"]
    background: Float32[np.ndarray, "3"]


class Trainer:
    """Trains flat Gaussians on a dataset.

    Args:
        dataset: the photographs.
        config: all knobs.
        state: where to begin, fresh or from a checkpoint.
        folder: checkpoints go here.
        fingerprint: what the checkpoints belong to.
        listener: hears the progress.
        threads: for everything; 0 means all cores.
        should_stop: asked after each iteration; True ends the run at the next safe iteration.
        tracer: anything that follows the protocol; by default the one that the settings name.

    Attributes:
        state: where the training stands.
        iterations: how many there will be in all.
    """

    def __init__(
        self,
        dataset: TrainingData,
        config: TrainConfig,
        state: TrainState,
        *,
        folder: Path,
        fingerprint: str,
        listener: Listener,
        threads: int = 0,
        should_stop: Callable[[], bool] = lambda: False,
        tracer: Tracer | None = None,
    ) -> None:
        self.state = state
        self._dataset = dataset
        self._config = config
        self._folder = folder
        self._fingerprint = fingerprint
        self._tell = listener
        self._should_stop = should_stop
        self._extent = dataset.extent
        self._tracer: Tracer = tracer or make_tracer(
            config.trace, threads=threads, box_padding=config.box_padding
        )
        sizes_px = np.array([[view.width_px, view.height_px] for view in dataset.views], np.int64)
        self._sampler = PixelSampler(dataset.train_indices, sizes_px)
        self._window_side_px = window_side_px(config, self._sampler.longest_side_px)
        pixels = self._sampler.pixel_count
        self.iterations = iteration_count(config, pixels)
        self._densifier = make_densifier(
            config.densify, iterations=self.iterations, max_gaussians=most_gaussians(config, pixels)
        )
        if config.exposure and state.exposures is None:
            state.exposures = Exposures.neutral(len(dataset.views))
        if state.densifier:
            self._densifier.restore(state.densifier)
        self._every = -(-config.checkpoint_every // config.rebuild_every) * config.rebuild_every
        # Probes have a generator of their own, so that measuring never changes the training.
        probe_rng = np.random.Generator(np.random.PCG64([config.seed, 1]))
        self._probe = self._make_probe(self._sampler, probe_rng)
        self._held_out = None
        if len(dataset.test_indices):
            self._held_out = self._make_probe(PixelSampler(dataset.test_indices, sizes_px), probe_rng)
        self._hits_per_ray = 0.0

    def run(self) -> FlatGaussians:
        """Train to the end and return the Gaussians to export: the last ones, or the best if those collapsed.

        Raises:
            TrainingFailure: parameters became not-a-number, or nothing is left to see.
            Cancelled: stopped as asked; a checkpoint is on disk.
        """
        state, config = self.state, self._config
        total = self.iterations
        rebuild = True
        began = time.perf_counter()
        started_at, started_seconds = state.iteration, state.seconds
        while True:
            scheduled = state.iteration % self._every == 0 or state.iteration == total
            if scheduled or state.iteration % rebuild_interval(config, len(state.gaussians)) == 0:
                self._raise_degree()
                self._tracer.build(state.gaussians)
                rebuild = False
                stop = self._should_stop() and state.iteration < total
                if stop or scheduled:
                    state.seconds += time.perf_counter() - began
                    if state.iteration > started_at or state.iteration == 0:
                        # Probes only where an uninterrupted run has them, so that the best is the same one.
                        if scheduled:
                            self._measure_state()
                        self._save()
                    began = time.perf_counter()
                if stop:
                    raise Cancelled(
                        f"Stopped after iteration {state.iteration} of {total}; "
                        "the same command with --resume goes on."
                    )
                if state.iteration == total:
                    break
            elif rebuild:
                self._tracer.build(state.gaussians)
                rebuild = False
            loss = self._iterate()
            fitted = state.iteration >= config.fit_iterations
            if fitted and self._densifier.due(state.iteration):
                state.gaussians, state.adam = self._densifier.apply(
                    state.gaussians, state.adam, state.rng, extent=self._extent
                )
                self._check_not_empty()
                # Neighbours in space become neighbours in memory, which the tracer's caches like.
                order = morton_order(state.gaussians.means_world)
                state.gaussians, state.adam = state.gaussians.select(order), state.adam.select(order)
                rebuild = True
            if state.iteration % EVENT_EVERY == 0 or state.iteration == total:
                seconds = state.seconds + time.perf_counter() - began
                pace = (seconds - started_seconds) / (state.iteration - started_at)
                self._tell(
                    TrainingProgress(
                        iteration=state.iteration,
                        total_iterations=total,
                        loss=loss,
                        psnr=_psnr(state.running_mse),
                        gaussians=len(state.gaussians),
                        rays_per_second=config.rays / pace,
                        hits_per_ray=self._hits_per_ray,
                        seconds=seconds,
                        seconds_left=pace * (total - state.iteration),
                    )
                )
        return self._choose_result()

    def _iterate(self) -> float:
        """One iteration; returns the loss."""
        state, config = self.state, self._config
        batch = draw_batch(
            self._dataset,
            self._sampler,
            state.rng,
            rays=config.rays,
            window_rays=config.window_rays,
            window_side=self._window_side_px,
            patch_fraction=config.patch_fraction if config.loss.ssim > 0 else 0.0,
            side=config.patch_side,
        )
        background = self._draw_background()
        seen = self._tracer.trace(batch.rays, record=True)
        assert seen.hits is not None
        self._hits_per_ray = float(seen.hit_counts.mean())
        rgb, exposures = seen.rgb_srgb, state.exposures
        if exposures is not None:
            rgb = exposures.develop(batch.view, rgb, seen.alpha)
        render = rgb + seen.transmittance[:, None] * background
        target = _composite(batch, background)
        pixel = pixel_loss(render, target, batch.weight, l1=config.loss.l1, l2=config.loss.l2)
        loss, gradient = pixel.value, pixel.gradient
        if batch.patches and config.loss.ssim > 0:
            structure, patch_gradient = _patch_term(render, target, batch)
            loss += config.loss.ssim * structure
            gradient[-len(patch_gradient) :] += np.float32(config.loss.ssim) * patch_gradient
        if not np.isfinite(loss):
            raise TrainingFailure(
                f"The loss became {loss} at iteration {state.iteration + 1}; lower the learning rates "
                "(--set rates.mean=...) or look for damaged photographs. The last checkpoint is kept."
            )
        progress = state.iteration / self.iterations
        by_rgb, by_transmittance = gradient, gradient @ background
        if exposures is not None:
            by_rgb, by_alpha = exposures.undevelop(batch.view, gradient)
            by_transmittance = by_transmittance - by_alpha
            rate = config.rates.exposure * config.rates.decay**progress
            exposures.step(batch.view, seen.rgb_srgb, seen.alpha, gradient, rate=rate)
        gradients = self._tracer.backward(
            seen.hits,
            TraceGradients(rgb_srgb=by_rgb, transmittance=by_transmittance, ray_errors=pixel.ray_errors),
        ).numpy()
        moved = state.adam.step(
            state.gaussians, gradients, config.rates, config.loss, progress=progress, extent=self._extent
        )
        self._tracer.refresh(gradients.ids)
        self._densifier.observe(len(state.gaussians), gradients, moved)
        state.iteration += 1
        keep = min(RUNNING, 1 - 1 / state.iteration)
        state.running_mse = keep * state.running_mse + (1 - keep) * pixel.squared_error
        return float(loss)

    def _draw_background(self) -> Float32[np.ndarray, "3"]:
        name = self._config.background
        if name == "auto":
            name = "random" if self._dataset.has_alpha else "black"
        if name == "random":
            return self.state.rng.random(3, dtype=np.float32)
        return np.full(3, 1.0 if name == "white" else 0.0, np.float32)

    def _raise_degree(self) -> None:
        state, config = self.state, self._config
        wanted = min(config.sh_degree, state.iteration // config.sh_every)
        if wanted > state.gaussians.sh_degree:
            count = (wanted + 1) ** 2
            extra = count - state.gaussians.sh.shape[1]
            state.gaussians.sh = np.pad(state.gaussians.sh, ((0, 0), (0, extra), (0, 0)))
            state.adam = state.adam.widen(count)

    def _make_probe(self, sampler: PixelSampler, rng: np.random.Generator) -> Probe:
        view, y, x = sampler.pixels(rng, self._config.probe_rays)
        rgb, alpha, weight = self._dataset.pixels(view, y, x)
        background = np.full(3, 1.0 if self._config.background == "white" else 0.0, np.float32)
        target = rgb * alpha[:, None] + background * (1 - alpha[:, None])
        return Probe(self._dataset.rays(view, y, x), target, weight, view, background)

    def _measure(self, probe: Probe) -> tuple[float, float]:
        """PSNR averaged over the views, and the mean accumulated alpha, on a probe's rays."""
        seen = self._tracer.trace(probe.rays)
        render = np.clip(seen.rgb_srgb + seen.transmittance[:, None] * probe.background, 0, 1)
        error = ((render - probe.rgb_srgb) ** 2).mean(axis=1) * probe.weight
        views, inverse = np.unique(probe.view, return_inverse=True)
        sums = np.bincount(inverse, weights=error, minlength=len(views))
        counts = np.bincount(inverse, weights=probe.weight, minlength=len(views))
        used = counts > 0
        psnr = float(np.mean([_psnr(value) for value in sums[used] / counts[used]])) if used.any() else 0.0
        return psnr, float(seen.alpha.mean())

    def _measure_state(self) -> None:
        """Refuse a broken state, keep the best one, and tell of the held-out views."""
        state = self.state
        if not state.gaussians.is_finite():
            raise TrainingFailure(
                f"Parameters became not-a-number by iteration {state.iteration}; nothing is exported. "
                "The last checkpoint is kept."
            )
        psnr, alpha = self._measure(self._probe)
        if alpha < EMPTY_ALPHA and state.iteration > 0:
            raise TrainingFailure(
                f"After iteration {state.iteration} the scene covers only {100 * alpha:.2f} % of the "
                "photographs; nothing is exported. Check that poses and photographs belong together."
            )
        if psnr > state.best_psnr:
            state.best_psnr, state.best_iteration = psnr, state.iteration
            save_best(state.gaussians, self._folder)
        if self._held_out is not None:
            held_out, _ = self._measure(self._held_out)
            self._tell(HeldOutMeasured(state.iteration, held_out, len(state.gaussians), state.seconds))

    def _save(self) -> None:
        state = self.state
        state.densifier = self._densifier.state()
        path = save_checkpoint(state, self._folder, self._fingerprint)
        self._tell(CheckpointWritten(state.iteration, str(path)))

    def _check_not_empty(self) -> None:
        if len(self.state.gaussians) == 0:
            raise TrainingFailure(
                f"Densification removed every Gaussian at iteration {self.state.iteration}; "
                "nothing is exported. Lower the pruning thresholds (--set densify.prune_opacity=...)."
            )

    def _choose_result(self) -> FlatGaussians:
        state = self.state
        last, _ = self._measure(self._probe)
        if last < state.best_psnr - COLLAPSE_DB:
            self._tell(
                Warned(
                    f"The last state ({last:.1f} dB) is worse than that of iteration {state.best_iteration} "
                    f"({state.best_psnr:.1f} dB); the better one is exported."
                )
            )
            return load_best(self._folder)
        return state.gaussians


def fresh_state(gaussians: FlatGaussians, seed: int) -> TrainState:
    """The state before the first iteration."""
    return TrainState(
        iteration=0,
        gaussians=gaussians,
        adam=Adam.fresh(gaussians),
        rng=np.random.Generator(np.random.PCG64([seed, 0])),
        densifier={},
    )


def _composite(batch: Batch, background: Float32[np.ndarray, "3"]) -> Float32[np.ndarray, "r 3"]:
    alpha = batch.alpha[:, None]
    return batch.rgb_srgb * alpha + background * (np.float32(1) - alpha)


def _patch_term(
    render: Float32[np.ndarray, "r 3"], target: Float32[np.ndarray, "r 3"], batch: Batch
) -> tuple[float, Float32[np.ndarray, "p 3"]]:
    """1 - SSIM of the batch's patches and its gradient; masked pixels take the photograph's colour."""
    count = batch.patches * batch.side**2
    shape = (batch.patches, batch.side, batch.side, 3)
    weight = batch.weight[-count:, None]
    shown = target[-count:]
    mixed = render[-count:] * weight + shown * (1 - weight)
    value, gradient = ssim_loss(mixed.reshape(shape), shown.reshape(shape))
    return value, gradient.reshape(-1, 3) * weight


def _psnr(mse: float) -> float:
    return float(-10 * np.log10(max(mse, 1e-10)))

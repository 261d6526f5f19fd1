"""Exposure of the training views: a gain and an offset for each channel of each, learnt beside the Gaussians.

A phone sets its exposure anew for every photograph. Without a model of that, Gaussians learn to look
different from where each photograph was taken. The scene keeps the exposure that is the mean of all.

Nothing is fitted to views that were not trained on: their exposure is guessed from what they show of the
scene and from the photographs beside them (:mod:`octasplat.engine.shading.exposure_estimation`).
"""

import copy
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float32, Float64, Int64

from octasplat.engine.core.color import linear_to_srgb, srgb_to_linear
from octasplat.engine.shading.exposure_estimation import estimate_values, times_from_names
from octasplat.engine.shading.kernels.exposure import ExposedRays, expose_rays, gather_exposure_gradients
from octasplat.engine.shading.plain import PLAIN_SHADING
from octasplat.engine.shading.protocol import (
    LINEAR,
    ShadedRayGradients,
    ShadedRays,
    ShadingGradients,
    ShadingModel,
    ShadingStep,
    TracedRays,
)
from octasplat.engine.shading.wrapper import WrapperModel

BETA1, BETA2, EPSILON = 0.9, 0.99, 1e-15
ExposuresByName = Mapping[str, Mapping[str, Sequence[float]]]
"""Log gains and offsets of views, by their names."""


class ExposureModel(WrapperModel):
    """Expose the colors of another model: exp(log_gain) * color + offset, for each view and channel.

    Follows :class:`octasplat.engine.shading.protocol.ShadingModel`. Rays of no view have the mean
    exposure.

    Args:
        views: number of views, whether they are trained on or not.
        rate: size of a step of log gains and offsets at the beginning.
        decay: what is left of that at the end; it falls exponentially.
        inner: the model whose colors are exposed.

    Attributes:
        log_gains: logarithm of each view's gains.
        offsets: of each view, display values.
        first: first moments of Adam, gains before offsets; ``second`` holds the second ones.
        steps: each view's steps.
        inner: the model whose colors are exposed.
    """

    name = "exposure"
    state_names = ("log_gains", "offsets", "first", "second", "steps")

    def __init__(
        self, views: int, *, rate: float, decay: float = 1.0, inner: ShadingModel = PLAIN_SHADING
    ) -> None:
        self.log_gains: Float32[np.ndarray, "v 3"] = np.zeros((views, 3), np.float32)
        self.offsets: Float32[np.ndarray, "v 3"] = np.zeros((views, 3), np.float32)
        self.first: Float32[np.ndarray, "v 6"] = np.zeros((views, 6), np.float32)
        self.second: Float32[np.ndarray, "v 6"] = np.zeros((views, 6), np.float32)
        self.steps: Int64[np.ndarray, " v"] = np.zeros(views, np.int64)
        self._rate = rate
        self._decay = decay
        self._fixed_view: int | None = None
        super().__init__(inner)

    @classmethod
    def from_known(cls, names: Sequence[str], known: ExposuresByName) -> "ExposureModel":
        """Return the exposures of named views that a finished training has left; not to be trained."""
        exposures = cls(len(names), rate=0.0)
        exposures.load_known(names, known)
        return exposures

    def shade(self, traced: TracedRays) -> ShadedRays:
        """Return colors as the rays' views expose them; other rays have the mean or a fixed exposure."""
        inner = self.inner.shade(traced)
        view = traced.view if self._fixed_view is None else self._fixed_view
        if view is None:
            return inner
        rgb = np.empty_like(inner.rgb_srgb)
        # offsets belong to what is covered: the background is not exposed
        expose_rays(self._exposed_rays(np.broadcast_to(view, len(rgb)), inner), rgb)
        return ShadedRays(rgb, inner.transmittance, inner, self._exposed_layers(inner.layers))

    def _exposed_layers(
        self, layers: Mapping[str, Float32[np.ndarray, "r _"]]
    ) -> Mapping[str, Float32[np.ndarray, "r _"]]:
        """Return the layers of a picture, its radiance as what the fixed view shows of it, up to white.

        Pictures of several rays a pixel are means of that layer.
        """
        view = self._fixed_view
        if view is None or LINEAR not in layers:
            return layers
        shown = linear_to_srgb(np.minimum(layers[LINEAR], np.float32(1)))
        exposed = np.exp(self.log_gains[view]) * shown + self.offsets[view]
        return {**layers, LINEAR: srgb_to_linear(exposed)}

    def _exposed_rays(self, view: Int64[np.ndarray, " r"], inner: ShadedRays) -> ExposedRays:
        return ExposedRays(
            np.ascontiguousarray(view, np.int64),
            np.exp(self.log_gains),
            self.offsets,
            np.ascontiguousarray(inner.rgb_srgb),
            np.ascontiguousarray(inner.transmittance),
        )

    def for_view(self, view: int) -> "ExposureModel":
        """Return the same model, exposing everything as one view; it shares the arrays and is not trained."""
        other = copy.copy(self)
        other._fixed_view = view
        return other

    def over(self, inner: ShadingModel) -> "ExposureModel":
        """Return the same exposures of another model's colors; they share the arrays."""
        other = copy.copy(self)
        other.inner = inner
        return other

    def remove_exposure(
        self, rgb_srgb: Float32[np.ndarray, "h w 3"], view: int
    ) -> Float32[np.ndarray, "h w 3"]:
        """Return a view's straight display colors at the mean exposure, within [0, 1]."""
        unexposed = (rgb_srgb - self.offsets[view]) / np.exp(self.log_gains[view])
        return np.asarray(np.clip(unexposed, 0, 1), np.float32)

    def estimate_untrained(
        self, names: Sequence[str], brightness: Float64[np.ndarray, " v"] | None = None
    ) -> None:
        """Give views that were not trained on the exposures that the trained ones suggest.

        See :mod:`octasplat.engine.shading.exposure_estimation`.

        Args:
            names: of all views.
            brightness: of all views, as the mean exposure shows the scene; None where that is not known.
        """
        trained, others = np.flatnonzero(self.steps > 0), np.flatnonzero(self.steps == 0)
        times = times_from_names(names)
        for values in (self.log_gains, self.offsets):
            known = values[trained].astype(np.float64)
            values[others] = estimate_values(known, trained, others, times, brightness)

    def backward(self, traced: TracedRays, shaded: ShadedRays, grad: ShadedRayGradients) -> ShadingGradients:
        """Return gradients by what the inner model shaded, and by each used view's log gains and offsets."""
        view, inner = traced.view, shaded.ctx
        assert view is not None and isinstance(inner, ShadedRays), (
            "only views of the training are learnt from"
        )
        by_rgb, by_transmittance = np.empty_like(grad.rgb_srgb), grad.transmittance.copy()
        sums, counts = np.empty((len(self.steps), 6)), np.empty(len(self.steps), np.int64)
        gather_exposure_gradients(
            self._exposed_rays(view, inner),
            np.ascontiguousarray(grad.rgb_srgb), by_rgb, by_transmittance, sums, counts,
        )  # fmt: skip
        used = np.flatnonzero(counts)
        inner_grad = ShadedRayGradients(by_rgb, by_transmittance)
        inner_gradients = self.inner.backward(traced, inner, inner_grad)
        exposure_gradients = {"exposure.views": used, "exposure.sums": sums[used]}
        return ShadingGradients(
            inner_gradients.trace,
            inner_gradients.recorded_traces,
            {**inner_gradients.parameters, **exposure_gradients},
        )

    def step(self, update: ShadingStep) -> None:
        """Take a step of Adam for the views of the batch, then subtract the mean over all views so far."""
        super().step(update)
        used, sums = update.parameters["exposure.views"], update.parameters["exposure.sums"]
        self.steps[used] += 1
        steps = self.steps[used, None]
        # one row and step count a view: only the views of the batch move
        self.first[used] = BETA1 * self.first[used] + (1 - BETA1) * sums
        self.second[used] = BETA2 * self.second[used] + (1 - BETA2) * sums**2
        mean = self.first[used] / (1 - BETA1**steps)
        size = np.sqrt(self.second[used] / (1 - BETA2**steps)) + EPSILON
        change = (self._rate * self._decay**update.training_progress * mean / size).astype(np.float32)
        self.log_gains[used] -= change[:, :3]
        self.offsets[used] -= change[:, 3:]
        is_trained = self.steps > 0
        # the scene's brightness and a common exposure cannot be told apart
        for values in (self.log_gains, self.offsets):
            values[is_trained] -= values[is_trained].mean(axis=0, dtype=np.float64).astype(np.float32)

    def as_dict(self, names: Sequence[str]) -> dict[str, dict[str, list[float]]]:
        """Return a JSON-ready record by the names of all views; :meth:`load_known` reads it."""
        rows = zip(names, self.log_gains.tolist(), self.offsets.tolist(), strict=True)
        return {name: {"log_gains": gains, "offsets": offsets} for name, gains, offsets in rows}

    def load_known(self, names: Sequence[str], known: ExposuresByName) -> None:
        """Take the exposures of the views that are known by their names."""
        for number, name in enumerate(names):
            if name in known:
                self.log_gains[number] = known[name]["log_gains"]
                self.offsets[number] = known[name]["offsets"]

"""Measured views and their summary, as ``metrics.json`` holds them."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32

from octasplat.engine.core.errors import DatasetError
from octasplat.engine.core.psnr import fit_color, psnr
from octasplat.engine.evaluate.metrics import (
    DEFINITIONS,
    fill_invalid,
    flip,
    quantize_8_bit,
    structural_similarity,
)
from octasplat.engine.evaluate.view_support import Support

FOREGROUND_ALPHA = 0.5
BOOTSTRAP_DRAWS = 2000
OPTIONAL_METRICS = ("psnr_foreground", "depth_spread")
"""Metrics that are left out where no view has them."""
DEPTH_SPREAD_MIN = 0.1
"""Share of the depth by which mean and median differ where there is more than a surface."""


class RenderedView(NamedTuple):
    """A held-out photograph beside its render.

    Attributes:
        name: The photograph's name.
        render: Display values.
        reference: Display values of the photograph at the render's size, over the same background.
        weight: 1 where the photograph is valid, 0 where a mask rules it out.
        alpha: Coverage of the photograph's foreground, for photographs that have one.
        layers: What lies behind the render, as display values by name.
        depth_spread: See :func:`depth_spread`; ``None`` where depths are not known.
        support: Training views that see what it shows; ``None`` where that was not asked.
    """

    name: str
    render: Float32[np.ndarray, "h w 3"]
    reference: Float32[np.ndarray, "h w 3"]
    weight: Float32[np.ndarray, "h w"]
    alpha: Float32[np.ndarray, "h w"] | None = None
    layers: Mapping[str, Float32[np.ndarray, "h w 3"]] = MappingProxyType({})
    depth_spread: float | None = None
    support: Support | None = None


@dataclass(frozen=True)
class ViewMetrics:
    """The metrics of one view; see ``metrics.DEFINITIONS``.

    ``psnr`` is infinite for a perfect render and not-a-number when the mask leaves no pixel. Metrics that the
    view is too small for, has no foreground for, or of which the mask leaves nothing are ``None``.
    """

    name: str
    width: int
    height: int
    psnr: float
    psnr_colour_corrected: float
    ssim: float | None
    ssim_valid: float | None
    ms_ssim: float | None
    flip: float | None
    psnr_foreground: float | None = None
    depth_spread: float | None = None


class MeasuredView(NamedTuple):
    """A view's metrics and its FLIP error map, in [0, 1] per pixel."""

    metrics: ViewMetrics
    flip_map: Float32[np.ndarray, "h w"]


@dataclass(frozen=True)
class Metrics:
    """All views and their means.

    Attributes:
        views: In the order in which they came.
        mean: Mean over the views of which the metric is finite, by key; ``None`` when none is.
        left_out: Of how many views it is not, by key, where there are any.
        mean_psnr_ci95: 95 % bootstrap interval of the mean PSNR over the views.
    """

    views: tuple[ViewMetrics, ...]
    mean: dict[str, float | None]
    left_out: dict[str, int]
    mean_psnr_ci95: tuple[float, float] | None

    def as_dict(self, run: Mapping[str, object]) -> dict[str, object]:
        """Return the content of ``metrics.json``.

        Args:
            run: What the caller adds about the run: gaussians, iterations, seconds, resolution, seed,
                versions. Must be JSON-ready.

        Returns:
            JSON-ready values; infinite and undefined numbers become ``None``.
        """
        views = {}
        for view in self.views:
            row = {key: _none_if_not_finite(value) for key, value in asdict(view).items() if key != "name"}
            for key in OPTIONAL_METRICS:
                if key not in self.mean:
                    del row[key]
            views[view.name] = row
        interval = self.mean_psnr_ci95
        return {
            "mean": {key: _none_if_not_finite(value) for key, value in self.mean.items()},
            **({"mean_left_out": self.left_out} if self.left_out else {}),
            "mean_psnr_ci95": None
            if interval is None
            else [_none_if_not_finite(bound) for bound in interval],
            "views": views,
            "definitions": dict(DEFINITIONS),
            **run,
        }


def measure_view(view: RenderedView, threads: int = 1) -> MeasuredView:
    """Measure all metrics of one view.

    Render and reference are rounded to 8 bits first, as they would be in files. Pixels that the weight rules
    out do not count; where metrics look at the neighbourhood of others, they show what the reference shows.

    Args:
        view: what is measured.
        threads: for the kernels of the metrics.

    Raises:
        DatasetError: Render and reference differ in size, or the render has pixels that are no number.
    """
    if view.render.shape != view.reference.shape:
        raise DatasetError(
            f"The render of {view.name} has {_size_text(view.render)} pixels but its photograph "
            f"{_size_text(view.reference)}; render at the photograph's size."
        )
    if not np.isfinite(view.render).all():
        raise DatasetError(f"The render of {view.name} has pixels that are no number.")
    reference = quantize_8_bit(view.reference)
    render = quantize_8_bit(view.render)
    filled = fill_invalid(render, reference, view.weight)
    similarity = structural_similarity(filled, reference, view.weight, threads)
    flip_map, mean_flip = flip(filled, reference, view.weight, threads)
    height, width = view.weight.shape
    metrics = ViewMetrics(
        name=view.name,
        width=width,
        height=height,
        psnr=psnr(render, reference, view.weight),
        psnr_colour_corrected=psnr(fit_color(render, reference, view.weight), reference, view.weight),
        ssim=_none_if_nan(similarity.ssim),
        ssim_valid=_none_if_nan(similarity.ssim_valid),
        ms_ssim=similarity.ms_ssim,
        flip=_none_if_nan(mean_flip),
        psnr_foreground=_psnr_foreground(render, reference, view.weight, view.alpha),
        depth_spread=view.depth_spread,
    )
    return MeasuredView(metrics, flip_map)


def depth_spread(
    depth: Float32[np.ndarray, "h w"],
    depth_median: Float32[np.ndarray, "h w"],
    weight: Float32[np.ndarray, "h w"] | None = None,
) -> float | None:
    """Return the share of covered pixels that show more than one surface, such as haze.

    Args:
        depth: Expected distances.
        depth_median: Distances at which half of the light is gone, 0 where it never is: not covered.
        weight: How much each pixel counts; None for all alike.

    Returns:
        The share of pixels whose two distances differ by more than a tenth; ``None`` where none is covered.
    """
    covered = (depth_median > 0) if weight is None else (depth_median > 0) & (weight > 0)
    if not covered.any():
        return None
    apart = np.abs(depth - depth_median) > DEPTH_SPREAD_MIN * depth_median
    return float(np.average(apart[covered], weights=None if weight is None else weight[covered]))


def summarize_views(views: Iterable[ViewMetrics]) -> Metrics:
    """Return means over views, each metric over those of which it is finite.

    Raises:
        DatasetError: Two views share a name.
    """
    rows = tuple(views)
    names = [row.name for row in rows]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise DatasetError(f"Two measured views are named {twice}; names must differ.")
    keys = ["psnr", "psnr_colour_corrected", "ssim", "ssim_valid", "ms_ssim", "flip"]
    keys += [key for key in OPTIONAL_METRICS if any(getattr(row, key) is not None for row in rows)]
    finite = {key: [value for row in rows if _is_finite(value := getattr(row, key))] for key in keys}
    mean = {key: sum(values) / len(values) if values else None for key, values in finite.items()}
    left_out = {key: len(rows) - len(values) for key, values in finite.items() if len(values) < len(rows)}
    return Metrics(rows, mean, left_out, bootstrap_interval([row.psnr for row in rows]))


def bootstrap_interval(
    values: Sequence[float], *, level: float = 0.95, seed: int = 0
) -> tuple[float, float] | None:
    """Return the percentile bootstrap interval of the mean; deterministic.

    After "Bootstrap Methods: Another Look at the Jackknife" (https://doi.org/10.1214/aos/1176344552).
    Numbers that are not finite are left out. ``None`` for fewer than two values, which have no spread.
    """
    finite = np.array([value for value in values if math.isfinite(value)])
    if len(finite) < 2:
        return None
    draws = np.random.default_rng(seed).integers(0, len(finite), (BOOTSTRAP_DRAWS, len(finite)))
    means = finite[draws].mean(axis=1)
    low, high = np.quantile(means, [(1 - level) / 2, (1 + level) / 2])
    return float(low), float(high)


def _psnr_foreground(
    render: Float32[np.ndarray, "h w 3"],
    reference: Float32[np.ndarray, "h w 3"],
    weight: Float32[np.ndarray, "h w"],
    alpha: Float32[np.ndarray, "h w"] | None,
) -> float | None:
    if alpha is None:
        return None
    value = psnr(render, reference, np.where(alpha > FOREGROUND_ALPHA, weight, np.float32(0)))
    return _none_if_nan(value)


def _none_if_nan(value: float) -> float | None:
    return None if math.isnan(value) else value


def _is_finite(value: float | None) -> bool:
    return value is not None and math.isfinite(value)


def _none_if_not_finite(value: object) -> object:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _size_text(image: np.ndarray) -> str:
    return f"{image.shape[1]} x {image.shape[0]}"

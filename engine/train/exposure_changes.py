"""Whether the exposure changes from photograph to photograph, as the points that they share show it."""

from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float64, Int64

from engine.scene.model import Observations
from engine.train.batches import TrainingData

DARKEST, BRIGHTEST = 0.1, 0.95
"""Display values beyond which a brightness says little."""
LEAST_POINTS = 30
"""A photograph that shows fewer points says nothing."""
ROUNDS = 8
CHANGES = 0.05
"""Standard deviation of the photographs' log brightness from which on exposure makes a difference."""


@runtime_checkable
class TrackedPhotographs(TrainingData, Protocol):
    """Photographs with the points that they show (see :class:`engine.scene.Dataset`)."""

    observations: Observations


def log_brightness(dataset: TrackedPhotographs) -> Float64[np.ndarray, " v"]:
    """How much brighter each training view shows the points that it shares with others, as a logarithm.

    Medians over points and over views by turns, so that highlights and wrong matches do not count. The middle
    view has 0; views that share too few points, and those held out, are not-a-number.
    """
    count = len(dataset.views)
    brightness = np.full(count, np.nan)
    seen = dataset.observations
    rows = np.flatnonzero(np.isin(seen.view, dataset.train_indices))
    if len(rows) == 0:
        return brightness
    view = seen.view[rows]
    _, point = np.unique(seen.point[rows], return_inverse=True)
    sizes = np.array([[v.width_px, v.height_px] for v in dataset.views], np.int64)[view]
    x, y = np.clip(seen.xy_px[rows].astype(np.int64), 0, sizes - 1).T
    rgb, _, weight = dataset.pixels(view, np.ascontiguousarray(y), np.ascontiguousarray(x))
    shown = rgb.mean(axis=1, dtype=np.float64)
    valid = (weight > 0) & (shown > DARKEST) & (shown < BRIGHTEST)
    view, point, levels = view[valid], point[valid], np.log(shown[valid])
    views = np.zeros(count)
    for _ in range(ROUNDS):
        points = _medians(levels - views[view], point, int(point.max(initial=0)) + 1)
        views = _medians(levels - points[point], view, count)
    known = np.bincount(view, minlength=count) >= LEAST_POINTS
    if known.any():
        brightness[known] = views[known] - np.median(views[known])
    return brightness


def complaint(brightness: Float64[np.ndarray, " v"]) -> str | None:
    """What the user should know of it."""
    known = brightness[np.isfinite(brightness)]
    if len(known) < 2 or float(known.std()) < CHANGES:
        return None
    return (
        f"The exposure changes from photograph to photograph: the same things are shown up to "
        f"{np.exp(known.max() - known.min()):.1f} times as bright. The setting exposure=true learns that."
    )


def _medians(
    values: Float64[np.ndarray, " k"], group: Int64[np.ndarray, " k"], count: int
) -> Float64[np.ndarray, " g"]:
    """The median of each group's values; 0 where there are none."""
    order = np.lexsort((values, group))
    sizes = np.bincount(group, minlength=count)
    starts = np.cumsum(sizes) - sizes
    some = sizes > 0
    sorted_values, found = values[order], np.zeros(count)
    low, high = (starts + (sizes - 1) // 2)[some], (starts + sizes // 2)[some]
    found[some] = (sorted_values[low] + sorted_values[high]) / 2
    return found

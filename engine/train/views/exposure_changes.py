"""Whether the exposure changes from photograph to photograph, as the points that they share show it."""

from typing import Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, Float64, Int64

from octasplat.engine.dataset.model import Observations
from octasplat.engine.train.sampling.pixel_sampler import TrainingData

MIN_VALUE, MAX_VALUE = 0.1, 0.95
"""Display values beyond which a brightness says little."""
MAX_OBSERVATIONS = 500_000
"""Of a capture that has more, one in so many points is asked: each is a read at a random place of a file."""
MIN_POINTS = 30
"""A photograph that shows fewer points says nothing."""
ROUNDS = 8
MIN_CHANGE = 0.05
"""Standard deviation of the photographs' log brightness from which on exposure makes a difference."""


@runtime_checkable
class TrackedTrainingData(TrainingData, Protocol):
    """Photographs with the points that they show (see :class:`octasplat.engine.dataset.Dataset`)."""

    observations: Observations


def relative_log_brightness(dataset: TrackedTrainingData) -> Float64[np.ndarray, " v"]:
    """Return the log of how much brighter each training view shows the points that it shares with others.

    Medians over points and over views by turns, so that highlights and wrong matches do not count. The middle
    view has 0; views that share too few points, and those held out, are not-a-number.
    """
    count = len(dataset.views)
    brightness = np.full(count, np.nan)
    observations = dataset.observations
    rows = np.flatnonzero(np.isin(observations.view, dataset.train_indices))
    if len(rows) == 0:
        return brightness
    step = -(-len(rows) // MAX_OBSERVATIONS)
    rows = rows[observations.point[rows] % step == 0]
    view = observations.view[rows]
    _, point = np.unique(observations.point[rows], return_inverse=True)
    sizes = np.array([[v.width_px, v.height_px] for v in dataset.views], np.int64)[view]
    x, y = np.clip(observations.xy_px[rows].astype(np.int64), 0, sizes - 1).T
    rgb, _, weight = dataset.pixels(view, np.ascontiguousarray(y), np.ascontiguousarray(x))
    brightnesses = rgb.mean(axis=1, dtype=np.float64)
    # clipped or dark values do not follow the exposure
    valid = (weight > 0) & (brightnesses > MIN_VALUE) & (brightnesses < MAX_VALUE)
    view, point, levels = view[valid], point[valid], np.log(brightnesses[valid])
    views = np.zeros(count)
    medians_of_points = _GroupMedians(point, int(point.max(initial=0)) + 1)
    medians_of_views = _GroupMedians(view, count)
    for _ in range(ROUNDS):
        # alternating: points given the views, then views given the points
        points = medians_of_points(levels - views[view])
        views = medians_of_views(levels - points[point])
    known = np.bincount(view, minlength=count) >= MIN_POINTS
    if known.any():
        brightness[known] = views[known] - np.median(views[known])
    return brightness


def equalizing_gains(dataset: TrackedTrainingData) -> Float32[np.ndarray, " v"]:
    """Return factors on the display colors of each view that make all about as bright; 1 where unknown."""
    brightness = relative_log_brightness(dataset)
    return np.exp(-np.where(np.isfinite(brightness), brightness, 0.0)).astype(np.float32)


def exposure_change_notice(brightness: Float64[np.ndarray, " v"]) -> str | None:
    """Return a sentence where the exposure changes so much that it makes a difference, else None."""
    known = brightness[np.isfinite(brightness)]
    if len(known) < 2 or float(known.std()) < MIN_CHANGE:
        return None
    return (
        f"The exposure changes from photograph to photograph: the same things are shown up to "
        f"{np.exp(known.max() - known.min()):.1f} times as bright."
    )


def resolve_exposure(
    exposure: bool | Literal["auto"], dataset: TrackedTrainingData, *, has_materials: bool
) -> tuple[bool, str | None]:
    """Return whether exposure is learnt, and why where the photographs decided so.

    Materials learn one light for all photographs, and what shines, or was cut out, looks brighter from here
    than from there by itself: for these, ``auto`` learns no exposure.

    Args:
        exposure: what the settings say.
        dataset: the photographs.
        has_materials: whether materials are learnt.
    """
    if exposure != "auto":
        return exposure, None
    steady = has_materials or dataset.has_alpha  # what these show brighter need not be exposure
    reason = None if steady else exposure_change_notice(relative_log_brightness(dataset))
    return reason is not None, reason


class _GroupMedians:
    """Medians of the values of groups that stay the same.

    Args:
        group: of each value.
        count: number of groups.
    """

    def __init__(self, group: Int64[np.ndarray, " k"], count: int) -> None:
        self._count = count
        order = np.argsort(group, kind="stable")
        sizes = np.bincount(group, minlength=count)
        starts = np.cumsum(sizes) - sizes
        # Groups of one size are rows of one matrix, of which all medians are taken at once.
        self._matrices = [
            (same, order[starts[same][:, None] + np.arange(size)])
            for size in np.unique(sizes[sizes > 0]).tolist()
            for same in [np.flatnonzero(sizes == size)]
        ]

    def __call__(self, values: Float64[np.ndarray, " k"]) -> Float64[np.ndarray, " g"]:
        """Return the median of each group; 0 where it has no values."""
        medians = np.zeros(self._count)
        for groups, places in self._matrices:
            low, high = (places.shape[1] - 1) // 2, places.shape[1] // 2
            partitioned = np.partition(values[places], (low, high), axis=1)
            medians[groups] = (partitioned[:, low] + partitioned[:, high]) / 2
        return medians

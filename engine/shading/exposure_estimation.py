"""The exposure of a photograph that was not trained on, from those that were.

A camera exposes by how bright it finds what it looks at, and keeps its exposure for a while. So there are two
sources: a straight line over the brightness that the scene has in each view, as the mean exposure shows it;
and the views before and after, by the numbers in their names. Each is taken as far as it tells the trained
photographs' own exposures when they are left out. Either may go first while the other one tells what is left:
the guess is the mean of both ways, by the inverse of how much each leaves of the trained photographs.
"""

import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

MIN_VIEWS = 4
"""From fewer nothing is guessed."""
MIN_VIEWS_FOR_LINE = 8
"""From fewer no line over the brightness is drawn."""


def times_from_names(names: Sequence[str]) -> Float64[np.ndarray, " v"]:
    """Return when photographs were taken, in any unit: the last numbers of their names, as of video frames.

    Their places in the list where these do not ascend.
    """
    numbers = [re.findall(r"\d+", name.rsplit(".", 1)[0]) for name in names]
    if all(numbers):
        times = np.array([float(digits[-1]) for digits in numbers])
        if (np.diff(times) > 0).all():
            return times
    return np.arange(len(names), dtype=np.float64)


def estimate_values(
    known: Float64[np.ndarray, "k c"],
    trained: Int64[np.ndarray, " k"],
    others: Int64[np.ndarray, " m"],
    times: Float64[np.ndarray, " v"],
    brightness: Float64[np.ndarray, " v"] | None = None,
) -> Float64[np.ndarray, "m c"]:
    """Return values of the views ``others``: 0, the mean of the trained ones, where nothing tells more.

    Args:
        known: values of the trained views, whose mean is about 0.
        trained: their numbers, ascending.
        others: numbers of the views to guess.
        times: of all views, ascending, see :func:`times_from_names`.
        brightness: of all views as the mean exposure shows the scene; None where that is not known.
    """
    if len(trained) < MIN_VIEWS:
        return np.zeros((len(others), known.shape[1]))
    ours, theirs = times[trained], times[others]
    if brightness is None or len(trained) < MIN_VIEWS_FOR_LINE:
        return _neighbor_mean(known, ours, theirs)[0]
    views = _Views(known, ours, theirs, brightness[trained], brightness[others])
    ways = [_line_then_neighbors(views), _neighbors_then_line(views)]
    # by the inverse of the mean squared error when left out
    shares = np.array([1 / (np.square(left).mean() + 1e-12) for _, left in ways])
    shares /= shares.sum()
    return shares[0] * ways[0][0] + shares[1] * ways[1][0]


class _Views(NamedTuple):
    """Values, times and brightnesses of the trained views, and what is known of the others."""

    known: Float64[np.ndarray, "k c"]
    times: Float64[np.ndarray, " k"]
    other_times: Float64[np.ndarray, " m"]
    brightness: Float64[np.ndarray, " k"]
    other_brightness: Float64[np.ndarray, " m"]


Estimator = tuple[Float64[np.ndarray, "m c"], Float64[np.ndarray, "i c"]]
"""What is said of the other views, and what is left of each trained one when it is left out."""


def _line_then_neighbors(views: _Views) -> Estimator:
    """Predict by a line over the brightness, then by the residuals of the views before and after."""
    known, times, other_times, brightness, other_brightness = views
    middle, height = brightness.mean(), known.mean(axis=0)
    slopes, left_out, trust = _fit_slopes(brightness - middle, known, height)
    off_line = known - trust * (brightness - middle)[:, None] * slopes
    predicted, residuals = _neighbor_mean(off_line, times, other_times)
    missed = trust * ((brightness - middle)[:, None] * slopes - left_out)[1:-1]
    return trust * (other_brightness - middle)[:, None] * slopes + predicted, residuals + missed


def _neighbors_then_line(views: _Views) -> Estimator:
    """Predict by the views before and after, then by a line over how much brighter than these a view is."""
    known, times, other_times, brightness, other_brightness = views
    predicted, residuals = _neighbor_mean(known, times, other_times)
    brighter = brightness[1:-1] - _leave_one_out_neighbors(brightness[:, None], times)[:, 0]
    slopes, left_out, trust = _fit_slopes(brighter, residuals)
    other_brighter = other_brightness - np.interp(other_times, times, brightness)
    return predicted + trust * other_brighter[:, None] * slopes, residuals - trust * left_out


def _fit_slopes(
    brightness: Float64[np.ndarray, " k"],
    known: Float64[np.ndarray, "k c"],
    height: Float64[np.ndarray, " c"] | None = None,
) -> tuple[Float64[np.ndarray, " c"], Float64[np.ndarray, "k c"], float]:
    """Return slopes of lines over a brightness around 0, the leave-one-out predictions, and the trust.

    Lines go through 0, or through the ``height`` of the mean.
    """
    spread = float(brightness @ brightness)
    if spread <= 1e-12:
        return np.zeros(known.shape[1]), np.zeros_like(known), 0.0
    slopes, leverage = brightness @ known / spread, brightness**2 / spread
    fitted = brightness[:, None] * slopes
    if height is not None:
        fitted, leverage = fitted + height, leverage + 1 / len(brightness)
    # leave-one-out residual: residual / (1 - leverage)
    left_out = known - (known - fitted) / np.maximum(1 - leverage[:, None], 1e-6)
    return slopes, left_out, _shrinkage_factor(left_out, known)


def _neighbor_mean(
    known: Float64[np.ndarray, "k c"],
    times: Float64[np.ndarray, " k"],
    other_times: Float64[np.ndarray, " m"],
) -> Estimator:
    """Return the mean of the trained views before and after, weighted by nearness, times the trust."""
    interpolated = np.stack([np.interp(other_times, times, channel) for channel in known.T], axis=1)
    between = _leave_one_out_neighbors(known, times)
    trust = _shrinkage_factor(between, known[1:-1])
    return trust * interpolated, known[1:-1] - trust * between


def _leave_one_out_neighbors(
    known: Float64[np.ndarray, "k c"], times: Float64[np.ndarray, " k"]
) -> Float64[np.ndarray, "i c"]:
    """Return the prediction of each inner view from the views before and after it."""
    share = (times[1:-1] - times[:-2]) / (times[2:] - times[:-2])
    return known[:-2] + share[:, None] * (known[2:] - known[:-2])


def _shrinkage_factor(predicted: Float64[np.ndarray, "k c"], known: Float64[np.ndarray, "k c"]) -> float:
    """Return the factor in [0, 1] that brings predictions nearest to known values."""
    scale = float((predicted**2).sum())
    return min(max(float((predicted * known).sum()) / scale, 0.0), 1.0) if scale > 0 else 0.0

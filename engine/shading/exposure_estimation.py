"""The exposure of a photograph that was not trained on, from those that were.

A camera exposes by how bright it finds what it looks at, and keeps its exposure for a while. So there are two
sources: a straight line over the brightness that the scene has in each view, as the mean exposure shows it;
and the views before and after, by the numbers in their names. Each is taken as far as it tells the trained
photographs' own exposures when they are left out. Either may go first while the other one tells what is left:
the guess is the mean of both ways, by the inverse of how much each leaves of the trained photographs.
"""

import re
from collections.abc import Sequence

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
    found = [re.findall(r"\d+", name.rsplit(".", 1)[0]) for name in names]
    if all(found):
        numbers = np.array([float(digits[-1]) for digits in found])
        if (np.diff(numbers) > 0).all():
            return numbers
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
    light = brightness[trained], brightness[others]
    ways = [way(known, ours, theirs, *light) for way in (_line_then_neighbors, _neighbors_then_line)]
    shares = np.array([1 / (np.square(left).mean() + 1e-12) for _, left in ways])
    shares /= shares.sum()
    return shares[0] * ways[0][0] + shares[1] * ways[1][0]


Estimator = tuple[Float64[np.ndarray, "m c"], Float64[np.ndarray, "i c"]]
"""What is said of the other views, and what is left of each trained one when it is left out."""


def _line_then_neighbors(
    known: Float64[np.ndarray, "k c"],
    ours: Float64[np.ndarray, " k"],
    theirs: Float64[np.ndarray, " m"],
    our_brightness: Float64[np.ndarray, " k"],
    their_brightness: Float64[np.ndarray, " m"],
) -> Estimator:
    """Predict by a line over the brightness, then by the residuals of the views before and after."""
    middle, height = our_brightness.mean(), known.mean(axis=0)
    slopes, left_out, trust = _slopes(our_brightness - middle, known, height)
    rest = known - trust * (our_brightness - middle)[:, None] * slopes
    found, left = _neighbor_mean(rest, ours, theirs)
    missed = trust * ((our_brightness - middle)[:, None] * slopes - left_out)[1:-1]
    return trust * (their_brightness - middle)[:, None] * slopes + found, left + missed


def _neighbors_then_line(
    known: Float64[np.ndarray, "k c"],
    ours: Float64[np.ndarray, " k"],
    theirs: Float64[np.ndarray, " m"],
    our_brightness: Float64[np.ndarray, " k"],
    their_brightness: Float64[np.ndarray, " m"],
) -> Estimator:
    """Predict by the views before and after, then by a line over how much brighter than these a view is."""
    found, left = _neighbor_mean(known, ours, theirs)
    brighter = our_brightness[1:-1] - _leave_one_out_neighbors(our_brightness[:, None], ours)[:, 0]
    slopes, left_out, trust = _slopes(brighter, left)
    their_brighter = their_brightness - np.interp(theirs, ours, our_brightness)
    return found + trust * their_brighter[:, None] * slopes, left - trust * left_out


def _slopes(
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
    slopes, reach = brightness @ known / spread, brightness**2 / spread
    fitted = brightness[:, None] * slopes
    if height is not None:
        fitted, reach = fitted + height, reach + 1 / len(brightness)
    left_out = known - (known - fitted) / np.maximum(1 - reach[:, None], 1e-6)
    return slopes, left_out, _shrinkage(left_out, known)


def _neighbor_mean(
    known: Float64[np.ndarray, "k c"], ours: Float64[np.ndarray, " k"], theirs: Float64[np.ndarray, " m"]
) -> Estimator:
    """Return the mean of the trained views before and after, weighted by nearness, times the trust."""
    near = np.stack([np.interp(theirs, ours, channel) for channel in known.T], axis=1)
    between = _leave_one_out_neighbors(known, ours)
    trust = _shrinkage(between, known[1:-1])
    return trust * near, known[1:-1] - trust * between


def _leave_one_out_neighbors(
    known: Float64[np.ndarray, "k c"], ours: Float64[np.ndarray, " k"]
) -> Float64[np.ndarray, "i c"]:
    """Return the prediction of each inner view from the views before and after it."""
    share = (ours[1:-1] - ours[:-2]) / (ours[2:] - ours[:-2])
    return known[:-2] + share[:, None] * (known[2:] - known[:-2])


def _shrinkage(said: Float64[np.ndarray, "k c"], known: Float64[np.ndarray, "k c"]) -> float:
    """Return the factor in [0, 1] that brings predictions nearest to known values."""
    scale = float((said**2).sum())
    return min(max(float((said * known).sum()) / scale, 0.0), 1.0) if scale > 0 else 0.0

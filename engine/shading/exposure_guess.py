"""The exposure of a photograph that was not trained on, from those that were.

A camera exposes by how bright it finds what it looks at, and keeps its exposure for a while. So exposures
are guessed in two steps, each taken as far as it tells the trained photographs' own when they are left out:
a straight line over the brightness that the scene has in each view, as the mean exposure shows it; and what
is left of the views before and after, by number.
"""

import numpy as np
from jaxtyping import Float64, Int64

LEAST_VIEWS = 4
"""From fewer nothing is guessed."""
LEAST_FOR_LINE = 8
"""From fewer no line over the brightness is drawn."""


def guessed(
    known: Float64[np.ndarray, "k c"],
    trained: Int64[np.ndarray, " k"],
    others: Int64[np.ndarray, " m"],
    brightness: Float64[np.ndarray, " v"] | None = None,
) -> Float64[np.ndarray, "m c"]:
    """Values of the views ``others``: 0, the mean of the trained ones, as far as nothing tells more.

    Args:
        known: values of the trained views, whose mean is about 0.
        trained: their numbers, ascending.
        others: numbers of the views to guess.
        brightness: of all views as the mean exposure shows the scene; None where that is not known.
    """
    found = np.zeros((len(others), known.shape[1]))
    if len(trained) < LEAST_VIEWS:
        return found
    rest = known
    if brightness is not None and len(trained) >= LEAST_FOR_LINE:
        line, trust = _line(brightness[trained], known)
        centred = brightness - brightness[trained].mean()
        rest = known - trust * centred[trained, None] * line
        found += trust * centred[others, None] * line
    return found + _beside(rest, trained, others)


def _line(
    brightness: Float64[np.ndarray, " k"], known: Float64[np.ndarray, "k c"]
) -> tuple[Float64[np.ndarray, " c"], float]:
    """Slopes of the lines that fit best, and how far to trust them."""
    centred = brightness - brightness.mean()
    spread = float(centred @ centred)
    if spread <= 1e-12:
        return np.zeros(known.shape[1]), 0.0
    slopes = centred @ known / spread
    # What the line through all others says of each, without drawing it anew for each.
    reach = (1 / len(centred) + centred**2 / spread)[:, None]
    fitted = known.mean(axis=0) + centred[:, None] * slopes
    left_out = known - (known - fitted) / np.maximum(1 - reach, 1e-6)
    return slopes, _trust(left_out, known)


def _beside(
    known: Float64[np.ndarray, "k c"], trained: Int64[np.ndarray, " k"], others: Int64[np.ndarray, " m"]
) -> Float64[np.ndarray, "m c"]:
    """The mean of the trained views before and after, by how near they are, as far as it is to be trusted."""
    places, inner = trained.astype(np.float64), np.arange(1, len(trained) - 1)
    share = (places[inner] - places[inner - 1]) / (places[inner + 1] - places[inner - 1])
    between = known[inner - 1] + share[:, None] * (known[inner + 1] - known[inner - 1])
    near = np.stack([np.interp(others, trained, channel) for channel in known.T], axis=1)
    return _trust(between, known[inner]) * near


def _trust(said: Float64[np.ndarray, "k c"], known: Float64[np.ndarray, "k c"]) -> float:
    """The factor between 0 and 1 with which what is said comes nearest to what is known."""
    scale = float((said**2).sum())
    return min(max(float((said * known).sum()) / scale, 0.0), 1.0) if scale > 0 else 0.0

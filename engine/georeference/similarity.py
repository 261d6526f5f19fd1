"""Similarities between positions in a scene and on the ground, robust against some that are wrong."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from octasplat.engine.core.colmap_binding import pycolmap
from octasplat.engine.core.georeference import Residuals

MIN_POSITIONS = 3
LEAST_AGREEING = 0.5
"""Share of the positions that must agree with each other."""
MAX_TURN_ERROR = 0.1
"""Radians by which the turn about the longest axis of the positions may be uncertain."""
_MAD_SIGMA = 1.4826
_OUTLIER_SIGMAS = 3.0
_LEAST_LIMIT = 0.1
"""Of the tolerance: what is nearer is never left out."""


class SimilarityError(Exception):
    """No similarity can be found; the text is the rest of a sentence that begins with the positions."""


@dataclass(frozen=True, eq=False)
class Fit:
    """A similarity that takes positions in a scene to the ground.

    Attributes:
        matrix: metres from scene.
        used: which positions it was found by.
        distances_m: of each position from where it takes the scene's, metres.
    """

    matrix: Float64[np.ndarray, "4 4"]
    used: Bool[np.ndarray, " n"]
    distances_m: Float64[np.ndarray, " n"]

    def residuals(self, names: list[str]) -> Residuals:
        """Return how well it fits, with the names of the positions."""
        used = np.flatnonzero(self.used)
        worst = int(used[np.argmax(self.distances_m[used])])
        left = np.flatnonzero(~self.used)
        return Residuals(
            given=len(names),
            used=len(used),
            rmse_m=float(np.sqrt(np.mean(self.distances_m[used] ** 2))),
            worst=names[worst],
            worst_m=float(self.distances_m[worst]),
            left_out=tuple(names[i] for i in left[np.argsort(-self.distances_m[left], kind="stable")]),
        )


def fit_similarity(
    scene: Float64[np.ndarray, "n 3"],
    ground: Float64[np.ndarray, "n 3"],
    *,
    tolerance: float,
    max_tolerance_m: float = np.inf,
) -> Fit:
    """Return the similarity that takes most positions of ``scene`` near those of ``ground``.

    COLMAP's LO-RANSAC finds those that agree; those within three of their deviations then decide.

    Args:
        scene: positions in the scene.
        ground: the same in metres.
        tolerance: positions this far off, as a share of the spread of ``ground``, may still agree.
        max_tolerance_m: the same in metres, at most.

    Raises:
        SimilarityError: too few positions, on a line, or too many that contradict each other.
    """
    if len(scene) < MIN_POSITIONS:
        raise SimilarityError(f"are {len(scene)}, where {MIN_POSITIONS} are the least")
    # about their means, as map coordinates are large
    middle_scene, middle_ground = np.median(scene, axis=0), np.median(ground, axis=0)
    source, target = scene - middle_scene, ground - middle_ground
    spread = float(np.sqrt(np.median((target**2).sum(axis=1))))
    for points, where in ((source, "in the scene"), (target, "on the ground")):
        _, widths, _ = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)
        if not widths[1] > 1e-6 * widths[0]:
            raise SimilarityError(
                f"lie in one point or on one line {where}, which leaves the turn about it open"
            )
    if not spread > 1e-6 * float(np.linalg.norm(target, axis=1).max()):
        raise SimilarityError("lie in one place on the ground, half of them or more")
    options = pycolmap.RANSACOptions(
        max_error=max(min(tolerance * spread, max_tolerance_m), 1e-6 * spread), random_seed=0
    )
    found = pycolmap.estimate_sim3d_robust(source, target, options)
    if found is None:
        raise SimilarityError("contradict each other")
    used = _distances(found["tgt_from_src"].matrix(), source, target) <= options.max_error
    for _ in range(10):
        if used.sum() < max(MIN_POSITIONS, LEAST_AGREEING * len(scene)):
            raise SimilarityError(
                f"contradict the scene: {used.sum()} of {len(scene)} fit it within {options.max_error:.2g} m"
            )
        refined = pycolmap.estimate_sim3d(source[used], target[used])
        if refined is None:
            raise SimilarityError("contradict each other")
        distances = _distances(refined.matrix(), source, target)
        sigma = _MAD_SIGMA * float(np.median(distances[used]))
        limit = min(max(_OUTLIER_SIGMAS * sigma, _LEAST_LIMIT * options.max_error), options.max_error)
        before, used = used, distances <= limit
        if (used == before).all():
            break
    _require_known_turn(target[used], distances[used])
    matrix = np.eye(4)
    matrix[:3] = refined.matrix()
    matrix[:3, 3] += middle_ground - matrix[:3, :3] @ middle_scene
    return Fit(matrix, used, distances)


def _distances(
    matrix: Float64[np.ndarray, "3 4"], source: Float64[np.ndarray, "n 3"], target: Float64[np.ndarray, "n 3"]
) -> Float64[np.ndarray, " n"]:
    return np.asarray(np.linalg.norm(source @ matrix[:, :3].T + matrix[:, 3] - target, axis=1))


def _require_known_turn(ground: Float64[np.ndarray, "n 3"], distances_m: Float64[np.ndarray, " n"]) -> None:
    """Refuse positions that are nearly on a line, seen against their errors."""
    _, widths, _ = np.linalg.svd(ground - ground.mean(axis=0), full_matrices=False)
    across, rmse = float(widths[1]), float(np.sqrt(np.mean(distances_m**2)))
    # an error of each position turns a set of that width (a root of a sum of squares) by so much
    if not (across > 1e-6 * widths[0] and rmse <= MAX_TURN_ERROR * across):
        raise SimilarityError(
            f"lie nearly on a line or too close together for their errors of {rmse:.2g} m, which leaves the "
            "turn about it open"
        )

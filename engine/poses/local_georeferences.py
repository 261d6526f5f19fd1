"""Where the parts of a model lie by GPS: a similarity for the neighborhood of each photograph.

GPS of a telephone is metres off, so that it says little of a single photograph; but it tells how a walk of
dozens of metres is turned. In a model that is right, all neighborhoods are turned the same way. Where false
matches have joined two parts, each is right in itself, and turned or displaced against the other by GPS.
"""

import heapq
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Complex128, Float64, Int64
from scipy.sparse import coo_array
from scipy.sparse.csgraph import minimum_spanning_tree

from octasplat.engine.render.upright import estimate_up

NEIGHBORHOOD_SIZES = (12, 20, 33, 55, 90, 150)
"""Photographs of the neighborhoods that are tried; that of the surest turn is taken."""
MIN_SPREAD_M = 4.0
"""From the middle (root of the mean square): GPS errors, which drift slowly, would turn a smaller one."""
MAX_RELATIVE_ERROR = 0.35
"""What a similarity may leave of that spread."""
DRIFT_M = 2.0
"""Error that may hide in a neighborhood, as GPS drifts slowly."""
MIN_FIXES = 6
"""Different positions: telephones write the same one into several photographs."""
MIN_UPRIGHT = 0.3
"""Mean cosine between up and what is up in the photographs; below, as from a drone, up is not known."""
MAX_TURN = float(np.radians(45.0))
"""Between two neighborhoods that agree."""
MAX_DISPLACEMENT_M = 10.0
"""Of a photograph, as the neighborhood of another one puts it."""
_MIN_DISPLACEMENT_ERRORS = 3.0
"""A displacement exceeds so many errors of both neighborhoods."""
_MIN_DISPLACEMENT_SHARE = 0.5
"""It exceeds this share of the distance by GPS, too, as a scale that drifts does not."""
_MAX_ERRORS_OF_LENT = 3.0
"""A photograph fits the neighborhood of another one if it is off by so many of its errors at most."""


@dataclass(frozen=True, eq=False)
class LocalGeoreferences:
    """For each photograph, the similarity that takes its neighborhood to the ground.

    Attributes:
        rotation: east, north and up in the model, as rows.
        scale: metres in a unit of the model.
        middle: of the neighborhood, in the model.
        middle_m: the same on the ground.
        error_m: of the positions (root of the mean square).
        turn_error: how far the turn may be off, in radians; infinite where the similarity cannot be relied
            on.
        size: photographs of the neighborhood.
        members: the photograph, then those that the strongest links reach from it; -1 where they end.
            The first ``size`` are the neighborhood.
    """

    rotation: Float64[np.ndarray, "n 3 3"]
    scale: Float64[np.ndarray, " n"]
    middle: Float64[np.ndarray, "n 3"]
    middle_m: Float64[np.ndarray, "n 2"]
    error_m: Float64[np.ndarray, " n"]
    turn_error: Float64[np.ndarray, " n"]
    size: Int64[np.ndarray, " n"]
    members: Int64[np.ndarray, "n k"]

    @property
    def is_known(self) -> Bool[np.ndarray, " n"]:
        """Return whether each similarity can be relied on."""
        return np.isfinite(self.turn_error)

    def predict_m(
        self, by: Int64[np.ndarray, " p"], centers: Float64[np.ndarray, "p 3"]
    ) -> Float64[np.ndarray, "p 2"]:
        """Return where on the ground the neighborhoods of ``by`` put positions in the model."""
        away = np.einsum("pij,pj->pi", self.rotation[by, :2], centers - self.middle[by])
        return np.asarray(self.scale[by, None] * away + self.middle_m[by])

    def around(self, photographs: Int64[np.ndarray, " p"]) -> Int64[np.ndarray, " q"]:
        """Return the photographs of the neighborhoods of some, in order."""
        is_near = np.arange(self.members.shape[1]) < self.size[photographs, None]
        return np.unique(self.members[photographs][is_near])


def fit_neighborhoods(
    links: Int64[np.ndarray, "p 2"],
    strengths: Int64[np.ndarray, " p"],
    centers: Float64[np.ndarray, "n 3"],
    rotations_cam_from_world: Float64[np.ndarray, "n 3 3"],
    ground_m: Float64[np.ndarray, "n 2"],
) -> LocalGeoreferences:
    """Return what GPS says of the neighborhood of each photograph.

    Args:
        links: pairs of photographs, as indices.
        strengths: of the links; 0 for those that do not link.
        centers: of the cameras, in the model.
        rotations_cam_from_world: of the cameras.
        ground_m: of the cameras, east and north.
    """
    members = _strongest_first(links, strengths, len(centers), NEIGHBORHOOD_SIZES[-1])
    found: LocalGeoreferences | None = None
    for size in NEIGHBORHOOD_SIZES:
        tried = _fit(members, min(size, members.shape[1]), centers, rotations_cam_from_world, ground_m)
        found = tried if found is None else _choose(tried.turn_error < found.turn_error, tried, found)
        if size >= members.shape[1]:
            break
    assert found is not None
    return _extend_to_unknown(found, centers, ground_m)


def find_contradictions(
    fits: LocalGeoreferences,
    pairs: Int64[np.ndarray, "p 2"],
    centers: Float64[np.ndarray, "n 3"],
    ground_m: Float64[np.ndarray, "n 2"],
) -> tuple[Bool[np.ndarray, " p"], Bool[np.ndarray, " p"]]:
    """Return for pairs whether their neighborhoods are turned against each other, and whether displaced."""
    a, b = pairs.T
    is_known = fits.is_known[a] & fits.is_known[b]
    is_turned = is_known & (rotation_angles(fits.rotation[a], fits.rotation[b]) > MAX_TURN)
    off_m = np.minimum(
        np.linalg.norm(fits.predict_m(a, centers[b]) - ground_m[b], axis=1),
        np.linalg.norm(fits.predict_m(b, centers[a]) - ground_m[a], axis=1),
    )
    limit_m = np.maximum.reduce(
        [
            np.full(len(pairs), MAX_DISPLACEMENT_M),
            _MIN_DISPLACEMENT_ERRORS * (fits.error_m[a] + fits.error_m[b]),
            _MIN_DISPLACEMENT_SHARE * np.linalg.norm(ground_m[a] - ground_m[b], axis=1),
        ]
    )
    return is_turned, is_known & ~is_turned & (off_m > limit_m)


def rotation_angles(
    first: Float64[np.ndarray, "p 3 3"], second: Float64[np.ndarray, "p 3 3"]
) -> Float64[np.ndarray, " p"]:
    """Return the angles between rotations, in radians."""
    return np.asarray(np.arccos(np.clip((np.einsum("pij,pij->p", first, second) - 1) / 2, -1, 1)))


def _strongest_first(
    links: Int64[np.ndarray, "p 2"], strengths: Int64[np.ndarray, " p"], count: int, size: int
) -> Int64[np.ndarray, "n k"]:
    """Return each photograph and those that its neighborhood grows by, each time along the strongest link.

    This is Prim's algorithm, which only takes links of the maximum spanning tree.
    """
    is_link = strengths > 0
    a, b = links[is_link].T
    lengths = coo_array((1.0 / strengths[is_link], (a, b)), shape=(count, count))
    tree = minimum_spanning_tree(lengths.tocsr()).tocoo()
    edges: list[list[tuple[float, int]]] = [[] for _ in range(count)]
    for length, first, second in zip(tree.data.tolist(), tree.row.tolist(), tree.col.tolist(), strict=True):
        edges[first].append((length, second))
        edges[second].append((length, first))
    members = np.full((count, min(size, count)), -1, dtype=np.int64)
    for photograph in range(count):
        reachable, seen = [(0.0, photograph)], {photograph}
        for place in range(members.shape[1]):
            if not reachable:
                break
            _, reached = heapq.heappop(reachable)
            members[photograph, place] = reached
            for edge in edges[reached]:
                if edge[1] not in seen:
                    seen.add(edge[1])
                    heapq.heappush(reachable, edge)
    return members


def _fit(
    members: Int64[np.ndarray, "n k"],
    size: int,
    centers: Float64[np.ndarray, "n 3"],
    rotations_cam_from_world: Float64[np.ndarray, "n 3 3"],
    ground_m: Float64[np.ndarray, "n 2"],
) -> LocalGeoreferences:
    """Fit the neighborhoods of one size by least squares.

    Up is what it is to the cameras, so that a straight walk suffices for the turn.
    """
    near = members[:, :size]
    is_member = near >= 0
    count = is_member.sum(axis=1)
    weight = is_member / count[:, None]
    up = np.stack([estimate_up(rotations_cam_from_world[row[row >= 0]]) for row in near])
    upright = -np.einsum("nk,nki,ni->n", weight, rotations_cam_from_world[near, 1], up)
    level = _level_axes(up)
    middle = np.einsum("nk,nki->ni", weight, centers[near])
    middle_m = np.einsum("nk,nki->ni", weight, ground_m[near])
    # in the plane, a turn and a scale are the product with a complex number
    source = _as_complex(np.einsum("nij,nkj->nki", level, centers[near] - middle[:, None]))
    target = _as_complex(ground_m[near] - middle_m[:, None])
    tiny = np.finfo(np.float64).tiny
    product = (weight * source.conj() * target).sum(axis=1)
    factor = product / np.maximum((weight * np.abs(source) ** 2).sum(axis=1), tiny)
    error_m = np.sqrt((weight * np.abs(target - factor[:, None] * source) ** 2).sum(axis=1))
    spread_m = np.sqrt((weight * np.abs(target) ** 2).sum(axis=1))
    fixes = np.unique(ground_m, axis=0, return_inverse=True)[1].reshape(-1)
    sorted_fixes = np.sort(np.where(is_member, fixes[near], fixes[near[:, :1]]), axis=1)
    fix_count = 1 + (np.diff(sorted_fixes, axis=1) > 0).sum(axis=1)
    turn_error = (error_m + DRIFT_M) / np.maximum(spread_m, tiny)
    is_known = (
        (spread_m >= MIN_SPREAD_M)
        & (error_m <= MAX_RELATIVE_ERROR * spread_m)
        & (fix_count >= MIN_FIXES)
        & (upright >= MIN_UPRIGHT)
    )
    turn = np.angle(factor)
    cos, sin = np.cos(turn)[:, None], np.sin(turn)[:, None]
    return LocalGeoreferences(
        np.stack([cos * level[:, 0] - sin * level[:, 1], sin * level[:, 0] + cos * level[:, 1], up], axis=1),
        np.abs(factor),
        middle,
        middle_m,
        error_m,
        np.where(is_known, turn_error, np.inf),
        count,
        members,
    )


def _level_axes(up: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 2 3"]:
    """Return two directions across up for each, such that the second is a quarter turn on from the first."""
    side = np.eye(3)[np.argmin(np.abs(up), axis=1)]
    first = side - (side * up).sum(axis=1, keepdims=True) * up
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(up, first)], axis=1)


def _as_complex(plane: Float64[np.ndarray, "n k 2"]) -> Complex128[np.ndarray, "n k"]:
    return np.asarray(plane[..., 0] + 1j * plane[..., 1])


def _choose(
    is_first: Bool[np.ndarray, " n"], first: LocalGeoreferences, second: LocalGeoreferences
) -> LocalGeoreferences:
    """Return the similarities of ``first`` for some photographs, and those of ``second`` for the others."""
    chosen: dict[str, Any] = {}
    for field in fields(LocalGeoreferences):
        one, other = getattr(first, field.name), getattr(second, field.name)
        chosen[field.name] = np.where(is_first.reshape(-1, *[1] * (one.ndim - 1)), one, other)
    return LocalGeoreferences(**chosen)


def _extend_to_unknown(
    fits: LocalGeoreferences, centers: Float64[np.ndarray, "n 3"], ground_m: Float64[np.ndarray, "n 2"]
) -> LocalGeoreferences:
    """Give photographs without a known similarity that of the nearest one by links which has it and fits."""
    near = fits.members[:, : NEIGHBORHOOD_SIZES[0]]
    has_known = (near >= 0) & fits.is_known[near]
    source = near[np.arange(len(near)), np.argmax(has_known, axis=1)]
    off_m = np.linalg.norm(fits.predict_m(source, centers) - ground_m, axis=1)
    is_lent = ~fits.is_known & has_known.any(axis=1) & (off_m <= _MAX_ERRORS_OF_LENT * fits.error_m[source])
    lent = LocalGeoreferences(**{field.name: getattr(fits, field.name)[source] for field in fields(fits)})
    return _choose(is_lent, replace(lent, size=fits.size, members=fits.members), fits)

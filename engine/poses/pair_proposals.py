"""Proposals of pairs for the quick look in large captures, where all pairs would be too many.

By GPS where the photographs have it, else by a vocabulary of the capture's own features, both by COLMAP
("A Vote-and-Verify Strategy for Fast Spatial Verification in Image Retrieval", Schönberger et al., ACCV
2016, describes its index); neighbors by name always. The quick look decides.
"""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from octasplat.engine.core.colmap_binding import pycolmap
from octasplat.engine.poses.config import PROPOSALS_PER_PHOTOGRAPH
from octasplat.engine.poses.pairs import Pair, neighbor_pairs
from octasplat.engine.poses.vocabulary import alike_by_vocabulary

NEIGHBORS_BY_NAME = 10
MIN_GPS_SHARE = 0.9
"""Share of the photographs that must have GPS for it to propose alone."""
MAX_DISTANCE_M = 1e6
"""Only the number of the nearest counts."""


def propose_pairs(database: Path, small: Path, count: int, *, seed: int, threads: int) -> list[Pair]:
    """Return pairs of photographs that may be alike, the lower index first, in order.

    Args:
        database: with the photographs, and with their GPS if they have any.
        small: the same photographs with their largest features only.
        count: photographs in all.
        seed: of the vocabulary.
        threads: to use for GPS; -1 means all cores.
    """
    found = neighbor_pairs(count, NEIGHBORS_BY_NAME)
    without = list(range(1, count + 1))
    with pycolmap.Database.open(database) as photographs:
        located = gps_positions_m(photographs)
        if len(located) >= MIN_GPS_SHARE * count:
            found |= _nearest_by_gps(photographs, threads)
            without = [number for number in without if number not in located]
    if without:
        for number, alike in alike_by_vocabulary(small, count, without, PROPOSALS_PER_PHOTOGRAPH, seed=seed):
            found |= {(min(number, other) - 1, max(number, other) - 1) for other in alike}
    return sorted(found)


def gps_positions_m(photographs: "pycolmap.Database") -> dict[int, Float64[np.ndarray, "3"]]:
    """Return the places on the ground of the photographs that have GPS, by their numbers.

    They are from the middle of the earth, at an altitude of zero, as altitudes are far less sure. A latitude
    and longitude of zero are what cameras write that know no place.
    """
    known = {
        prior.corr_data_id.id: np.array([*prior.position[:2], 0.0])
        for prior in photographs.read_all_pose_priors()
        if prior.has_position()
        and prior.coordinate_system == pycolmap.PosePriorCoordinateSystem.WGS84
        and np.any(prior.position[:2] != 0)
    }
    if not known:
        return {}
    places_m = pycolmap.GPSTransform().ellipsoid_to_ecef(np.stack([known[number] for number in known]))
    return dict(zip(known, np.asarray(places_m), strict=True))


def _nearest_by_gps(photographs: "pycolmap.Database", threads: int) -> set[Pair]:
    options = pycolmap.SpatialPairingOptions()
    options.max_num_neighbors = PROPOSALS_PER_PHOTOGRAPH
    options.max_distance = MAX_DISTANCE_M
    options.num_threads = threads
    return _as_pairs(pycolmap.SpatialPairGenerator(options, photographs).all_pairs())


def _as_pairs(numbers: Iterable[tuple[int, int]]) -> set[Pair]:
    """Return pairs of the database's numbers as indices, the lower first, without those of one photograph."""
    return {(min(a, b) - 1, max(a, b) - 1) for a, b in numbers if a != b}

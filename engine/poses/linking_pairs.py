"""Pairs that may link photographs of a large capture that were left out to those that have poses.

A part of a capture that stays apart is most alike to itself, so that proposals for the quick look seldom lead
out of it. Here only photographs that have poses are proposed: the nearest by GPS where a photograph has it,
else those that look most alike by the vocabulary of the capture.
"""

from collections.abc import Collection, Sequence
from itertools import islice
from pathlib import Path

import numpy as np
import pycolmap

from octasplat.engine.poses.config import PRESELECTION_FEATURES
from octasplat.engine.poses.features import copy_largest_features
from octasplat.engine.poses.pair_proposals import alike_by_vocabulary, gps_positions_m
from octasplat.engine.poses.pairs import Pair

LINKS_PER_PHOTOGRAPH = 30
"""Photographs with poses that one without is matched with."""
NEIGHBORS_BY_NAME = 15
"""Photographs on either side by name that it is matched with besides, with poses or not."""


def propose_links(
    database: Path, rest: Sequence[int], posed: Collection[int], excluded: Collection[Pair], *, seed: int
) -> list[Pair]:
    """Return pairs of a photograph left out and one that has a pose, the lower index first, in order.

    Args:
        database: with features; is only read.
        rest: photographs left out.
        posed: all others.
        excluded: pairs that were matched already.
        seed: of the vocabulary.
    """
    if not posed:
        return []
    tried = set(excluded)
    found: set[Pair] = set()
    with pycolmap.Database.open(database) as photographs:
        places_m = gps_positions_m(photographs)
    by_look = [k for k in rest if k + 1 not in places_m]
    located = np.array(sorted(k for k in posed if k + 1 in places_m), np.int64)
    if len(located) == 0:
        by_look = list(rest)
    located_m = np.array([places_m[k + 1] for k in located.tolist()])
    for k in sorted(set(rest) - set(by_look)):
        away_m = np.linalg.norm(located_m - places_m[k + 1], axis=1)
        nearest = located[np.argsort(away_m, kind="stable")].tolist()
        found |= _first_pairs(k, nearest, tried)
    if by_look:
        count = len(rest) + len(posed)
        small = database.with_name("links.db")
        small.unlink(missing_ok=True)
        copy_largest_features(database, small, count, PRESELECTION_FEATURES)
        numbers = [k + 1 for k in by_look]
        for number, alike in alike_by_vocabulary(small, count, numbers, count, seed=seed):
            found |= _first_pairs(number - 1, [a - 1 for a in alike if a - 1 in posed], tried)
        small.unlink()
    return sorted(found)


def _first_pairs(k: int, others: Sequence[int], tried: Collection[Pair]) -> set[Pair]:
    """Return pairs of a photograph with the first of others that it was not matched with."""
    pairs = ((min(k, other), max(k, other)) for other in others)
    return set(islice((pair for pair in pairs if pair not in tried), LINKS_PER_PHOTOGRAPH))

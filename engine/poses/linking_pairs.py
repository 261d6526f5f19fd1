"""Pairs that may link photographs of a large capture that were left out to those of its models.

A part of a capture that stays apart is most alike to itself, so that proposals for the quick look seldom lead
out of it. Here only photographs that have poses are proposed: the nearest by GPS where a photograph has it,
else those that look most alike by the vocabulary of the capture. Photographs of other models are as many as
half of the capture, so that a quick look decides which of their pairs are matched.
"""

from collections.abc import Collection, Sequence
from itertools import islice
from pathlib import Path

import numpy as np

from octasplat.engine.core.colmap_binding import pycolmap
from octasplat.engine.poses.config import PRESELECTION_FEATURES, PRESELECTION_MATCHES, PosesConfig
from octasplat.engine.poses.features import copy_largest_features, look_at_pairs, match_pairs
from octasplat.engine.poses.pair_proposals import gps_positions_m
from octasplat.engine.poses.pairs import Pair, pairs_with
from octasplat.engine.poses.vocabulary import alike_by_vocabulary

LINKS_PER_PHOTOGRAPH = 30
"""Photographs with poses that one without is matched with."""
MAX_LINKS = 500
"""Pairs of photographs of two models that are matched, those that look most alike."""
MIN_LINK_INLIERS = 100
"""Matches by which a pair links two models: two that are right are better than one that is folded. Of 2,600
pairs of a street whose sides look alike, 85 have 30 false matches and more, and none has 60."""
NEIGHBORS_BY_NAME = 15
"""Photographs on either side by name that it is matched with besides, with poses or not."""


def propose_links(
    database: Path,
    count: int,
    rest: Sequence[int],
    posed: Collection[int],
    excluded: Collection[Pair],
    *,
    seed: int,
) -> list[Pair]:
    """Return pairs of a photograph left out and one that has a pose, the lower index first, in order.

    Args:
        database: with features; is only read.
        count: photographs in all.
        rest: those to be linked.
        posed: those that have poses.
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


def match_remaining(
    database: Path,
    names: Sequence[str],
    rest: Sequence[int],
    posed: Collection[int],
    matched: Collection[Pair],
    config: PosesConfig,
    *,
    threads: int,
) -> None:
    """Match photographs of no model with all others, and take matches that are less clear.

    In a large capture the others are those near by name, and those of any model that are near by GPS or look
    most alike.

    Args:
        database: with features; gets the matches.
        names: of all photographs, as they are numbered.
        rest: indices of those of no model.
        posed: of those of the models that are kept.
        matched: pairs that were matched already.
        config: settings.
        threads: to use; -1 means all cores.
    """
    if config.is_large(len(names)):
        near = pairs_with(rest, len(names), matched, within=NEIGHBORS_BY_NAME)
        pairs = sorted({*near, *propose_links(database, len(names), rest, posed, matched, seed=config.seed)})
    else:
        pairs = pairs_with(rest, len(names), matched)
    match_pairs(database, names, pairs, config, thorough=True, threads=threads, on_count=lambda _done: None)


def match_links(
    database: Path,
    names: Sequence[str],
    pairs: Sequence[Pair],
    config: PosesConfig,
    *,
    threads: int,
    min_inliers: int = MIN_LINK_INLIERS,
) -> bool:
    """Match those pairs of photographs of two models that a quick look finds most alike.

    Args:
        database: with features; gets the matches.
        names: of the photographs, as they are numbered.
        pairs: indices into ``names``.
        config: settings.
        threads: to use; -1 means all cores.
        min_inliers: matches of one geometry by which a pair links the models.

    Returns:
        Whether any of the pairs has so many.
    """
    small = database.with_name("links.db")
    small.unlink(missing_ok=True)
    copy_largest_features(database, small, len(names), PRESELECTION_FEATURES)
    looked = look_at_pairs(small, names, pairs, threads=threads)
    small.unlink()
    alike = [pair for pair in sorted(looked) if looked[pair] >= PRESELECTION_MATCHES]
    best = sorted(alike, key=lambda pair: -looked[pair])[:MAX_LINKS]
    match_pairs(database, names, best, config, thorough=False, threads=threads, on_count=lambda _done: None)
    with pycolmap.Database.open(database) as matched:
        return any(
            len(matched.read_two_view_geometry(a + 1, b + 1).inlier_matches) >= min_inliers for a, b in best
        )

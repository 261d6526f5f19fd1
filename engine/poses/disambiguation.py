"""Models rebuilt without the false pairs of photographs that have joined parts of them wrongly."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int64

from octasplat.engine.poses.ambiguous_structure import count_pair_inliers, find_false_pairs, remove_pairs
from octasplat.engine.poses.config import SEPARATE_PARTS_FROM
from octasplat.engine.poses.global_positioning import position_photographs
from octasplat.engine.poses.gps_contradictions import (
    GroundPositions,
    find_gps_contradictions,
    find_outliers_against_gps,
    find_turned_pairs,
    gps_error_m,
)
from octasplat.engine.poses.incremental_mapping import best_rank
from octasplat.engine.poses.model_selection import distinct_models, photograph_indices
from octasplat.engine.poses.whole_files import copy_database

MapPhotographs = Callable[[Path], list[Any]]
"""Returns the models that the matches of a database come to, that of most photographs first."""

MAX_ERROR_SHARE_OF_BETTER = 0.7
"""Of their distance from GPS, that of the photographs concerned is no more in a model that agrees better."""
MIN_PLACED_SHARE = 0.75
"""Of the photographs that had poses, those that have one in the models that agree better."""
_MAX_DISAMBIGUATIONS = 3
_MAX_POSITIONINGS = 6
"""Rough poses of all photographs before these are mapped; the last ones find no more pairs as a rule."""


@dataclass(frozen=True)
class MappedModels:
    """What a mapping came to.

    Attributes:
        models: ``pycolmap.Reconstruction`` each, that of most photographs first.
        left_out_pairs: how many pairs that contradict GPS were left out.
        gps_error_m: of photographs that still contradict GPS; None where none do.
    """

    models: list[Any]
    left_out_pairs: int = 0
    gps_error_m: float | None = None

    def placed(self, photographs: int) -> int:
        """Return how many of so many photographs have poses.

        In a large capture, and where they were unfolded, those of all models count that are kept.
        """
        if self.left_out_pairs or photographs >= SEPARATE_PARTS_FROM:
            return len(photograph_indices(distinct_models(self.models)))
        return best_rank(self.models)[0]


def disambiguate(
    models: list[Any], database: Path, ground_m: GroundPositions, map_again: MapPhotographs
) -> MappedModels:
    """Return the models without the false pairs that GPS contradicts, and those that true ones contradict.

    Args:
        models: that the database has come to.
        database: loses the false pairs.
        ground_m: by GPS.
        map_again: maps a copy of the database.
    """
    mapped = leave_out_pairs_against_gps(MappedModels(models), database, ground_m, map_again)
    models = leave_out_conflicting_pairs(mapped.models, database, ground_m, map_again)
    if models is mapped.models:
        return mapped
    return leave_out_pairs_against_gps(replace(mapped, models=models), database, ground_m, map_again)


def leave_out_conflicting_pairs(
    models: list[Any], database: Path, ground_m: GroundPositions, map_again: MapPhotographs
) -> list[Any]:
    """Return the models without the false matches that true ones contradict, repeated while there are any.

    Where false pairs are more than true ones, the true ones look false in a model that is right. GPS tells
    them apart. The arguments are those of :func:`disambiguate`.
    """
    for _ in range(_MAX_DISAMBIGUATIONS):
        if not models:
            break
        votes = count_pair_inliers(models[:1], database)
        false = find_false_pairs(votes)
        if len(false) and ground_m:
            outliers = find_outliers_against_gps(models[0], votes, database, ground_m)
            remove_pairs(database, outliers)
            false = find_false_pairs(count_pair_inliers(models[:1], database))
        if len(false) == 0:
            break
        trial = _copy_without(database, false)
        again = map_again(trial)
        if not _explains_more(again, trial, models, database):
            break
        if ground_m and (
            find_gps_contradictions(again, trial, ground_m).folded
            and not find_gps_contradictions(models, database, ground_m).folded
        ):
            break
        trial.replace(database)
        models = again
    return models


def leave_out_pairs_before_mapping(database: Path, ground_m: GroundPositions, seed: int) -> int:
    """Remove the false pairs that rough poses and GPS contradict, and return how many they were.

    Args:
        database: loses the false pairs.
        ground_m: by GPS.
        seed: of everything random.
    """
    removed = 0
    for _ in range(_MAX_POSITIONINGS if ground_m else 0):
        model = position_photographs(database, seed)
        if model is None or not len(pairs := find_turned_pairs(model, database, ground_m)):
            break
        remove_pairs(database, pairs)  # which may have held back others
        removed += len(pairs)
    return removed


def leave_out_pairs_against_gps(
    mapped: MappedModels, database: Path, ground_m: GroundPositions, map_again: MapPhotographs
) -> MappedModels:
    """Return the models without the false matches that GPS contradicts, repeated while there are any.

    The models that come of it are taken if they agree clearly better with GPS. They may be several where one
    was before: parts that are right each beat a whole that is folded.

    Args:
        mapped: that the database has come to.
        database: loses the false pairs.
        ground_m: by GPS.
        map_again: maps a copy of the database.
    """
    for attempt in range(_MAX_DISAMBIGUATIONS + 1):
        found = find_gps_contradictions(mapped.models, database, ground_m)
        if not found.folded:
            return replace(mapped, gps_error_m=None)
        error_m = gps_error_m(mapped.models, found.folded, ground_m)
        if attempt == _MAX_DISAMBIGUATIONS:
            break
        trial = _copy_without(database, found.pairs)
        again = map_again(trial)
        again_m = gps_error_m(again, found.folded, ground_m)
        agrees_better = again_m <= MAX_ERROR_SHARE_OF_BETTER * error_m and (
            len(photograph_indices(distinct_models(again)))
            >= MIN_PLACED_SHARE * len(photograph_indices(distinct_models(mapped.models)))
        )
        if not agrees_better and not (
            again_m < error_m and _explains_more(again, trial, mapped.models, database)
        ):
            break
        trial.replace(database)
        mapped = MappedModels(again, mapped.left_out_pairs + len(found.pairs))
    return replace(mapped, gps_error_m=error_m)


def register_without_pairs_against_gps(
    mapped: MappedModels, database: Path, ground_m: GroundPositions, map_again: MapPhotographs
) -> MappedModels:
    """Return what goes on from a model, with more photographs; the same if that has none, or is folded.

    Args:
        mapped: with the model to go on from.
        database: with more matches; loses those that would join photographs which GPS puts elsewhere.
        ground_m: by GPS.
        map_again: goes on from that model with the matches of a database.
    """
    found = find_gps_contradictions(mapped.models, database, ground_m)
    if len(found.pairs) and not found.folded:
        remove_pairs(database, found.pairs)
    # max keeps the first of equals
    models = max(mapped.models, map_again(database), key=_rank_with_others)
    if models is mapped.models or mapped.gps_error_m is not None:
        return replace(mapped, models=models)
    if find_gps_contradictions(models, database, ground_m).folded:
        return mapped
    return replace(mapped, models=models)


def _rank_with_others(models: Sequence[Any]) -> tuple[int, int, int]:
    """Return the sort key of what goes on from a model: its photographs, those of all models, and its points.

    Photographs that join no model may make one of their own.
    """
    photographs, points = best_rank(models)
    return photographs, len(photograph_indices(distinct_models(models))), points


def describe_gps_contradictions(mapped: MappedModels) -> list[str]:
    """Return what a user is told of models that were folded, or still are."""
    sentences = []
    if mapped.left_out_pairs:
        sentences.append(
            f"The model was folded: {mapped.left_out_pairs} false pairs of photographs that contradict their "
            "GPS were left out."
        )
    if mapped.gps_error_m is not None:
        sentences.append(
            "By the GPS of their photographs, parts of the model are turned or displaced against each other "
            f"(photographs there are {mapped.gps_error_m:.1f} m off), as where places that look alike are "
            "taken for one, or where GPS was far off: look at the poses before a long training, and take "
            "more photographs that show both parts."
        )
    return sentences


def _copy_without(database: Path, pairs: Int64[np.ndarray, "f 2"]) -> Path:
    """Return a copy of a database without some pairs, which come back if the trial is no better."""
    trial = copy_database(database, database.with_name("trial.db"))
    remove_pairs(trial, pairs)
    return trial


def _explains_more(again: Sequence[Any], trial: Path, models: Sequence[Any], database: Path) -> bool:
    """Return whether new models lose no photograph, and more matches are points of the first one."""
    if best_rank(again)[0] < best_rank(models)[0]:
        return False
    inliers = [
        count_pair_inliers(each[:1], of).inliers.sum() for each, of in ((again, trial), (models, database))
    ]
    # fewer matches explained: the cut was no fold
    return bool(inliers[0] > inliers[1])

"""Photographs that the largest model of a capture leaves out, registered with more matches.

Those of another model link it to the largest one where a pair holds surely. Those of no model join whichever
they have the clearest matches with; of no kept model are also those of models that are too small or unsure.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pycolmap

from octasplat.engine.poses.config import PosesConfig
from octasplat.engine.poses.disambiguation import MappedModels, register_without_pairs_against_gps
from octasplat.engine.poses.gps_contradictions import GroundPositions
from octasplat.engine.poses.incremental_mapping import Continuation, model_rank, take_out_unsure
from octasplat.engine.poses.linking_pairs import match_links, match_remaining, propose_links
from octasplat.engine.poses.model_selection import distinct_models, photograph_indices
from octasplat.engine.poses.pairs import Pair
from octasplat.engine.poses.whole_files import write_model

_START_FOLDER = "start"


GoOn = Callable[[Path, Continuation], list[Any]]
"""Maps the matches of a database, and returns the models, that of most photographs first."""


@dataclass(frozen=True)
class MatchedCapture:
    """The photographs of a search, matched and to be matched further.

    Attributes:
        database: with features and matches; gets more of them. The model to go on from is written beside it.
        names: of the photographs, as they are numbered.
        matched: pairs that were matched already.
        ground_m: by GPS.
        config: settings.
        go_on: maps the photographs.
        threads: to use; -1 means all cores.
    """

    database: Path
    names: Sequence[str]
    matched: Collection[Pair]
    ground_m: GroundPositions
    config: PosesConfig
    go_on: GoOn
    threads: int

    @property
    def is_large(self) -> bool:
        """Whether several models of it are kept."""
        return self.config.is_large(len(self.names))

    def map_anew(self, mapped: MappedModels, map_copy: Callable[[Path], list[Any]]) -> MappedModels:
        """Return what mapping comes to without pairs that contradict GPS."""
        return register_without_pairs_against_gps(mapped, self.database, self.ground_m, map_copy)


def register_remaining(capture: MatchedCapture, mapped: MappedModels) -> MappedModels:
    """Return the models with more photographs: of a large capture all that are kept, else the largest one.

    Args:
        capture: the photographs.
        mapped: what the matches have come to.
    """
    mapped = _link_models(capture, mapped)
    kept = _kept(mapped, capture.is_large)
    posed = photograph_indices(kept)
    rest = sorted(set(range(len(capture.names))) - posed)
    if not rest:
        return mapped
    match_remaining(
        capture.database, capture.names, rest, posed, capture.matched, capture.config, threads=capture.threads
    )
    mapped = _extend_others(capture, mapped, kept, rest)
    start = _write_start(capture.database, mapped.models)
    apart = _kept(mapped, capture.is_large)[1:]

    def map_weakly(copy: Path) -> list[Any]:
        models = capture.go_on(copy, Continuation(start, allow_weak_links=True, apart=apart))
        for model in models if capture.is_large else []:
            take_out_unsure(model, posed)
        return [*models, *apart]

    mapped = capture.map_anew(mapped, map_weakly)
    # another one may have become the largest
    return replace(mapped, models=sorted(mapped.models, key=model_rank, reverse=True))


def _link_models(capture: MatchedCapture, mapped: MappedModels) -> MappedModels:
    """Continue the largest model of a large capture with the photographs of others that a pair links."""
    database, names, config = capture.database, capture.names, capture.config
    apart = _kept(mapped, capture.is_large)[1:]
    posed = photograph_indices(mapped.models[:1])
    of_others = sorted(photograph_indices(apart) - posed)
    if not of_others:
        return mapped
    links = propose_links(database, len(names), of_others, posed, capture.matched, seed=config.seed)
    if not match_links(database, names, links, config, threads=capture.threads):
        return mapped
    start = _write_start(database, mapped.models)

    def extend(copy: Path) -> list[Any]:
        return [*capture.go_on(copy, Continuation(start, extends_only=True)), *apart]

    return capture.map_anew(mapped, extend)


def _extend_others(
    capture: MatchedCapture, mapped: MappedModels, kept: Sequence[Any], rest: Sequence[int]
) -> MappedModels:
    """Continue each model beside the largest one with the photographs that match it most clearly.

    Args:
        capture: the photographs, with their matches.
        mapped: with all models.
        kept: those of them that are kept, the largest one first.
        rest: indices of the photographs of none of these.
    """
    clearest = _clearest_models(capture.database, kept, rest)
    unsure = [model for model in mapped.models if not any(model is each for each in kept)]
    models = list(kept)
    for place in range(1, len(kept)):
        left_out = [k for k in rest if clearest.get(k) != place]
        if len(left_out) < len(rest):
            others = [model for other, model in enumerate(models) if other != place]
            ordered = replace(mapped, models=[models[place], *others])
            models[place] = _extend_first(capture, ordered, left_out)
    return replace(mapped, models=[*models, *unsure])


def _extend_first(capture: MatchedCapture, mapped: MappedModels, left_out: Collection[int]) -> Any:
    """Return the first model with photographs that are neither in the others nor left out."""
    start, others = _write_start(capture.database, mapped.models), mapped.models[1:]
    posed = photograph_indices(mapped.models[:1])

    def extend(copy: Path) -> list[Any]:
        extended = capture.go_on(copy, Continuation(start, True, others, left_out, extends_only=True))
        for model in extended:
            take_out_unsure(model, posed)
        return [*extended, *others]

    return capture.map_anew(mapped, extend).models[0]


def _clearest_models(database: Path, models: Sequence[Any], photographs: Collection[int]) -> dict[int, int]:
    """Return the places of the models that photographs match most clearly: by that pair with most matches.

    A place that looks alike gives some false matches with many photographs, the true one many with a few.

    Args:
        database: with the matches.
        models: ``pycolmap.Reconstruction`` each; of those that are equal the first one counts.
        photographs: indices of photographs of none of them; those without matches have no place.
    """
    wanted = set(photographs)
    places = {
        index: place
        for place in reversed(range(len(models)))
        for index in photograph_indices(models[place : place + 1])
    }
    with pycolmap.Database.open(database) as source:
        ids, counts = source.read_two_view_geometry_num_inliers()
    best: dict[int, tuple[int, int]] = {}
    for pair_id, matches in zip(ids, counts, strict=True):
        first, second = (number - 1 for number in pycolmap.pair_id_to_image_pair(pair_id))
        for one, other in ((first, second), (second, first)):
            if matches and one in wanted and other in places:
                best[one] = max(best.get(one, (0, 0)), (matches, -places[other]))
    return {index: -place for index, (_, place) in best.items()}


def _kept(mapped: MappedModels, is_large: bool) -> list[Any]:
    """Return the models that stay, the largest one first: of a large capture several."""
    return distinct_models(mapped.models) if is_large else mapped.models[:1]


def _write_start(database: Path, models: Sequence[Any]) -> Path | None:
    """Write the first model, for a mapping to go on from, and return its folder."""
    if not models:
        return None
    start = database.with_name(_START_FOLDER)
    write_model(models[0], start)
    return start

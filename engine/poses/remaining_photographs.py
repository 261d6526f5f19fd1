"""Photographs that the largest model of a capture leaves out, registered with more matches.

Those of another model link it to the largest one where a pair holds surely. Those of no model join whichever
they have the clearest matches with, or where that does not take them the next one. Of no kept model are also
those of models that are too small or unsure.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from octasplat.engine.core.colmap_binding import pycolmap
from octasplat.engine.poses.config import PosesConfig
from octasplat.engine.poses.disambiguation import MappedModels, register_without_pairs_against_gps
from octasplat.engine.poses.gps_contradictions import GroundPositions
from octasplat.engine.poses.incremental_mapping import (
    MIN_SEEN_POINTS,
    Continuation,
    model_rank,
    take_out_unsure,
)
from octasplat.engine.poses.linking_pairs import match_links, match_remaining, propose_links
from octasplat.engine.poses.model_selection import distinct_models, photograph_indices
from octasplat.engine.poses.pairs import Pair
from octasplat.engine.poses.whole_files import write_model

_START_FOLDER = "start"
MAX_FURTHER_MODELS = 2
"""Models beside that of the clearest match, and the largest one, that a photograph is tried in."""

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
    attempts = _Attempts(capture, kept)
    attempts.extend_models(mapped, rest)
    unsure = [model for model in mapped.models if not _has(kept, model)]
    mapped = replace(mapped, models=[*attempts.models.values(), *unsure])
    start = _write_start(capture.database, mapped.models)
    apart = _kept(mapped, capture.is_large)[1:]

    def map_weakly(copy: Path) -> list[Any]:
        models = capture.go_on(copy, Continuation(start, allow_weak_links=True, apart=apart))
        for model in models if capture.is_large else []:
            take_out_unsure(model, posed)
        return [*models, *apart]

    mapped = capture.map_anew(mapped, map_weakly)
    if capture.is_large:
        mapped = _try_further_models(capture, mapped, attempts)
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


class _Attempts:
    """Tries photographs of no model in the models that they match, each of them in each model once.

    Args:
        capture: the photographs, with their matches.
        kept: the models that are kept, the largest one first.

    Attributes:
        models: the same by their places, with the photographs that they were continued with.
    """

    def __init__(self, capture: MatchedCapture, kept: Sequence[Any]) -> None:
        self._capture = capture
        self.models = dict(enumerate(kept))
        self._tried: set[tuple[int, int]] = set()

    def extend_models(
        self, mapped: MappedModels, rest: Sequence[int], beside: Sequence[Any] = (), *, least_matches: int = 1
    ) -> bool:
        """Continue each model but the largest one with those that match it most clearly and are new to it.

        Args:
            mapped: says whether GPS contradicts the models.
            rest: indices of the photographs.
            beside: further models, whose photographs stay there.
            least_matches: with all photographs of a model, for one to be tried in it.

        Returns:
            Whether there was any model to try.
        """
        wanted: dict[int, list[int]] = {}
        database = self._capture.database
        for index, places in _models_by_match(database, self.models, rest, least_matches).items():
            untried = [place for place in places if (index, place) not in self._tried]
            if untried:
                self._tried.add((index, untried[0]))
                wanted.setdefault(untried[0], []).append(index)
        for place in sorted(wanted.keys() - {0}):  # whatever is left is tried in the largest one
            others = [*beside, *(model for other, model in self.models.items() if other != place)]
            ordered = replace(mapped, models=[self.models[place], *others])
            left_out = sorted(set(rest) - set(wanted[place]))
            self.models[place] = _extend_first(self._capture, ordered, left_out)
        return bool(wanted)


def _try_further_models(capture: MatchedCapture, mapped: MappedModels, attempts: _Attempts) -> MappedModels:
    """Try what is still left in the model that it matches next most clearly, some times.

    Its clearest match may be false, as of a place that looks alike. And models have grown meanwhile, so that
    they may show what matched none of their photographs before. All of it was tried in the largest model.
    """
    for _ in range(MAX_FURTHER_MODELS):
        kept = _kept(mapped, is_large=True)
        rest = sorted(set(range(len(capture.names))) - photograph_indices(kept))
        before = {place: model for place, model in attempts.models.items() if place and _has(kept, model)}
        attempts.models = dict(before)
        beside = [model for model in kept if not _has(before.values(), model)]
        if not attempts.extend_models(mapped, rest, beside, least_matches=MIN_SEEN_POINTS):
            break
        new = {id(model): attempts.models[place] for place, model in before.items()}
        mapped = replace(mapped, models=[new.get(id(model), model) for model in mapped.models])
    return mapped


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


def _models_by_match(
    database: Path, models: Mapping[int, Any], photographs: Collection[int], least: int
) -> dict[int, list[int]]:
    """Return the places of the models that photographs match, by that pair with most matches, the most first.

    A place that looks alike gives some false matches with many photographs, the true one many with a few.

    Args:
        database: with the matches.
        models: ``pycolmap.Reconstruction`` each, by places; of equal matches those with the first one count.
        photographs: indices of photographs of none of them; those without matches are left out.
        least: matches with all photographs of a model for it to count.
    """
    wanted = set(photographs)
    places: dict[int, int] = {}
    for place in sorted(models, reverse=True):
        places |= dict.fromkeys(photograph_indices([models[place]]), place)
    with pycolmap.Database.open(database) as source:
        ids, counts = source.read_two_view_geometry_num_inliers()
    of_pairs: dict[int, dict[int, list[int]]] = {}
    for pair_id, matches in zip(ids, counts, strict=True):
        first, second = (number - 1 for number in pycolmap.pair_id_to_image_pair(pair_id))
        for one, other in ((first, second), (second, first)):
            if matches and one in wanted and other in places:
                of_pairs.setdefault(one, {}).setdefault(places[other], []).append(matches)
    order = {}
    for index, found in sorted(of_pairs.items()):
        ranked = sorted((-max(matches), place) for place, matches in found.items() if sum(matches) >= least)
        order[index] = [place for _, place in ranked]
    return order


def _has(models: Collection[Any], model: Any) -> bool:
    """Return whether a model itself, not an equal one, is among some."""
    return any(model is each for each in models)


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

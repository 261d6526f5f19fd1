"""Photographs that the largest model of a large capture leaves out: of other models, and of none."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from octasplat.engine.poses import search as module
from octasplat.engine.poses.config import PosesConfig
from octasplat.engine.poses.disambiguation import MappedModels
from octasplat.engine.poses.search import PoseSearch

COUNT = 20
LARGE = PosesConfig(exhaustive_up_to=6, quick_look_up_to=10)


@dataclass(frozen=True)
class StubModel:
    """What the search asks a model for."""

    images: tuple[int, ...]
    points: int = 500

    def reg_image_ids(self) -> tuple[int, ...]:
        return self.images

    def num_reg_images(self) -> int:
        return len(self.images)

    def num_points3D(self) -> int:  # noqa: N802 - COLMAP's name
        return self.points

    def compute_mean_reprojection_error(self) -> float:
        return 0.7


LARGEST = StubModel(tuple(range(1, 11)))
OTHER = StubModel((10, 11, 12, 13, 14))
DOUBTFUL = StubModel((15, 16, 17), points=10)
SHARED = StubModel((8, 9, 10, 18))


def register(
    monkeypatch: pytest.MonkeyPatch, extended: StubModel | None
) -> tuple[list[StubModel], dict[str, list[int]], list[tuple[StubModel, ...]]]:
    """Register what is left; return the models, what is linked and matched, and what is not mapped again."""
    asked: dict[str, list[int]] = {}
    apart: list[tuple[StubModel, ...]] = []
    search = PoseSearch.__new__(PoseSearch)
    search._config, search._names, search._aliases = LARGE, ("",) * COUNT, ("",) * COUNT
    search._threads, search._work = 1, Path()

    def propose(_database: Path, _count: int, rest: Sequence[int], *_more: Any, **_named: Any) -> list[Any]:
        asked["linked"] = list(rest)
        return []

    def match(
        _database: Path, _names: Sequence[str], rest: Sequence[int], *_more: Any, **_named: Any
    ) -> None:
        asked["matched"] = list(rest)

    def go_on(_database: Path, _at: Any, *, extends_only: bool = False, **named: Any) -> list[Any]:
        if extends_only:
            return [extended]
        apart.append(tuple(named["apart"]))
        return [LARGEST if extended is None else extended]

    monkeypatch.setattr(module, "propose_links", propose)
    monkeypatch.setattr(module, "match_links", lambda *_given, **_named: extended is not None)
    monkeypatch.setattr(module, "match_remaining", match)
    monkeypatch.setattr(module, "write_model", lambda *_given: None)
    monkeypatch.setattr(search, "_map", go_on)
    before = MappedModels([LARGEST, OTHER, SHARED, DOUBTFUL])
    after = search._register_remaining(Path(), before, [], {}, lambda _count: None)
    return after.models, asked, apart


def test_photographs_of_models_that_are_not_kept_are_matched_like_those_of_none(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    _, asked, apart = register(monkeypatch, None)
    assert asked == {"linked": [10, 11, 12, 13], "matched": [14, 15, 16, 17, 18, 19]}
    assert apart == [(OTHER,)]


def test_rest_of_a_model_that_has_joined_the_largest_one_is_matched_like_photographs_of_none(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    extended = StubModel((*LARGEST.images, 11, 12))
    models, asked, apart = register(monkeypatch, extended)
    assert asked == {"linked": [10, 11, 12, 13], "matched": [12, 13, 14, 15, 16, 17, 18, 19]}
    assert apart == [()] and models[0] == extended

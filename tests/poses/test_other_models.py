"""Photographs that the largest model of a large capture leaves out: of other models, and of none."""

import shutil
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest

from octasplat.engine.poses import linking_pairs, vocabulary
from octasplat.engine.poses import remaining_photographs as module
from octasplat.engine.poses.ambiguous_structure import remove_pairs
from octasplat.engine.poses.config import PosesConfig
from octasplat.engine.poses.disambiguation import MappedModels
from octasplat.engine.poses.features import photographs_of
from octasplat.engine.poses.incremental_mapping import FROM_THE_BEGINNING, Continuation, map_in_segments
from octasplat.engine.poses.remaining_photographs import MatchedCapture, register_remaining
from octasplat.engine.poses.stored_mappings import StoredMapping, matches_digest

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

    def propose(_database: Path, _count: int, rest: Sequence[int], *_more: Any, **_named: Any) -> list[Any]:
        asked["linked"] = list(rest)
        return []

    def match(
        _database: Path,
        _names: Sequence[str],
        rest: Sequence[int],
        posed: set[int],
        *_more: Any,
        **_named: Any,
    ) -> None:
        asked["matched"], asked["with"] = list(rest), sorted(posed)

    def go_on(_database: Path, continuation: Continuation) -> list[Any]:
        if continuation.extends_only:
            return [extended]
        apart.append(tuple(continuation.apart))
        return [LARGEST if extended is None else extended]

    monkeypatch.setattr(module, "propose_links", propose)
    monkeypatch.setattr(module, "match_links", lambda *_given, **_named: extended is not None)
    monkeypatch.setattr(module, "match_remaining", match)
    monkeypatch.setattr(module, "write_model", lambda *_given: None)
    monkeypatch.setattr(module, "_models_by_match", lambda *_given: {})
    before = MappedModels([LARGEST, OTHER, SHARED, DOUBTFUL])
    capture = MatchedCapture(Path("mapping.db"), ("",) * COUNT, [], {}, LARGE, go_on, threads=1)
    after = register_remaining(capture, before)
    return after.models, asked, apart


def test_photographs_of_models_that_are_not_kept_are_matched_like_those_of_none(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    _, asked, apart = register(monkeypatch, None)
    assert asked == {
        "linked": [10, 11, 12, 13], "matched": [14, 15, 16, 17, 18, 19], "with": list(range(14))
    }  # fmt: skip
    assert apart == [(OTHER,)]


def test_rest_of_a_model_that_has_joined_the_largest_one_is_matched_like_photographs_of_none(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    extended = StubModel((*LARGEST.images, 11, 12))
    models, asked, apart = register(monkeypatch, extended)
    assert asked == {
        "linked": [10, 11, 12, 13], "matched": list(range(12, 20)), "with": list(range(12))
    }  # fmt: skip
    assert apart == [()] and models[0] == extended


FIRST, SECOND = 14, 10
"""Photographs of two places that nothing links, the last two of each without matches."""
LATE = (FIRST - 2, FIRST - 1, FIRST + SECOND - 2, FIRST + SECOND - 1)


@pytest.fixture(scope="module")
def apart(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a database of two places, with features and matches."""
    path = make_places(tmp_path_factory.mktemp("apart") / "database.db", (FIRST, SECOND))
    leave_without_matches(path, LATE)
    return path


def make_places(path: Path, counts: Sequence[int]) -> Path:
    """Make a database of so many photographs of each of some places, with features and matches."""
    pycolmap.set_random_seed(1)
    with pycolmap.Database.open(path) as database:
        for count in counts:
            options = pycolmap.SyntheticDatasetOptions()
            options.num_rigs = options.num_cameras_per_rig = 1
            options.num_frames_per_rig = count
            options.num_points3D = 300
            pycolmap.synthesize_dataset(options, database)
    return path


def leave_without_matches(path: Path, photographs: Iterable[int]) -> None:
    with pycolmap.Database.open(path) as database:
        others = range(database.num_images())
    pairs = {(min(k, other), max(k, other)) for k in photographs for other in others if k != other}
    remove_pairs(path, np.array(sorted(pairs)) + 1)


def verified_pairs(database: Path) -> int:
    with pycolmap.Database.open(database) as opened:
        return int(opened.num_verified_image_pairs())


def found_models(database: Path, mapped_first: Sequence[int] = (FIRST - 2, SECOND - 2)) -> list[Any]:
    """Map, which comes to models of so many photographs, and register what is left; return the models."""
    names = photographs_of(database)
    mappings: list[Path] = []

    def go_on(copy: Path, continuation: Continuation) -> list[Any]:
        mappings.append(database.with_name(f"mapping_{len(mappings)}"))
        stored = StoredMapping(mappings[-1], matches_digest(copy), lambda _count: None)
        return map_in_segments(copy, stored, seed=0, on_count=lambda _count: None, continuation=continuation)

    mapped = MappedModels(go_on(database, FROM_THE_BEGINNING))
    assert [model.num_reg_images() for model in mapped.models] == [*mapped_first]
    return register_remaining(MatchedCapture(database, names, [], {}, LARGE, go_on, threads=1), mapped).models


def photographs_by_model(models: Sequence[Any]) -> list[list[int]]:
    return [sorted(number - 1 for number in model.reg_image_ids()) for model in models]


@pytest.fixture
def few_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Match few pairs, which takes no time."""
    monkeypatch.setattr(linking_pairs, "MAX_LINKS", 2)
    monkeypatch.setattr(linking_pairs, "LINKS_PER_PHOTOGRAPH", 6)
    monkeypatch.setattr(linking_pairs, "NEIGHBORS_BY_NAME", 2)
    monkeypatch.setattr(vocabulary, "TRAINING_DESCRIPTORS", 2000)


BOTH = [list(range(FIRST)), list(range(FIRST, FIRST + SECOND))]


def test_photographs_of_no_model_join_the_one_that_they_see(
    apart: Path, tmp_path: Path, few_pairs: None
) -> None:
    database = tmp_path / "mapping.db"
    shutil.copyfile(apart, database)
    before = verified_pairs(database)
    assert photographs_by_model(found_models(database)) == BOTH
    assert verified_pairs(database) <= before + 2 + len(LATE) * (6 + 2 * 2)


def match_falsely(database: Path, one: int, other: int, count: int = 300) -> None:
    """Let a photograph match one of another place in more features than it truly matches any."""
    rng = np.random.default_rng(0)
    with pycolmap.Database.open(database) as target:
        features = [target.num_keypoints_for_image(number + 1) for number in (one, other)]
        geometry = pycolmap.TwoViewGeometry()
        geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
        drawn = [rng.permutation(many)[: min(*features, count)] for many in features]
        geometry.inlier_matches = np.stack(drawn, axis=1).astype(np.uint32)
        target.write_two_view_geometry(one + 1, other + 1, geometry)


def test_photograph_whose_clearest_match_is_false_joins_the_model_of_the_next_one(
    apart: Path, tmp_path: Path, few_pairs: None
) -> None:
    database, again = tmp_path / "mapping.db", tmp_path / "again" / "mapping.db"
    again.parent.mkdir()
    for copy in (database, again):
        shutil.copyfile(apart, copy)
        match_falsely(copy, 3, LATE[-1])
    found = found_models(database)
    assert photographs_by_model(found) == BOTH
    # a search that is stopped before the last of these mappings goes on with the others
    mappings = sorted(tmp_path.glob("mapping_*"))
    for folder in mappings[:-1]:
        shutil.copytree(folder, again.parent / folder.name)
    assert model_bytes(found_models(again), tmp_path / "second") == model_bytes(found, tmp_path / "first")


def test_photographs_of_no_model_make_one_of_their_own(tmp_path: Path, few_pairs: None) -> None:
    database = make_places(tmp_path / "mapping.db", (SECOND, 6))
    leave_without_matches(database, range(SECOND, SECOND + 6))
    found = found_models(database, [SECOND])
    assert photographs_by_model(found) == [list(range(SECOND)), list(range(SECOND, SECOND + 6))]


def model_bytes(models: Sequence[Any], folder: Path) -> list[dict[str, bytes]]:
    written = []
    for number, model in enumerate(models):
        own = folder / str(number)
        own.mkdir(parents=True)
        model.write_binary(own)
        written.append({path.name: path.read_bytes() for path in own.iterdir()})
    return written

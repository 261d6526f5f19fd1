"""Mapping in segments: the same models, also where a search was stopped between two of them."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest

from octasplat.engine.core.errors import DiskFullError
from octasplat.engine.poses import incremental_mapping, linking_pairs
from octasplat.engine.poses.ambiguous_structure import remove_pairs
from octasplat.engine.poses.config import PosesConfig
from octasplat.engine.poses.features import photographs_of
from octasplat.engine.poses.incremental_mapping import (
    Continuation,
    map_in_segments,
    map_photographs,
    take_out_unsure,
)
from octasplat.engine.poses.linking_pairs import match_links
from octasplat.engine.poses.stored_mappings import (
    MAPPINGS_FOLDER,
    MappingState,
    StoredMapping,
    adopt_stored_mappings,
    matches_digest,
    store_mappings,
)
from octasplat.engine.poses.stored_search import STORED_MAPPINGS
from tests.support.small_disk import files_no_larger_than

PHOTOGRAPHS = 24
MATCHES = "the digest of some matches"


class KilledError(Exception):
    """The process is killed once a state is written."""


@pytest.fixture(scope="module")
def two_places(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a database of photographs of one place, and of half as many of another one."""
    path = tmp_path_factory.mktemp("matches") / "database.db"
    pycolmap.set_random_seed(1)
    with pycolmap.Database.open(path) as database:
        for count in (PHOTOGRAPHS, PHOTOGRAPHS // 2):
            options = pycolmap.SyntheticDatasetOptions()
            options.num_rigs = options.num_cameras_per_rig = 1
            options.num_frames_per_rig = count
            options.num_points3D = 300
            pycolmap.synthesize_dataset(options, database)
    return path


@pytest.fixture(autouse=True)
def short_segments(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(incremental_mapping, "_MIN_SEGMENT", 8)


COUNTED = [*range(3, PHOTOGRAPHS + 1), *range(PHOTOGRAPHS + 3, PHOTOGRAPHS + PHOTOGRAPHS // 2 + 1)]
"""Of both models, each of which begins with two photographs."""


def ignore_count(_count: int) -> None:
    """Count nothing."""


def mapped(database: Path, folder: Path, **how: Any) -> list[Any]:
    stored = StoredMapping(folder, MATCHES, ignore_count)
    return map_in_segments(database, stored, seed=0, on_count=ignore_count, continuation=Continuation(**how))


def model_files(models: list[Any], folder: Path) -> list[dict[str, bytes]]:
    files = []
    for number, model in enumerate(models):
        written = folder / f"written_{number}"
        written.mkdir(parents=True)
        model.write_binary(written)
        files.append({path.name: path.read_bytes() for path in written.iterdir()})
    return files


def test_one_run_gives_what_colmap_gives(two_places: Path, tmp_path: Path) -> None:
    counted: list[int] = []
    models = map_photographs(two_places, seed=0, on_count=counted.append)
    assert [model.num_reg_images() for model in models] == [PHOTOGRAPHS, PHOTOGRAPHS // 2]
    assert counted == list(range(3, PHOTOGRAPHS + 1))
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed = 1, 0
    options.mapper.random_seed = options.triangulation.random_seed = 0
    options.structure_less_registration_fallback = options.extract_colors = False
    options.min_model_size = 3
    pycolmap.set_random_seed(0)
    (tmp_path / "models").mkdir()
    expected = pycolmap.incremental_mapping(two_places, tmp_path, tmp_path / "models", options)
    largest_first = sorted(expected.values(), key=lambda model: -model.num_reg_images())
    assert model_files(models, tmp_path / "one") == model_files(largest_first, tmp_path / "colmap")


def test_segments_give_the_models_of_one_run(two_places: Path, tmp_path: Path) -> None:
    counted: list[int] = []
    states: list[int] = []
    models = map_in_segments(
        two_places, StoredMapping(tmp_path, MATCHES, states.append), seed=0, on_count=counted.append
    )
    assert counted == COUNTED
    assert len(states) >= 4
    counted.clear()
    map_in_segments(
        two_places, StoredMapping(tmp_path, MATCHES, ignore_count), seed=0, on_count=counted.append
    )
    assert counted == COUNTED[-1:]  # of a mapping that is done
    whole = map_photographs(two_places, seed=0, on_count=ignore_count)
    assert [sorted(model.reg_image_ids()) for model in models] == [
        sorted(model.reg_image_ids()) for model in whole
    ]
    for model, other in zip(models, whole, strict=True):
        found = pycolmap.align_reconstructions_via_reprojections(model, other)
        numbers = sorted(model.reg_image_ids())
        centres, expected = (
            np.array([each.images[number].projection_center() for number in numbers])
            for each in (model, other)
        )
        moved = np.array([found * centre for centre in centres])
        np.testing.assert_allclose(moved, expected, atol=1e-4 * np.ptp(expected))


def test_mapping_that_was_stopped_gives_the_same_bytes(two_places: Path, tmp_path: Path) -> None:
    at_once = model_files(mapped(two_places, tmp_path / "at_once"), tmp_path / "at_once_files")
    work = tmp_path / "work"
    folder = work / MAPPINGS_FOLDER / "0"
    stops = 0
    first_counts: list[int] = []

    def kill(_placed: int) -> None:
        raise KilledError

    while True:
        counted: list[int] = []
        try:
            map_in_segments(two_places, StoredMapping(folder, MATCHES, kill), seed=0, on_count=counted.append)
        except KilledError:
            stops += 1
            first_counts += counted[:1]
            # the next attempt is on another host
            store_mappings(work)
            other = tmp_path / f"other_{stops}"
            other.mkdir()
            shutil.copyfile(work / STORED_MAPPINGS, other / STORED_MAPPINGS)
            adopt_stored_mappings(other)
            work, folder = other, other / MAPPINGS_FOLDER / "0"
            (folder / "7").mkdir(exist_ok=True)  # of a state that was not written any more
        else:
            break
    assert stops >= 4 and first_counts[1] > 8  # goes on from what there is
    assert model_files(mapped(two_places, folder), tmp_path / "files") == at_once


def test_mapping_goes_on_from_a_model(two_places: Path, tmp_path: Path) -> None:
    start = tmp_path / "start"
    start.mkdir()
    whole = map_photographs(two_places, seed=0, on_count=ignore_count)
    whole[1].write_binary(start)
    for models in (
        mapped(two_places, tmp_path / "segments", start=start, allow_weak_links=True),
        map_photographs(two_places, seed=0, on_count=ignore_count, start=start, allow_weak_links=True),
    ):
        assert sorted(whole[1].reg_image_ids()) in [sorted(model.reg_image_ids()) for model in models]


def test_state_of_other_matches_is_not_taken(two_places: Path, tmp_path: Path) -> None:
    folder, other = tmp_path / "mapping", tmp_path / "other.db"
    stored = StoredMapping(folder, matches_digest(two_places), ignore_count)
    models = map_in_segments(two_places, stored, seed=0, on_count=ignore_count)
    shutil.copyfile(two_places, other)
    again = StoredMapping(folder, matches_digest(other), ignore_count)
    assert len(again.models()) == len(models) == 2
    remove_pairs(other, np.array([[1, 2]]))
    assert StoredMapping(folder, matches_digest(other), ignore_count).state == MappingState()
    assert [path.name for path in folder.iterdir()] == ["state.json"]  # the models are of no more use


def test_states_that_are_cut_short_are_not_taken(tmp_path: Path) -> None:
    (tmp_path / STORED_MAPPINGS).write_bytes(b"cut short")
    adopt_stored_mappings(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [STORED_MAPPINGS]
    folder = tmp_path / MAPPINGS_FOLDER / "0"
    folder.mkdir(parents=True)
    (folder / "state.json").write_text('{"finished": ["0"], "curr')
    assert not StoredMapping(folder, MATCHES, ignore_count).state.is_done


@pytest.mark.parametrize("limit_bytes", [60, 1_000, 10_000, 100_000])
def test_full_disk_leaves_the_last_state(two_places: Path, tmp_path: Path, limit_bytes: int) -> None:
    """COLMAP does not tell of it, and never comes to the end of some files that are cut short."""
    model, other = map_photographs(two_places, seed=0, on_count=ignore_count)
    folder = tmp_path / MAPPINGS_FOLDER / "0"
    StoredMapping(folder, MATCHES, ignore_count).write([], other, is_done=False)
    with files_no_larger_than(limit_bytes), pytest.raises(DiskFullError, match="free space there"):
        StoredMapping(folder, MATCHES, ignore_count).write([], model, is_done=False)
    state = StoredMapping(folder, MATCHES, ignore_count).state
    assert state.current == folder / "0" and state.current.is_dir()
    assert not (folder / "1").exists()
    with files_no_larger_than(limit_bytes), pytest.raises(OSError, match="File too large"):
        store_mappings(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [MAPPINGS_FOLDER]


@pytest.mark.parametrize("weak", [False, True])
def test_complete_models_are_not_mapped_again(two_places: Path, tmp_path: Path, weak: bool) -> None:
    models = mapped(two_places, tmp_path / "first")
    start = tmp_path / "start"
    start.mkdir()
    models[0].write_binary(start)
    again = mapped(two_places, tmp_path / "again", start=start, apart=models[1:], allow_weak_links=weak)
    extended = mapped(two_places, tmp_path / "extended", start=start, extends_only=True)
    assert [model.num_reg_images() for model in (*again, *extended)] == [PHOTOGRAPHS, PHOTOGRAPHS]
    assert models[1].reg_image_ids()[0] not in again[0].reg_image_ids()


def test_model_takes_in_another_one_that_new_matches_link(two_places: Path, tmp_path: Path) -> None:
    apart = tmp_path / "apart.db"
    shutil.copyfile(two_places, apart)
    half = PHOTOGRAPHS // 2 + 2
    remove_pairs(
        apart, np.array([(a, b) for a in range(1, half + 1) for b in range(half + 1, PHOTOGRAPHS + 1)])
    )
    models = mapped(apart, tmp_path / "first")
    assert models[0].num_reg_images() == half
    start = tmp_path / "start"
    start.mkdir()
    models[0].write_binary(start)
    counted: list[int] = []
    (extended,) = map_in_segments(
        two_places, StoredMapping(tmp_path / "again", MATCHES, ignore_count), seed=0, on_count=counted.append,
        continuation=Continuation(start, extends_only=True),
    )  # fmt: skip
    assert set(extended.reg_image_ids()) == set(range(1, PHOTOGRAPHS + 1))
    assert counted == list(range(half + 1, PHOTOGRAPHS + 1))


def test_photographs_that_models_share_are_counted_once(two_places: Path, tmp_path: Path) -> None:
    models = mapped(two_places, tmp_path / "first")
    start = tmp_path / "start"
    start.mkdir()
    models[0].write_binary(start)
    counted: list[int] = []
    (_, other) = map_in_segments(
        two_places, StoredMapping(tmp_path / "again", MATCHES, ignore_count), seed=0, on_count=counted.append,
        continuation=Continuation(start, apart=models[:1]),
    )  # fmt: skip
    assert other.num_reg_images() == PHOTOGRAPHS // 2
    assert counted == COUNTED[PHOTOGRAPHS - 2 :]


def test_links_of_models_are_those_that_one_geometry_explains(two_places: Path, tmp_path: Path) -> None:
    database = tmp_path / "database.db"
    shutil.copyfile(two_places, database)
    names = photographs_of(database)
    first, other = range(PHOTOGRAPHS), range(PHOTOGRAPHS, len(names))
    linked = [(0, k) for k in first if k]
    remove_pairs(database, np.array(linked) + 1)
    with pycolmap.Database.open(database) as opened:
        opened.clear_matches()

    def found(pairs: list[tuple[int, int]]) -> bool:
        return match_links(database, names, pairs, PosesConfig(), threads=1)

    assert not found([(0, k) for k in other])
    assert not found([])
    assert found(linked)
    assert not match_links(database, names, linked, PosesConfig(), threads=1, min_inliers=100_000)


def test_only_the_pairs_that_look_most_alike_are_matched_as_links(
    two_places: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(linking_pairs, "MAX_LINKS", 3)
    database = tmp_path / "database.db"
    shutil.copyfile(two_places, database)
    with pycolmap.Database.open(database) as opened:
        opened.clear_matches()
        opened.clear_two_view_geometries()
    names = photographs_of(database)
    pairs = [(0, k) for k in range(1, PHOTOGRAPHS)]
    assert match_links(database, names, pairs, PosesConfig(), threads=1)
    with pycolmap.Database.open(database) as opened:
        assert opened.num_verified_image_pairs() == 3


def test_photographs_that_see_few_points_are_taken_out(two_places: Path, tmp_path: Path) -> None:
    model = mapped(two_places, tmp_path)[0]
    first, second, third = sorted(model.reg_image_ids())[:3]
    for number in (first, second):
        seen = [k for k, point in enumerate(model.image(number).points2D) if point.has_point3D()]
        for k in seen[29:]:
            model.delete_observation(number, k)
    assert model.image(second).num_points3D == 29 < model.image(third).num_points3D
    take_out_unsure(model, {first - 1})
    assert set(model.reg_image_ids()) == set(range(1, PHOTOGRAPHS + 1)) - {second}
    folder = tmp_path / "written"
    folder.mkdir()
    model.write_binary(folder)
    assert pycolmap.Reconstruction(folder).num_reg_images() == PHOTOGRAPHS - 1

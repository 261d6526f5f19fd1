"""Pairs proposed for the quick look: by GPS, or by a vocabulary of the capture's features; known answers."""

import shutil
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from octasplat.engine.core.errors import DiskFullError
from octasplat.engine.poses.config import PosesConfig
from octasplat.engine.poses.features import create_database, preselect_pairs
from octasplat.engine.poses.linking_pairs import propose_links
from octasplat.engine.poses.pair_proposals import propose_pairs
from octasplat.engine.poses.pairs import all_pairs, pair_count, pairs_with, select_pairs
from octasplat.engine.poses.stored_search import STORED_SEARCH_FILES
from octasplat.engine.poses.vocabulary import alike_by_vocabulary
from tests.support.located_scene import write_gps
from tests.support.small_disk import files_no_larger_than
from tests.support.tiny_dataset import make_tiny_dataset

COUNT, SEEN, STEP = 60, 240, 60
"""Photographs along a street, features of each, and by how many the next one sees further."""


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[str], np.ndarray]:
    """Photographs of a street, numbered at random: what each sees overlaps with three on either side."""
    rng = np.random.default_rng(0)
    landmarks = rng.integers(0, 120, (COUNT * STEP + SEEN, 128)).astype(np.uint8)
    place = rng.permutation(COUNT)
    names = [f"{k:03d}.jpg" for k in range(COUNT)]
    path = tmp_path_factory.mktemp("street") / "database.db"
    with pycolmap.Database.open(path) as database:
        camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", 500.0, 640, 480)
        database.write_camera(camera, use_camera_id=True)
        for k, at in enumerate(place):
            image = pycolmap.Image(name=names[k], camera_id=1, image_id=k + 1)
            database.write_image(image, use_image_id=True)
            seen = landmarks[at * STEP : at * STEP + SEEN].astype(int) + rng.integers(-2, 3, (SEEN, 128))
            keypoints = np.concatenate(
                [rng.uniform(0, 480, (SEEN, 2)), np.tile([2, 0, 0, 2], (SEEN, 1))], axis=1
            )
            database.write_keypoints(k + 1, keypoints.astype(np.float32))
            descriptors = pycolmap.FeatureDescriptors()
            descriptors.type = pycolmap.FeatureExtractorType.SIFT
            descriptors.data = np.clip(seen, 0, 255).astype(np.uint8)
            database.write_descriptors(k + 1, descriptors)
    return path, names, place


@pytest.mark.exhaustive
def test_vocabulary_proposes_photographs_of_one_place(
    street: tuple[Path, list[str], np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    path, names, place = street
    monkeypatch.setattr("octasplat.engine.poses.pair_proposals.PROPOSALS_PER_PHOTOGRAPH", 12)
    monkeypatch.setattr("octasplat.engine.poses.pair_proposals.NEIGHBORS_BY_NAME", 1)
    proposed = propose_pairs(path, path, COUNT, seed=0, threads=1)
    assert proposed == propose_pairs(path, path, COUNT, seed=0, threads=2)
    alike = {(a, b) for a, b in all_pairs(COUNT) if abs(place[a] - place[b]) <= 2}
    assert len(alike & set(proposed)) >= 0.97 * len(alike) and len(proposed) < pair_count(COUNT) / 2
    assert {(k, k + 1) for k in range(COUNT - 1)} <= set(proposed)

    told: list[tuple[int, float]] = []
    quick = PosesConfig(quick_look_up_to=10, large_partners=6, neighbours=1)
    chosen = preselect_pairs(path, names, quick, threads=1, on_look=lambda *look: told.append(look))
    whole = preselect_pairs(
        path, names, PosesConfig(partners=6, neighbours=1), threads=1, on_look=lambda _unlike, _share: None
    )
    assert len(set(chosen) & set(whole)) >= 0.97 * len(whole)
    assert told == sorted(told) and told[0] == (pair_count(COUNT) - len(proposed), 0.0)
    assert told[-1][1] == 1.0


@pytest.mark.parametrize("without_altitude", [slice(0), slice(0, None, 2), slice(None)])
def test_gps_proposes_what_was_taken_nearby(
    tmp_path_factory: pytest.TempPathFactory,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    without_altitude: slice,
) -> None:
    scene = make_tiny_dataset(tmp_path_factory, views=12)
    names = sorted(path.name for path in (scene / "images").iterdir())
    metres = np.array([[40.0 * ((5 * k) % 12), 0.0, 2.0] for k in range(12)])
    write_gps(scene, dict(zip(names, metres, strict=True)), without_altitude=names[without_altitude])
    create_database(tmp_path / "a.db", scene / "images", names, one_camera=True)
    monkeypatch.setattr("octasplat.engine.poses.pair_proposals.PROPOSALS_PER_PHOTOGRAPH", 2)
    monkeypatch.setattr("octasplat.engine.poses.pair_proposals.NEIGHBORS_BY_NAME", 0)
    found = propose_pairs(tmp_path / "a.db", tmp_path / "none.db", 12, seed=0, threads=1)
    apart = {pair: abs(metres[pair[0], 0] - metres[pair[1], 0]) for pair in found}
    assert {pair for pair in all_pairs(12) if abs(metres[pair[0], 0] - metres[pair[1], 0]) == 40} <= set(
        found
    )
    assert max(apart.values()) <= 80


def test_pairs_of_neighbors_and_of_those_left_out() -> None:
    assert select_pairs({}, 5, min_matches=1, partners=2, neighbours=2) == [
        (0, 1), (0, 2), (1, 2), (1, 3), (2, 3), (2, 4), (3, 4),
    ]  # fmt: skip
    assert pairs_with([4], 6, [(3, 4)]) == [(0, 4), (1, 4), (2, 4), (4, 5)]
    assert pairs_with([4], 6, [(3, 4)], within=2) == [(2, 4), (4, 5)]


def test_photographs_of_one_model_are_linked_by_look_to_those_of_another(
    street: tuple[Path, list[str], np.ndarray],
) -> None:
    path, _, place = street
    by_place = np.argsort(place).tolist()
    rest, posed, of_no_model = by_place[:20], by_place[20:50], by_place[50:]
    at_the_border, behind_it = by_place[19], by_place[20]
    matched = [(min(by_place[18], behind_it), max(by_place[18], behind_it))]
    links = propose_links(path, COUNT, rest, posed, matched, seed=0)
    assert links == sorted(links)
    assert (min(at_the_border, behind_it), max(at_the_border, behind_it)) in links
    assert not set(links) & {*matched}
    assert {(a in rest) + 2 * (b in rest) for a, b in links} <= {1, 2}
    assert not {k for pair in links for k in pair} & {*of_no_model}


@pytest.fixture
def few_words(monkeypatch: pytest.MonkeyPatch) -> None:
    """Learn few words, which takes no time."""
    monkeypatch.setattr("octasplat.engine.poses.vocabulary.TRAINING_DESCRIPTORS", 3000)


def test_vocabulary_is_learnt_once_and_read_on_another_host(
    street: tuple[Path, list[str], np.ndarray], tmp_path: Path, few_words: None
) -> None:
    def alike(work: Path, photographs: int = COUNT, seed: int = 0) -> list[tuple[int, list[int]]]:
        small = work / "links.db"
        shutil.copyfile(street[0], small)
        return list(alike_by_vocabulary(small, photographs, [1, 2, 3], 8, seed=seed))

    def files(work: Path) -> dict[str, tuple[int, bytes]]:
        return {path.name: (path.stat().st_ino, path.read_bytes()) for path in work.glob("vocabulary.*")}

    first, other = tmp_path / "first", tmp_path / "other"
    first.mkdir()
    found = alike(first)
    learnt = files(first)
    assert len(found) == 3 and learnt.keys() < set(STORED_SEARCH_FILES) and len(learnt) == 2
    assert alike(first) == found and files(first) == learnt
    other.mkdir()
    for name in learnt:
        shutil.copyfile(first / name, other / name)
    fetched = files(other)
    assert alike(other) == found and files(other) == fetched
    # words of other features, as of a second search, and a file that is not the one of the record
    assert alike(other, COUNT // 2) != found and files(other) != fetched
    assert alike(first, seed=1) != [] and files(first) != learnt
    shutil.copyfile(first / "vocabulary.bin", other / "vocabulary.bin")
    (other / "vocabulary.json").write_bytes(learnt["vocabulary.json"][1])
    assert alike(other) == found
    assert {name: content for name, (_, content) in files(other).items()} == {
        name: content for name, (_, content) in learnt.items()
    }


@pytest.mark.parametrize("limit_bytes", [50_000, 90_000])
def test_full_disk_leaves_no_vocabulary(
    street: tuple[Path, list[str], np.ndarray], tmp_path: Path, few_words: None, limit_bytes: int
) -> None:
    small = tmp_path / "links.db"
    shutil.copyfile(street[0], small)
    with files_no_larger_than(limit_bytes), pytest.raises(DiskFullError, match="free space there"):
        list(alike_by_vocabulary(small, COUNT, [1], 8, seed=0))
    assert not list(tmp_path.glob("*vocabulary*"))

"""Photographs that are there twice, and bursts, fall on one side of the split."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.dataset import Dataset, split_views
from octasplat.engine.dataset.views_file import ViewsRecord, read_views, write_views
from octasplat.engine.runs.config import ReconstructionConfig
from octasplat.engine.runs.run_dataset import open_run_dataset

Images = list[tuple[str, int, np.ndarray]]


def _pictures(count: int) -> list[np.ndarray]:
    """Pictures that have little in common."""
    rng = np.random.default_rng(5)
    return [
        np.kron(rng.integers(0, 255, (6, 8, 3)), np.ones((4, 4, 1))).astype(np.uint8) for _ in range(count)
    ]


def _ring(index: int) -> np.ndarray:
    angle = 0.35 * index
    return 4 * np.array([np.cos(angle), 0.3, np.sin(angle)])


def _open(root: Path, tmp_path: Path, **options: object) -> Dataset:
    return Dataset.open(root, tmp_path / "cache", **options)  # type: ignore[arg-type]


def _held_out(dataset: Dataset) -> set[str]:
    return {dataset.views[index].name for index in dataset.test_indices.tolist()}


def _duplicate_sentences(dataset: Dataset) -> list[str]:
    return [sentence for sentence in dataset.warnings if "more than once" in sentence]


def test_equal_files_count_as_one_photograph(tmp_path: Path, make_scene: Callable[..., Path]) -> None:
    pictures = _pictures(12)
    once: Images = [(f"{index:02d}.png", 0, picture) for index, picture in enumerate(pictures)]
    copies: Images = [(f"{index:02d} (1).png", 0, picture) for index, picture in enumerate(pictures)]
    alone = _open(make_scene(tmp_path / "once", images=once, positions=_ring), tmp_path / "a")
    # A search for poses does not place copies at just one spot.
    apart = make_scene(
        tmp_path / "twice",
        images=once + copies,
        positions=lambda index: _ring(index % 12) * (1 + 0.02 * (index // 12)),
    )
    twice = _open(apart, tmp_path / "b")
    assert _held_out(alone) == {"00.png", "08.png"} and not _duplicate_sentences(alone)
    assert _held_out(twice) == {"00.png", "08.png", "00 (1).png", "08 (1).png"}
    (sentence,) = _duplicate_sentences(twice)
    assert "12 photographs are there more than once, 12 as equal files (00 (1).png = 00.png, " in sentence


def test_pictures_saved_again_are_duplicates_where_the_pose_is_theirs(
    tmp_path: Path, make_scene: Callable[..., Path]
) -> None:
    pictures = _pictures(9)
    again = np.clip(pictures[0].astype(np.int64) + np.indices(pictures[0].shape).sum(0) % 3 - 1, 0, 255)
    images = [(f"{index}.png", 0, picture) for index, picture in enumerate(pictures)]
    saved = [*images, ("9 again.png", 0, again.astype(np.uint8))]
    near = make_scene(
        tmp_path / "near", images=saved, positions=lambda index: _ring(index % 9) * (1 + 1e-5 * index)
    )
    far = make_scene(tmp_path / "far", images=saved, positions=_ring)
    other = [*images, ("9 again.png", 0, 255 - pictures[0])]
    changed = make_scene(tmp_path / "changed", images=other, positions=lambda index: _ring(index % 9))
    found = _open(near, tmp_path / "a")
    assert _held_out(found) == {"0.png", "9 again.png", "8.png"}
    assert "1 as nearly equal ones (0.png = 9 again.png)" in _duplicate_sentences(found)[0]
    for root in (far, changed):
        assert not _duplicate_sentences(_open(root, root))


@pytest.mark.parametrize(
    ("suffix", "full", "kind"),
    [(".png", 1023, np.uint16), (".tif", 65535, np.float32), (".exr", 300, np.float32)],
)
def test_different_pictures_of_one_pose_are_no_duplicates_whatever_their_values_mean(
    tmp_path: Path,
    make_scene: Callable[..., Path],
    save_image: Callable[..., None],
    suffix: str,
    full: float,
    kind: type[np.generic],
) -> None:
    root = make_scene(
        tmp_path / "scene",
        images=[(f"{index}{suffix}", 0, None) for index in range(9)],
        positions=lambda index: _ring(index % 8),
    )
    pictures = np.stack(_pictures(9)).astype(np.float64) / 255
    for index, picture in enumerate(0.2 + 0.8 * pictures):
        save_image(root / f"images/{index}{suffix}", np.rint(picture * full).astype(kind))
    assert not _duplicate_sentences(_open(root, tmp_path))


def test_a_duplicate_of_a_named_view_is_held_out(tmp_path: Path, make_scene: Callable[..., Path]) -> None:
    pictures = _pictures(4)
    images = [(f"{index}.png", 0, pictures[index % 4]) for index in range(8)]
    dataset = _open(
        make_scene(tmp_path / "scene", images=images, positions=lambda index: _ring(index % 4)),
        tmp_path,
        held_out=("1.png",),
    )
    assert _held_out(dataset) == {"1.png", "5.png"}


@pytest.mark.parametrize("length", [1, 2, 5])
def test_bursts_fall_on_one_side(length: int) -> None:
    names = [f"{index:03d}.png" for index in range(40)]
    train, test = split_views(names, 4, burst_length=length)
    sides = np.zeros(40, bool)
    sides[test] = True
    bursts = sides.reshape(-1, length)
    assert (bursts.all(axis=1) | ~bursts.any(axis=1)).all()
    assert bursts.any(axis=1)[::4].all() and bursts.any(axis=1).sum() == len(bursts[::4])
    assert sorted([*train, *test]) == list(range(40))


def test_a_burst_that_holds_a_duplicate_draws_it_along() -> None:
    names = [f"{index}.png" for index in range(9)]
    _, test = split_views(names, 3, burst_length=3, duplicates=[(2, 8)])
    assert test.tolist() == [0, 1, 2, 6, 7, 8]


def test_bursts_of_a_scene_are_held_out_whole(tmp_path: Path, make_scene: Callable[..., Path]) -> None:
    images = [(f"{index}.png", 0, picture) for index, picture in enumerate(_pictures(8))]
    dataset = _open(
        make_scene(tmp_path / "scene", images=images, positions=_ring), tmp_path, test_every=2, burst_length=2
    )
    assert _held_out(dataset) == {"0.png", "1.png", "4.png", "5.png"}


def test_blank_views_are_no_duplicates(tmp_path: Path, make_scene: Callable[..., Path]) -> None:
    blank = np.full((24, 32, 3), 255, np.uint8)
    images = [(f"{index}.png", 0, blank) for index in range(9)]
    dataset = _open(make_scene(tmp_path / "scene", images=images, positions=_ring), tmp_path)
    assert _held_out(dataset) == {"0.png", "8.png"} and not _duplicate_sentences(dataset)


def test_run_that_was_begun_with_duplicates_apart_goes_on_with_its_own_split(
    tmp_path: Path, make_scene: Callable[..., Path]
) -> None:
    pictures = _pictures(9)
    images = [(f"{index}.png", 0, picture) for index, picture in enumerate([*pictures, pictures[0]])]
    root = make_scene(tmp_path / "scene", images=images, positions=lambda index: _ring(index % 9))
    assert _held_out(_open(root, tmp_path)) == {"0.png", "8.png", "9.png"}
    begun_with = {f"{index}.png": index in (0, 8) for index in range(10)}
    record = _open(root, tmp_path, stored_split=begun_with).views_record
    output = tmp_path / "run"
    output.mkdir()
    write_views(output / "views.json", record)
    found: list[ViewsRecord] = []
    dataset = open_run_dataset(
        root, output, ReconstructionConfig(), 1, lambda _event: None, check_views=found.append
    )
    assert _held_out(dataset) == {"0.png", "8.png"}
    assert read_views(output / "views.json").difference(found[0]) is None
    (sentence,) = _duplicate_sentences(dataset)
    assert "both sides of the split that the run was begun with (0.png = 9.png" in sentence

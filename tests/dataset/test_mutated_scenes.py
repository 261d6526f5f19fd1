"""Mutations of a good scene: each is taken or refused in a sentence, and every photograph is told of."""

import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from octasplat.engine.core.errors import OctasplatError
from octasplat.engine.core.events import Event, Warned
from octasplat.engine.dataset import Dataset
from octasplat.engine.dataset.colmap_model import read_colmap_model
from octasplat.engine.dataset.model_sources import has_model
from octasplat.engine.dataset.synthetic import SyntheticDatasetConfig, write_synthetic_dataset
from octasplat.engine.operations.estimate import EstimateRequest
from octasplat.engine.operations.estimate import run as estimate

VIEWS = 6
Mutation = Callable[[Path, int], None]
"""Changes the scene in a folder; the number chooses which photograph, line or byte."""


@pytest.fixture(scope="module")
def good_scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("good") / "scene"
    config = SyntheticDatasetConfig(views=VIEWS, width_px=48, height_px=36, samples_per_side=1, points=60)
    write_synthetic_dataset(root, config)
    shutil.rmtree(root / "ground_truth", ignore_errors=True)
    return root


def photograph(scene: Path, number: int) -> Path:
    found = sorted(path for path in scene.rglob("*") if path.suffix.lower() in (".png", ".jpg", ".webp"))
    return found[number % len(found)]


def renamed(suffix: str) -> Mutation:
    def mutate(scene: Path, number: int) -> None:
        path = photograph(scene, number)
        path.rename(path.with_name(f"{path.stem}{suffix}"))

    return mutate


def saved_as(suffix: str, mode: str) -> Mutation:
    def mutate(scene: Path, number: int) -> None:
        path = photograph(scene, number)
        try:
            with Image.open(path) as image:
                picture = image.convert(mode)
        except OSError:  # an earlier mutation cut it
            return
        path.unlink()
        picture.save(path.with_suffix(suffix))

    return mutate


def moved(folder: str) -> Mutation:
    def mutate(scene: Path, number: int) -> None:
        path = photograph(scene, number)
        (scene / folder).mkdir(parents=True, exist_ok=True)
        path.rename(scene / folder / path.name)

    return mutate


def renamed_folder(name: str, other: str) -> Mutation:
    def mutate(scene: Path, _number: int) -> None:
        if (scene / name).exists() and not (scene / other).exists():
            (scene / other).parent.mkdir(parents=True, exist_ok=True)
            (scene / name).rename(scene / other)

    return mutate


def added(name: str, content: bytes = b"x") -> Mutation:
    def mutate(scene: Path, _number: int) -> None:
        (scene / name).parent.mkdir(parents=True, exist_ok=True)
        (scene / name).write_bytes(content)

    return mutate


def copied(scene: Path, number: int) -> None:
    path = photograph(scene, number)
    shutil.copy(path, path.with_name(f"{path.stem} (1){path.suffix}"))


def cut(scene: Path, number: int) -> None:
    files = sorted(path for path in scene.rglob("*") if path.is_file())
    path = files[number % len(files)]
    path.write_bytes(path.read_bytes()[: path.stat().st_size * (number % 7) // 8])


def flipped(scene: Path, number: int) -> None:
    files = sorted(scene.rglob("*.bin"))
    if files:
        path = files[number % len(files)]
        data = bytearray(path.read_bytes() or b"x")
        data[(number * 7919) % len(data)] ^= 1 << number % 8
        path.write_bytes(bytes(data))


def removed(scene: Path, number: int) -> None:
    files = sorted(path for path in scene.rglob("*") if path.is_file())
    files[number % len(files)].unlink()


def as_text(encoding: str, ending: str = "\n") -> Mutation:
    def mutate(scene: Path, _number: int) -> None:
        import pycolmap

        for folder in scene.rglob("0"):
            if (folder / "cameras.bin").exists():
                try:
                    # of a damaged count COLMAP takes all memory
                    read_colmap_model(folder)
                    pycolmap.Reconstruction(str(folder)).write_text(str(folder))
                except (
                    OctasplatError,
                    RuntimeError,
                    ValueError,
                    IndexError,
                ):  # one was before
                    continue
                for path in folder.glob("*.bin"):
                    path.unlink()
                for path in folder.glob("*.txt"):
                    path.write_bytes(path.read_text().replace("\n", ending).encode(encoding))

    return mutate


MUTATIONS: dict[str, Mutation] = {
    "upper case": renamed(".PNG"),
    "other suffix": renamed(".jpg"),
    "space": renamed(" b.png"),
    "umlaut": renamed("\u00e4.png"),
    "mask name": renamed("_mask.png"),
    "HEIC": renamed(".HEIC"),
    "no suffix": renamed(""),
    "JPEG": saved_as(".jpg", "RGB"),
    "WebP": saved_as(".webp", "RGB"),
    "GIF": saved_as(".gif", "P"),
    "grey": saved_as(".png", "L"),
    "palette": saved_as(".png", "P"),
    "alpha": saved_as(".png", "RGBA"),
    "sub-folder": moved("images/left"),
    "top": moved("."),
    "masks": moved("masks"),
    "elsewhere": moved("other"),
    "input": renamed_folder("images", "input"),
    "card": renamed_folder("images", "DCIM/100MEDIA"),
    "sparse/1": renamed_folder("sparse/0", "sparse/1"),
    "colmap": renamed_folder("sparse", "colmap/sparse"),
    "no model": renamed_folder("sparse", "backup"),
    "project.ini": added("sparse/0/project.ini"),
    "film": added("images/clip.MOV"),
    "gcp": added("images/gcp_list.txt"),
    "damaged transforms": added("transforms.json", b"{"),
    "hidden": added("images/.DS_Store"),
    "icon": added("images/Icon\r"),
    "empty photograph": added("images/empty.jpg", b""),
    "twin": copied,
    "cut": cut,
    "flipped": flipped,
    "removed": removed,
    "text": as_text("utf-8"),
    "text with CRLF": as_text("utf-8", "\r\n"),
    "text with byte order mark": as_text("utf-8-sig"),
    "text in UTF-16": as_text("utf-16"),
}
CHANGES = st.lists(st.tuples(st.sampled_from(sorted(MUTATIONS)), st.integers(0, 500)), min_size=1, max_size=3)


@pytest.mark.exhaustive
@settings(
    max_examples=200,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(changes=CHANGES)
def test_mutated_scene_is_taken_or_refused_and_no_photograph_is_lost(
    good_scene: Path, changes: list[tuple[str, int]]
) -> None:
    with tempfile.TemporaryDirectory() as place:
        scene = Path(place) / "scene"
        shutil.copytree(good_scene, scene)
        for name, number in changes:
            if any(path.suffix.lower() in (".png", ".jpg", ".webp") for path in scene.rglob("*")):
                MUTATIONS[name](scene, number)
        events: list[Event] = []
        try:
            found = estimate(EstimateRequest(source=scene), progress=events.append)
        except OctasplatError as error:
            assert_sentence(str(error))
            return
        taken = sum(sizes.count for sizes in found.photographs)
        notes = [event.message for event in events if isinstance(event, Warned)]
        assert taken + told_as_left_out(scene, notes) == count_pictures(scene), notes
        if not has_model(scene):
            return
        try:
            dataset = Dataset.open(scene, Path(place) / "cache", threads=1)
        except OctasplatError as error:
            assert_sentence(str(error))
            return
        assert all(np.isfinite(view.rotation_cam_from_world).all() for view in dataset.views)
        unposed = taken - len(dataset.views)
        assert unposed == 0 or any(f"{unposed} images" in text for text in dataset.warnings), dataset.warnings


def assert_sentence(text: str) -> None:
    assert text.endswith((".", ")")) and "Traceback" not in text and text.isprintable(), text


def count_pictures(scene: Path) -> int:
    """Return how many files of the folder look like photographs."""
    suffixes = (".png", ".jpg", ".webp", ".heic", ".gif")
    return sum(path.is_file() and path.suffix.lower() in suffixes for path in scene.rglob("*"))


def told_as_left_out(scene: Path, notes: list[str]) -> int:
    """Return how many of them notes say to be left out, and how many are masks by their place or name."""
    pictures = ("files look like photographs", "photographs do not lie")
    told = sum(int(note.split()[0]) for note in notes if any(words in note for words in pictures))
    in_masks = [path for path in scene.rglob("masks/*") if path.suffix.lower() in (".png", ".jpg", ".webp")]
    beside = [
        path
        for path in scene.rglob("*_mask.png")
        if path not in in_masks and any(path.parent.glob(f"{path.stem.removesuffix('_mask')}.*"))
    ]
    return told + len(in_masks) + len(beside)

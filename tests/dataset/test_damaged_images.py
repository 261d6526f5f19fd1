"""All images of a dataset that are damaged are named at once, whichever reading comes upon them first."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.core.errors import DatasetError
from octasplat.engine.dataset import Dataset
from octasplat.engine.dataset.damaged_images import DECODING_BYTES, MAX_NAMED, decoding_workers
from octasplat.engine.dataset.image_info import ImageInfo
from octasplat.engine.dataset.synthetic import SyntheticDatasetConfig, write_synthetic_dataset
from octasplat.engine.render.image_files import write_png


@pytest.fixture(scope="module")
def generated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("damaged") / "photos"
    config = SyntheticDatasetConfig(views=24, width_px=32, height_px=24, samples_per_side=1, points=200)
    write_synthetic_dataset(folder, config)
    return folder


@pytest.fixture
def photos(generated: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(generated, tmp_path / "photos"))


def cut(path: Path) -> None:
    """Cut a file in half, or so that its header is whole."""
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])


def refusal(photos: Path, tmp_path: Path) -> str:
    with pytest.raises(DatasetError) as refused:
        Dataset.open(photos, tmp_path / "cache", threads=1)
    return str(refused.value)


def images(photos: Path) -> list[Path]:
    return sorted((photos / "images").iterdir())


def test_single_damaged_photograph_is_told_with_its_reason(photos: Path, tmp_path: Path) -> None:
    cut(images(photos)[3])
    told = refusal(photos, tmp_path)
    assert told.startswith(f"{images(photos)[3]} is damaged or cut short") and told.endswith("the file.")


def test_long_list_of_damaged_photographs_is_capped(photos: Path, tmp_path: Path) -> None:
    for path in images(photos):
        cut(path)
    told = refusal(photos, tmp_path)
    names = [f"images/{path.name}" for path in images(photos)]
    assert told.startswith("24 images in ") and f"{names[MAX_NAMED - 1]} and 4 more)" in told
    assert names[MAX_NAMED] not in told


def test_damaged_masks_are_named_with_photographs(photos: Path, tmp_path: Path) -> None:
    (photos / "masks").mkdir()
    for path in images(photos):
        noise = np.random.default_rng(1).integers(0, 2, (24, 32, 1)).repeat(3, axis=2)
        write_png(photos / "masks" / f"{path.name}.png", noise.astype(np.float32))
    cut(images(photos)[0])
    masks = [photos / "masks" / f"{path.name}.png" for path in images(photos)]
    cut(masks[5])
    told = refusal(photos, tmp_path)
    assert f"(images/{images(photos)[0].name}, masks/{masks[5].name})" in told


def test_damaged_photographs_of_16_bits_are_named_at_once(photos: Path, tmp_path: Path, save_image) -> None:
    """Their values are looked at before they are decoded."""
    for number, path in enumerate(images(photos)):
        values = np.random.default_rng(number).integers(0, 4096, (24, 32, 3)).astype(np.uint16)
        save_image(path, values)
    for path in images(photos)[2:4]:
        cut(path)
    told = refusal(photos, tmp_path)
    assert "2 images in" in told and all(path.name in told for path in images(photos)[2:4])


@pytest.mark.parametrize(
    ("info", "measured_bytes"),
    [
        (ImageInfo(4000, 3000, 8, False, 1, "8-bit"), 5 * 12e6),
        (ImageInfo(4000, 3000, 16, False, 1, "16-bit"), 24 * 12e6),
        (ImageInfo(4000, 3000, 8, True, 1, "8-bit"), 50 * 12e6),
        (ImageInfo(4000, 3000, 16, True, 1, "16-bit"), 57 * 12e6),
    ],
)
def test_photographs_that_are_decoded_side_by_side_share_bounded_memory(
    info: ImageInfo, measured_bytes: float
) -> None:
    workers = decoding_workers(64, [info])
    assert 0.25 * DECODING_BYTES < workers * measured_bytes <= DECODING_BYTES
    assert decoding_workers(2, [ImageInfo(800, 600, 8, False, 1)]) == 2
    assert decoding_workers(8, [ImageInfo(20_000, 15_000, 16, True, 1, "16-bit")]) == 1

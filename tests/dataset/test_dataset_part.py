"""Some photographs of a scene, opened without the others: as beside them; the others cannot be asked for."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from octasplat.engine.core.errors import CheckpointError, DatasetError
from octasplat.engine.dataset import Dataset
from octasplat.engine.dataset.dataset_part import open_dataset_part, photograph_facts
from octasplat.engine.dataset.photograph_facts import PhotographFacts
from octasplat.engine.dataset.views_file import ViewsRecord
from tests.support.wall_dataset import HEIGHT_PX, WIDTH_PX, make_wall_dataset

WANTED = np.array([1, 4, 5])


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six photographs: one of 12 bits in 16, one transparent, the others of 8 bits."""
    root = make_wall_dataset(tmp_path_factory.mktemp("wall"), views=6, with_masks=True, with_depths=True)
    deep = np.linspace(0, 4000, HEIGHT_PX * WIDTH_PX).reshape(HEIGHT_PX, WIDTH_PX).astype(np.uint16)
    Image.fromarray(deep).save(root / "images" / "001.png")
    Image.fromarray(deep // 2).save(root / "images" / "002.png")
    clear = np.full((HEIGHT_PX, WIDTH_PX, 4), 200, np.uint8)
    clear[:10, :, 3] = 0
    Image.fromarray(clear).save(root / "images" / "003.png")
    return root


@pytest.fixture(scope="module")
def whole(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return Dataset.open(scene, tmp_path_factory.mktemp("cache"), max_side=32, near=0.01, test_every=3)


def without_others(scene: Path, target: Path) -> Path:
    """A copy in which pictures of other views are empty."""
    shutil.copytree(scene, target)
    for path in target.rglob("*.png"):
        if int(path.name[:3]) not in WANTED:
            path.write_bytes(b"")
    return target


def kept(whole: Dataset) -> tuple[PhotographFacts, ViewsRecord]:
    """What is kept in files."""
    facts, record = photograph_facts(whole), whole.views_record
    return (
        PhotographFacts.model_validate_json(facts.model_dump_json()),
        ViewsRecord.model_validate_json(record.model_dump_json()),
    )


def test_part_is_as_beside_all_photographs(scene: Path, whole: Dataset, tmp_path: Path) -> None:
    facts, record = kept(whole)
    found: list[ViewsRecord] = []
    part = open_dataset_part(
        without_others(scene, tmp_path / "scene"), tmp_path / "cache", WANTED, facts, record,
        max_side=32, near=0.01, check_views=found.append,
    )  # fmt: skip
    assert part.views_record.fingerprint() == found[0].fingerprint() == record.fingerprint()
    assert (part.has_alpha, part.has_masks, part.has_known_distances) == (True, True, True)
    assert (part.near_world, part.extent) == (whole.near_world, whole.extent)
    assert part.train_indices.tolist() == whole.train_indices.tolist() == [1, 2, 4, 5]
    for view in WANTED.tolist():
        for one, other in zip(part.view_image(view), whole.view_image(view), strict=True):
            assert np.array_equal(one, other)
        width, height = part.views[view].width_px, part.views[view].height_px
        y, x = np.divmod(np.arange(width * height), width)
        pixels = np.full(len(y), view), y, x
        assert np.array_equal(part.known_distances(*pixels), whole.known_distances(*pixels))
        assert part.known_distances(*pixels).max() > 0
    # Poses and rays are there of all views, pixels of those alone.
    assert np.array_equal(part.view_rays(0).rays.directions_world, whole.view_rays(0).rays.directions_world)
    with pytest.raises(IndexError, match="view 2 is not among those that were opened"):
        part.view_image(2)
    assert photograph_facts(part) == facts
    wanted_px = sum(view.width_px * view.height_px for view in (part.views[i] for i in WANTED))
    assert (tmp_path / "cache" / "mask.bin").stat().st_size == wanted_px


def test_part_of_another_scene_is_refused(scene: Path, whole: Dataset, tmp_path: Path) -> None:
    facts, record = kept(whole)
    other = shutil.copytree(scene, tmp_path / "other")
    (other / "masks" / "005.png.png").unlink()
    with pytest.raises(CheckpointError, match="other photographs than the run was begun with"):
        open_dataset_part(other, tmp_path / "cache", WANTED, facts, record, max_side=32)
    emptied = without_others(scene, tmp_path / "emptied")
    (emptied / "images" / "004.png").write_bytes(b"")
    with pytest.raises(DatasetError, match=r"004\.png cannot be read"):
        open_dataset_part(emptied, tmp_path / "cache", WANTED, facts, record, max_side=32)

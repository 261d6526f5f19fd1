"""Names of a model that are spelt otherwise than the files, and masks that are found by their names."""

import numpy as np
import pytest

from octasplat.engine.core.errors import DatasetError
from octasplat.engine.dataset import Dataset, load_dataset_model
from octasplat.engine.dataset.image_names import match_image_names
from octasplat.engine.poses.photographs import photographs_of_scene


@pytest.mark.parametrize(
    ("in_model", "on_disk"),
    [
        ("view_{}.PNG", "view_{}.png"),
        ("View_{}.png", "view_{}.png"),
        ("cam1\\view_{}.png", "cam1/view_{}.png"),
        ("./view_{}.png", "view_{}.png"),
        ("view_{}.jpg", "view_{}.png"),
        ("C:\\photos\\view_{}.PNG", "view_{}.png"),
        ("/home/me/images/view_{}.jpg", "view_{}.png"),
        ("view_{}.png", "left/view_{}.png"),
    ],
)
def test_images_spelt_otherwise_are_taken_with_a_warning(tmp_path, make_scene, coded, in_model, on_disk):
    make_scene(tmp_path, images=[(in_model.format(i), 0, None) for i in range(4)])
    make_scene(tmp_path / "other", images=[(on_disk.format(i), 0, coded(32, 24, i)) for i in range(4)])
    (tmp_path / "images").rmdir() if (tmp_path / "images").exists() else None
    (tmp_path / "other/images").rename(tmp_path / "images")
    model = load_dataset_model(tmp_path)
    assert [view.name for view in model.views] == [on_disk.format(i) for i in range(4)]
    assert all(view.image_path == tmp_path / "images" / view.name for view in model.views)
    (warning,) = model.warnings
    assert "4 images of the model are spelt otherwise" in warning
    assert in_model.format(0) in warning


def test_image_names_two_files_are_not_guessed():
    assert match_image_names(["a.jpg"], ["x/a.png", "y/a.png"]) == {}
    assert match_image_names(["x/a.jpg", "y/a.jpg"], ["a.jpg"]) == {}
    assert match_image_names(["A.jpg", "a.jpg"], ["a.jpg"]) == {"a.jpg": "a.jpg"}


def test_images_of_ambiguous_names_are_refused(tmp_path, make_scene, coded):
    make_scene(tmp_path, images=[(f"{i}.png", 0, coded(32, 24, i)) for i in range(4)])
    (tmp_path / "images/1.png").rename(tmp_path / "images/1.PNG")
    (tmp_path / "images/1.Png").write_bytes((tmp_path / "images/1.PNG").read_bytes())
    with pytest.raises(DatasetError, match=r"1 of 4 images .* are not in .*1\.png"):
        load_dataset_model(tmp_path)


@pytest.mark.parametrize(
    "pattern",
    [
        "masks/view_{}.png.png",
        "masks/view_{}.png",
        "masks/view_{}_mask.png",
        "masks/VIEW_{}.PNG.PNG",
        "images/view_{}_mask.png",
        "images/view_{}_MASK.PNG",
        "images/view_{}_mask.jpg",
    ],
)
def test_masks_are_found_under_the_usual_names(tmp_path, make_scene, save_image, pattern):
    make_scene(tmp_path)
    for index in range(4):
        mask = np.zeros((24, 32), dtype=np.uint8)
        mask[:, : 8 + index] = 255
        save_image(tmp_path / pattern.format(index), mask)
    model = load_dataset_model(tmp_path)
    assert [view.mask_path for view in model.views] == [tmp_path / pattern.format(i) for i in range(4)]
    assert model.warnings == ()
    dataset = Dataset.open(tmp_path, tmp_path / "cache")
    assert [int(dataset.view_image(i)[2][0].sum()) for i in range(4)] == [8, 9, 10, 11]


def test_masks_beside_photographs_are_no_photographs(tmp_path, save_image):
    for index in range(3):
        save_image(tmp_path / f"{index}.jpg", np.zeros((8, 8, 3), dtype=np.uint8))
        save_image(tmp_path / f"{index}_mask.png", np.zeros((8, 8), dtype=np.uint8))
    save_image(tmp_path / "the_mask.png", np.zeros((8, 8, 3), dtype=np.uint8))  # a photograph of a mask
    assert photographs_of_scene(tmp_path) == ["0.jpg", "1.jpg", "2.jpg", "the_mask.png"]


def test_pictures_of_a_run_are_no_photographs(tmp_path, save_image):
    for name in ("config.json", "events.jsonl"):
        (tmp_path / name).touch()
    for index in range(3):
        save_image(tmp_path / f"renders/{index}.png", np.zeros((8, 8, 3), dtype=np.uint8))
    with pytest.raises(DatasetError, match="is the folder of a run"):
        photographs_of_scene(tmp_path)
    for index in range(3):
        save_image(tmp_path / f"images/{index}.png", np.zeros((8, 8, 3), dtype=np.uint8))
    assert photographs_of_scene(tmp_path) == ["0.png", "1.png", "2.png"]


DISC = np.hypot(*np.mgrid[-12:12, -16:16]) < 9


@pytest.mark.parametrize(
    ("mask", "told"),
    [
        (7 * DISC.astype(np.uint8), "hold the values 0, 7 and no white"),
        (100 * DISC.astype(np.uint8), "hold the values 0, 100 and no white"),
        (np.where(DISC, 200, 100 * (np.arange(32) % 2)).astype(np.uint8), "hold the values 0, 100, 200"),
        (DISC.astype(np.uint8), "uses the value 1 for valid pixels"),
        (np.zeros((24, 32), dtype=np.uint8), "All 4 masks are black"),
        (np.dstack([0 * DISC, 0 * DISC, 200 * DISC]).astype(np.uint8), "is colored, as labels are"),
        (
            np.dstack([128 * DISC, 0 * DISC, 128 * (np.arange(32) % 2) * ~DISC]).astype(np.uint8),
            "is colored, as labels are",
        ),
        (np.dstack([0 * DISC] * 3 + [255 * DISC]).astype(np.uint8), "mask in the alpha channel"),
        (np.dstack([255 + 0 * DISC] * 3 + [255 * DISC]).astype(np.uint8), "mask in the alpha channel"),
    ],
    ids=["label 7", "label 100", "labels to 200", "ones", "black", "blue", "palette", "alpha", "white alpha"],
)
def test_masks_that_are_not_black_and_white_are_refused(tmp_path, make_scene, save_image, mask, told):
    make_scene(tmp_path)
    for index in range(4):
        save_image(tmp_path / f"masks/view_{index}.png.png", mask)
    with pytest.raises(DatasetError, match=told):
        Dataset.open(tmp_path, tmp_path / "cache")


def test_masks_of_one_photograph_without_valid_pixel_warn(tmp_path, make_scene, save_image):
    make_scene(tmp_path)
    for index in range(4):
        save_image(tmp_path / f"masks/view_{index}.png.png", 255 * (DISC & (index > 0)).astype(np.uint8))
    warnings = Dataset.open(tmp_path, tmp_path / "cache").warnings
    assert warnings == ["1 masks hold no valid (white) pixel, e.g. view_0.png.png."]


def test_mask_of_cut_out_with_equal_colors_and_alpha_is_taken(tmp_path, make_scene, save_image):
    make_scene(tmp_path)
    for index in range(4):
        save_image(tmp_path / f"masks/view_{index}.png.png", np.dstack([255 * DISC] * 4).astype(np.uint8))
    dataset = Dataset.open(tmp_path, tmp_path / "cache")
    np.testing.assert_array_equal(dataset.view_image(0)[2] > 0, DISC)

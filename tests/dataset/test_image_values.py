"""What the numbers in photographs mean where they do not fill the range of their format."""

import numpy as np
import OpenImageIO as oiio
import pytest

from octasplat.engine.core.errors import DatasetError
from octasplat.engine.dataset import Dataset
from octasplat.engine.dataset.images import read_image_info, read_photo


@pytest.fixture
def colors() -> np.ndarray:
    """Display colors in [0, 1] with black and white among them."""
    values = np.random.default_rng(7).random((24, 32, 3))
    values[0, 0], values[0, 1] = 0.0, 1.0
    return values


@pytest.fixture
def open_with(tmp_path, make_scene, save_image):
    """Open a scene whose photographs all hold the same stored values."""

    def open_scene(suffix: str, stored: np.ndarray) -> Dataset:
        root = tmp_path / "scene"
        make_scene(root, images=[(f"{i}{suffix}", 0, None) for i in range(4)])
        for index in range(4):
            save_image(root / f"images/{index}{suffix}", stored)
        return Dataset.open(root, tmp_path / "cache")

    return open_scene


@pytest.mark.parametrize("bits", [8, 10, 12, 14])
@pytest.mark.parametrize("suffix", [".tif", ".png"])
def test_few_bits_in_sixteen_are_scaled_with_a_warning(open_with, colors, bits, suffix):
    stored = np.rint(colors * (2**bits - 1)).astype(np.uint16)
    dataset = open_with(suffix, stored)
    rgb, _, _ = dataset.view_image(1)
    np.testing.assert_allclose(rgb, stored / (2**bits - 1), atol=2e-5)
    (warning,) = [text for text in dataset.warnings if "not white in their format" in text]
    assert f"with {2**bits - 1} for white" in warning


@pytest.mark.parametrize("full", [255.0, 4095.0, 65535.0])
def test_float_tiff_of_integers_is_read_as_display_values(open_with, colors, full):
    dataset = open_with(".tif", (colors * full).astype(np.float32))
    rgb, _, _ = dataset.view_image(0)
    np.testing.assert_allclose(rgb, colors, atol=2e-5)
    assert any(f"with {full:.5g} for white" in text for text in dataset.warnings)


def test_float_values_up_to_millions_are_refused(open_with, colors):
    with pytest.raises(DatasetError, match="neither light from 0 to 1 nor integers"):
        open_with(".tif", (colors * 1e7).astype(np.float32))


@pytest.mark.parametrize("exposure", [300.0, 1e-4])
def test_radiance_of_any_exposure_is_brought_to_white(open_with, colors, exposure):
    dataset = open_with(".exr", (colors * exposure).astype(np.float32))
    rgb, _, _ = dataset.view_image(0)
    assert 0.5 < rgb.mean() < 0.8  # the mean of sRGB-encoded uniform light is 0.68
    assert any("linear light" in text for text in dataset.warnings)


@pytest.mark.parametrize(
    ("suffix", "stored"),
    [
        (".png", np.uint16),
        (".exr", np.float32),
        (".tif", np.float32),
    ],
)
def test_values_that_fill_their_format_are_taken_as_they_are(open_with, colors, suffix, stored):
    full = 65535 if stored == np.uint16 else 1
    assert open_with(suffix, (colors * full).astype(stored)).warnings == []


def test_highlights_above_one_stay_clipped(open_with, colors):
    bright = colors.astype(np.float32)
    bright[:4] *= 20
    dataset = open_with(".exr", bright)
    assert dataset.warnings == []
    np.testing.assert_allclose(dataset.view_image(0)[0][1:4].max(), 1.0)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_fourth_channel_without_a_tag_is_no_alpha(tmp_path, colors, dtype):
    path = tmp_path / "rgbn.tif"
    full = np.iinfo(dtype).max
    stored = (np.dstack([colors, 0.4 * colors[..., :1]]) * full).astype(dtype)
    _save_without_extra_samples(path, stored)
    assert not read_image_info(path).has_alpha
    rgb, alpha = read_photo(path, 32, 24, 8)
    assert alpha is None
    np.testing.assert_allclose(rgb / 255.0, colors, atol=1 / 255)


def test_alpha_of_tiff_png_and_exr_is_kept(tmp_path, save_image, colors):
    values = np.dstack([colors, np.linspace(0, 1, 24)[:, None] * np.ones(32)])
    for name, stored in (
        ("a.tif", (values * 255).astype(np.uint8)),
        ("a.png", (values * 255).astype(np.uint8)),
        ("a.exr", values.astype(np.float32)),
    ):
        save_image(tmp_path / name, stored)
        assert read_image_info(tmp_path / name).has_alpha
        assert read_photo(tmp_path / name, 32, 24, 8)[1] is not None


def test_gif_is_read(tmp_path, colors):
    from PIL import Image

    image = Image.fromarray((colors * 255).astype(np.uint8)).quantize(256)
    image.save(tmp_path / "a.gif")
    rgb, alpha = read_photo(tmp_path / "a.gif", 32, 24, 8)
    np.testing.assert_array_equal(rgb, np.asarray(image.convert("RGB")))
    assert alpha is None or alpha.min() == 255


def _save_without_extra_samples(path, pixels: np.ndarray) -> None:
    """Write a TIFF of four channels and take away the tag that says what the fourth is."""
    height, width, channels = pixels.shape
    out = oiio.ImageOutput.create(str(path))
    out.open(str(path), oiio.ImageSpec(width, height, channels, str(pixels.dtype)))
    out.write_image(np.ascontiguousarray(pixels))
    out.close()
    data = bytearray(path.read_bytes())
    start = int.from_bytes(data[4:8], "little")
    count = int.from_bytes(data[start : start + 2], "little")
    for entry in range(start + 2, start + 2 + 12 * count, 12):
        if int.from_bytes(data[entry : entry + 2], "little") == 338:
            data[entry : entry + 2] = (65000).to_bytes(2, "little")  # a private tag instead
    path.write_bytes(data)

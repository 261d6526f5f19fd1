import numpy as np
import pytest

from octasplat.engine.core.color import linear_to_srgb
from octasplat.engine.core.errors import DatasetError
from octasplat.engine.dataset.images import read_image_info, read_photo
from octasplat.engine.dataset.masks import read_mask
from octasplat.engine.render.image_files import read_image


def read(path, width=None, height=None):
    info = read_image_info(path)
    return read_photo(path, width or info.width_px, height or info.height_px, info.bits)


def noise(*shape, dtype=np.uint8, seed=0):
    return np.random.default_rng(seed).integers(0, np.iinfo(dtype).max, shape, dtype=dtype, endpoint=True)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_colors_pass_through_exactly(tmp_path, save_image, dtype, suffix):
    pixels = noise(6, 8, 3, dtype=dtype)
    save_image(tmp_path / f"a.{suffix}", pixels)
    rgb, alpha = read(tmp_path / f"a.{suffix}")
    assert rgb.dtype == dtype
    np.testing.assert_array_equal(rgb, pixels)
    assert alpha is None


def test_read_image_8_bits_scale_to_16(tmp_path, save_image):
    save_image(tmp_path / "a.png", np.array([[[0, 128, 255]]], dtype=np.uint8))
    assert read_photo(tmp_path / "a.png", 1, 1, 16)[0].tolist() == [[[0, 128 * 257, 65535]]]


@pytest.mark.parametrize("suffix", ["png", "jpg"])
def test_gray_is_spread_over_three_channels(tmp_path, save_image, suffix):
    save_image(tmp_path / f"a.{suffix}", np.full((8, 8), 77, np.uint8))
    rgb, alpha = read(tmp_path / f"a.{suffix}")
    assert rgb.shape == (8, 8, 3)
    assert (rgb == 77).all()
    assert alpha is None


def test_read_image_keeps_straight_alpha(tmp_path, save_image):
    pixels = noise(6, 8, 4)
    save_image(tmp_path / "a.png", pixels)
    rgb, alpha = read(tmp_path / "a.png")
    np.testing.assert_array_equal(rgb, pixels[..., :3])
    np.testing.assert_array_equal(alpha, pixels[..., 3])


def test_read_image_gray_alpha_is_expanded(tmp_path, save_image):
    save_image(tmp_path / "a.png", np.array([[[200, 100]]], dtype=np.uint8))
    rgb, alpha = read(tmp_path / "a.png")
    assert rgb.tolist() == [[[200, 200, 200]]]
    assert alpha.tolist() == [[100]]


def test_read_image_16_bit_alpha_is_scaled(tmp_path, save_image):
    save_image(tmp_path / "a.png", np.array([[[60000, 300, 0, 32768]]], dtype=np.uint16))
    rgb, alpha = read(tmp_path / "a.png")
    assert rgb.tolist() == [[[60000, 300, 0]]]
    assert alpha.tolist() == [[128]]


@pytest.mark.parametrize(("name", "tolerance"), [("a.exr", 2), ("a.hdr", 400)])
def test_linear_light_becomes_display_values(tmp_path, save_image, name, tolerance):
    linear = np.array([[[0.0, 0.001, 0.2140411], [1.0, 7.0, 0.5]]], dtype=np.float32)
    save_image(tmp_path / name, linear)
    rgb, alpha = read(tmp_path / name)
    assert rgb.dtype == np.uint16
    assert alpha is None
    expected = np.array([[[0, 0.01292, 0.5], [1, 1, 0.735357]]]) * 65535
    np.testing.assert_allclose(rgb, expected, atol=tolerance)  # HDR stores 8 bits of mantissa


def test_half_float_image_with_nonfinite_values(tmp_path, save_image):
    save_image(tmp_path / "a.exr", np.array([[[np.nan, np.inf, -np.inf]]], dtype=np.float16))
    assert read(tmp_path / "a.exr")[0].tolist() == [[[0, 65535, 0]]]


def test_premultiplied_exr_becomes_straight(tmp_path, save_image):
    save_image(tmp_path / "a.exr", np.array([[[0.107, 0.25, 0.0, 0.5], [0, 0, 0, 0]]], dtype=np.float32))
    rgb, alpha = read(tmp_path / "a.exr")
    np.testing.assert_allclose(
        rgb[0, 0] / 65535, linear_to_srgb(np.array([0.214, 0.5, 0], np.float32)), atol=1e-4
    )
    assert alpha.tolist() == [[128, 0]]


@pytest.mark.parametrize(
    "pixels",
    [
        np.full((53, 80, 3), 137, np.uint8),
        np.full((53, 80, 3), 40000, np.uint16),
        np.full((53, 80, 4), 137, np.uint8),
        np.full((53, 80), 137, np.uint8),
    ],
    ids=["8 bit", "16 bit", "RGBA", "gray"],
)
def test_reduce_constant_image_is_constant(tmp_path, save_image, pixels):
    save_image(tmp_path / "a.png", pixels)
    rgb, alpha = read(tmp_path / "a.png", 20, 13)
    assert rgb.shape == (13, 20, 3)
    assert (rgb == pixels.flat[0]).all()
    assert alpha is None or (alpha == 137).all()


def test_reduce_linear_ramp_is_exact(tmp_path, save_image):
    ramp = np.broadcast_to((np.arange(240) + 0.5)[None, :, None], (24, 240, 3)).astype(np.uint8)
    save_image(tmp_path / "a.png", ramp)
    rgb, _ = read(tmp_path / "a.png", 60, 6)
    expected = 4 * (np.arange(60) + 0.5) - 0.5  # area average over four columns
    assert rgb.astype(float).mean() == pytest.approx(ramp.mean(), abs=0.51)
    np.testing.assert_allclose(rgb[3, 2:-2, 1], expected[2:-2], atol=1.01)


def test_fine_stripes_average_out_when_reduced(tmp_path, save_image):
    stripes = np.zeros((64, 64, 3), np.uint8)
    stripes[:, ::2] = 255
    save_image(tmp_path / "a.png", stripes)
    rgb, _ = read(tmp_path / "a.png", 16, 16)
    assert np.abs(rgb[2:-2, 2:-2].astype(int) - 128).max() <= 2


def test_transparent_pixels_do_not_bleed_into_colors(tmp_path, save_image):
    pixels = np.zeros((32, 32, 4), np.uint8)
    pixels[..., 0] = 255  # red where it is transparent
    pixels[8:24, 8:24] = [0, 200, 0, 255]
    save_image(tmp_path / "a.png", pixels)
    rgb, alpha = read(tmp_path / "a.png", 8, 8)
    seen = alpha > 16
    assert (rgb[seen][:, 0] == 0).all()
    assert np.abs(rgb[seen][:, 1].astype(int) - 200).max() <= 3
    assert alpha[4, 4] == 255 and alpha[0, 0] == 0


@pytest.mark.parametrize("name", ["a.jpg", "a.png", "a.tif", "a.exr", "a.hdr"])
def test_truncated_photograph_is_named(tmp_path, save_image, name, capfd):
    is_float = name[-3:] in ("exr", "hdr")
    save_image(tmp_path / name, noise(60, 80, 3).astype(np.float32) if is_float else noise(60, 80, 3))
    data = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(data[: len(data) * 2 // 3])
    with pytest.raises(DatasetError, match=name):
        read(tmp_path / name)


def test_header_of_other_bytes_than_text_is_told(tmp_path, save_image):
    path = tmp_path / "a.exr"
    save_image(path, np.full((4, 4, 3), 0.5, np.float32))
    # the message of the library quotes it
    path.write_bytes(path.read_bytes().replace(b"chlist", b"\xffhlist"))
    for read in (read_image_info, read_image):
        with pytest.raises(DatasetError, match=r"a\.exr.*header is damaged"):
            read(path)


def test_mask_is_read_and_downscaled(tmp_path, save_image):
    mask = np.zeros((24, 32), np.uint8)
    mask[:, 16:] = 255
    save_image(tmp_path / "m.png", mask)
    np.testing.assert_array_equal(read_mask(tmp_path / "m.png", (32, 24), 32, 24)[0], mask)
    small, _ = read_mask(tmp_path / "m.png", (32, 24), 8, 6)
    assert (small[:, :3] == 0).all() and (small[:, 5:] == 255).all()
    save_image(tmp_path / "rgb.png", np.repeat(mask[..., None], 3, axis=2))
    np.testing.assert_array_equal(read_mask(tmp_path / "rgb.png", (32, 24), 32, 24)[0], mask)


def test_mask_of_wrong_size_is_named(tmp_path, save_image):
    save_image(tmp_path / "m.png", np.zeros((24, 31), np.uint8))
    with pytest.raises(DatasetError, match=r"m\.png is 31x24 but its photograph is 32x24"):
        read_mask(tmp_path / "m.png", (32, 24), 32, 24)
    save_image(tmp_path / "one.png", np.ones((24, 32), np.uint8))
    with pytest.raises(DatasetError, match=r"one\.png uses the value 1"):
        read_mask(tmp_path / "one.png", (32, 24), 32, 24)
    (tmp_path / "bad.png").write_bytes(b"nothing")
    with pytest.raises(DatasetError, match=r"bad\.png cannot be read"):
        read_mask(tmp_path / "bad.png", (32, 24), 32, 24)

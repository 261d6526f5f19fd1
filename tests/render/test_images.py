import numpy as np
import OpenImageIO as oiio
import pytest

from octasplat.engine.core.color import linear_to_srgb, srgb_to_linear, to_bytes
from octasplat.engine.core.errors import DatasetError, OutputError
from octasplat.engine.render import image_files
from tests.support.image_channels import read_channels


@pytest.fixture
def picture():
    return np.random.default_rng(1).random((6, 9, 3), dtype=np.float32)


def test_png_keeps_display_values_to_8_bits(tmp_path, picture):
    image_files.write_png(tmp_path / "a.png", picture)
    again = image_files.read_image(tmp_path / "a.png")
    assert np.array_equal(to_bytes(again), to_bytes(picture))
    assert [p.name for p in tmp_path.iterdir()] == ["a.png"]


def test_png_keeps_straight_colors_under_any_alpha(tmp_path, picture):
    alpha = np.linspace(0, 1, 54, dtype=np.float32).reshape(6, 9)
    image_files.write_png(tmp_path / "a.png", picture, alpha)
    again = image_files.read_image(tmp_path / "a.png")
    assert again.shape == (6, 9, 4)
    assert np.array_equal(to_bytes(again[..., :3]), to_bytes(picture))
    assert np.array_equal(to_bytes(again[..., 3]), to_bytes(alpha))


def test_exr_holds_linear_light_depth_alpha_and_normals(tmp_path, picture):
    rng = np.random.default_rng(2)
    alpha, depth = rng.random((6, 9), np.float32), rng.random((6, 9), np.float32) * 1e6
    normals = rng.normal(size=(6, 9, 3)).astype(np.float32)
    layers = image_files.exr_layers(picture, alpha=alpha, depth=depth, normals_world=normals)
    image_files.write_exr(tmp_path / "a.exr", layers)
    again = read_channels(tmp_path / "a.exr")
    assert set(again) == {"R", "G", "B", "A", "Z", "N.x", "N.y", "N.z"}
    assert all(np.array_equal(again[name], layers[name]) for name in layers)
    rgb = np.stack([again[c] for c in "RGB"], axis=-1)
    assert np.allclose(linear_to_srgb(rgb), picture, atol=1e-6)


def test_half_exr_keeps_full_precision_depth(tmp_path, picture):
    depth = np.full((6, 9), 123456.789, np.float32)
    image_files.write_exr(tmp_path / "a.exr", image_files.exr_layers(picture, depth=depth), half=True)
    again = read_channels(tmp_path / "a.exr")
    assert np.array_equal(again["Z"], depth)
    assert np.allclose(again["R"], srgb_to_linear(picture)[..., 0], rtol=1e-3)
    spec = oiio.ImageInput.open(str(tmp_path / "a.exr")).spec()
    formats = dict(zip(spec.channelnames, (str(f) for f in spec.channelformats), strict=True))
    assert formats["R"] == "half" and formats["Z"] == "float"


def test_srgb_curve_known_points():
    values = np.array([0, 0.04045, 0.5, 1], np.float32)
    assert srgb_to_linear(values) == pytest.approx([0, 0.0031308, 0.2140411, 1], abs=1e-6)
    assert linear_to_srgb(srgb_to_linear(values)) == pytest.approx(values, abs=1e-6)


def test_shrinking_keeps_the_shape_and_the_mean_and_never_enlarges(picture):
    big = np.repeat(np.repeat(picture, 20, axis=0), 20, axis=1)
    small = image_files.shrink_to(big, 90)
    assert small.shape == (60, 90, 3)
    assert small.mean() == pytest.approx(big.mean(), abs=2e-3)
    assert image_files.shrink_to(big, 180) is big


def test_shrinking_agrees_with_openimageio_away_from_the_borders():
    rng = np.random.default_rng(0)
    big = rng.random((150, 200, 4)).astype(np.float32)
    source = oiio.ImageBuf(oiio.ImageSpec(200, 150, 4, oiio.FLOAT))
    source.set_pixels(source.roi, big)
    resized = oiio.ImageBufAlgo.resize(source, filtername="lanczos3", roi=oiio.ROI(0, 80, 0, 60, 0, 1, 0, 4))
    expected = resized.get_pixels(oiio.FLOAT).reshape(60, 80, 4)
    shrunk = image_files.shrink_to(big, 80)
    np.testing.assert_allclose(shrunk[5:-5, 5:-5], expected[5:-5, 5:-5], atol=1e-4)
    np.testing.assert_allclose(
        image_files.shrink_to(np.full((90, 70, 1), 0.3, np.float32), 31), 0.3, atol=1e-6
    )


def test_read_image_invalid_file_is_named(tmp_path):
    with pytest.raises(DatasetError, match=r"missing\.png"):
        image_files.read_image(tmp_path / "missing.png")
    (tmp_path / "text.png").write_text("no image")
    with pytest.raises(DatasetError, match=r"text\.png"):
        image_files.read_image(tmp_path / "text.png")


def test_damaged_image_is_refused_by_name(tmp_path, picture):
    path = tmp_path / "cut.png"
    image_files.write_png(path, np.repeat(picture, 30, axis=0))
    path.write_bytes(path.read_bytes()[:400])
    with pytest.raises(DatasetError, match=r"cut\.png"):
        image_files.read_image(path)


def test_unwritable_path_raises_output_error(tmp_path, picture):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match=r"a\.png"):
        image_files.write_png(tmp_path / "file" / "a.png", picture)
    with pytest.raises(OutputError, match="unknown"):
        image_files.write_png(tmp_path / "a.unknown", picture)


def test_transparent_exr_is_premultiplied_linear():
    alpha = np.array([[0.0, 0.1, 0.5, 1.0]], np.float32)
    straight = np.full(1, 0.8, np.float32)
    display = np.repeat((alpha * straight)[..., None], 3, axis=-1)
    layers = image_files.exr_layers(display, alpha=alpha, transparent=True)
    np.testing.assert_allclose(layers["R"], alpha * srgb_to_linear(straight), rtol=1e-5)
    np.testing.assert_array_equal(layers["A"], alpha)
    opaque = image_files.exr_layers(
        display, alpha=alpha
    )  # over a black background that is part of the picture
    np.testing.assert_array_equal(opaque["R"], srgb_to_linear(display)[..., 0])


def test_radiance_image_is_rounded_to_steps(tmp_path):
    random = np.random.default_rng(1)
    linear = np.exp(random.uniform(-6, 6, (32, 64, 3))).astype(np.float32)
    linear[0, 0] = 0
    image_files.write_rgbe(tmp_path / "a.hdr", linear)
    back = image_files.read_image(tmp_path / "a.hdr")[..., :3]
    step = np.ldexp(1.0, np.frexp(linear.max(axis=2, keepdims=True))[1] - 8)
    assert (np.abs(back - linear) <= 0.5 * step * 1.02).mean() > 0.99
    assert (np.abs(back - linear) <= step).all()
    assert abs(float(((back - linear) / step)[linear > step].mean())) < 0.02
    np.testing.assert_array_equal(back[0, 0], 0)

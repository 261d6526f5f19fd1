import numpy as np
import pytest
import torch
from pytorch_msssim import ms_ssim as reference_ms_ssim
from pytorch_msssim import ssim as reference_ssim
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from octasplat.engine.core.color import to_bytes
from octasplat.engine.core.psnr import fit_color, psnr
from octasplat.engine.evaluate import metrics


def pair(height, width, seed=0):
    """A smooth picture and a noisy, shifted copy of it."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0:height, 0:width] / 20.0
    picture = np.stack([np.sin(x + y), np.cos(x * 1.7), np.sin(y * 0.6 - x)], axis=-1) * 0.4 + 0.5
    other = np.roll(picture, 1, axis=1) + rng.normal(0, 0.04, picture.shape)
    return (np.clip(a, 0, 1).astype(np.float32) for a in (other, picture))


def as_tensor(image):
    return torch.from_numpy(image).double().permute(2, 0, 1)[None]


def ssim_by_convolution(render, reference):
    """The loss of 3D Gaussian Splatting as its paper states it, by plain zero-padded convolution."""
    x, y = as_tensor(render), as_tensor(reference)
    line = torch.exp(-((torch.arange(11, dtype=torch.float64) - 5) ** 2) / (2 * 1.5**2))
    line = line / line.sum()
    window = torch.outer(line, line).expand(3, 1, 11, 11)

    def blur(image):
        return torch.nn.functional.conv2d(image, window, padding=5, groups=3)

    mx, my = blur(x), blur(y)
    vx, vy, vxy = blur(x * x) - mx**2, blur(y * y) - my**2, blur(x * y) - mx * my
    values = ((2 * mx * my + 1e-4) * (2 * vxy + 9e-4)) / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4))
    return float(values.mean())


def test_psnr_of_a_constant_error_is_its_closed_form():
    reference = np.full((4, 5, 3), 0.25, np.float32)
    assert psnr(reference + np.float32(0.125), reference) == pytest.approx(20 * np.log10(8))


def test_psnr_agrees_with_scikit_image():
    render, reference = pair(30, 41)
    expected = peak_signal_noise_ratio(reference.astype(float), render.astype(float), data_range=1)
    assert psnr(render, reference) == pytest.approx(expected, abs=1e-9)


def test_color_correction_undoes_gain_and_offset_where_pixels_count():
    _, reference = pair(30, 41)
    gain, offset = np.array([0.8, 0.9, 0.7]), np.array([0.05, -0.02, 0.1])
    render = (reference * gain + offset).astype(np.float32)
    weight = np.ones((30, 41), np.float32)
    weight[:, :10] = 0
    render[:, :10] = 0.9
    corrected = fit_color(render, reference, weight)
    np.testing.assert_allclose(corrected[:, 10:], reference[:, 10:], atol=1e-6)
    assert psnr(corrected, reference, weight) > 100


def test_color_correction_agrees_with_numpys_least_squares():
    render, reference = pair(30, 41)
    corrected = fit_color(render, reference, np.ones((30, 41), np.float32))
    for channel in range(3):
        x, y = render[..., channel].ravel().astype(float), reference[..., channel].ravel()
        expected = np.clip(np.polyval(np.polyfit(x, y, 1), x), 0, 1)
        np.testing.assert_allclose(corrected[..., channel].ravel(), expected, atol=1e-5)


def test_color_correction_constant_or_empty_image():
    grey, target = np.full((4, 5, 3), 0.5, np.float32), np.full((4, 5, 3), 0.25, np.float32)
    np.testing.assert_allclose(fit_color(grey, target, np.ones((4, 5), np.float32)), target)
    assert (fit_color(grey, target, np.zeros((4, 5), np.float32)) == grey).all()


@pytest.mark.parametrize("size", [(40, 51), (11, 11), (7, 30)])
def test_ssim_agrees_with_a_padded_convolution(size):
    render, reference = pair(*size)
    assert metrics.ssim(render, reference) == pytest.approx(ssim_by_convolution(render, reference), abs=1e-10)


def test_ssim_valid_agrees_with_scikit_image_and_pytorch_msssim():
    render, reference = pair(40, 51)
    by_skimage = structural_similarity(
        reference.astype(float), render.astype(float), gaussian_weights=True, sigma=1.5,
        use_sample_covariance=False, data_range=1, channel_axis=-1,
    )  # fmt: skip
    by_torch = float(reference_ssim(as_tensor(render), as_tensor(reference), data_range=1.0))
    value = metrics.ssim_valid(render, reference)
    assert value == pytest.approx(by_skimage, abs=1e-9)
    assert value == pytest.approx(by_torch, abs=1e-5)
    assert metrics.ssim_both(render, reference) == (metrics.ssim(render, reference), value)


def test_ssim_valid_of_an_image_smaller_than_the_window_is_not_a_number():
    render, reference = pair(8, 30)
    assert np.isnan(metrics.ssim_valid(render, reference))


@pytest.mark.parametrize("size", [(176, 192), (161, 187), (171, 165)])
def test_ms_ssim_agrees_with_pytorch_msssim(size):
    render, reference = pair(*size)
    expected = float(reference_ms_ssim(as_tensor(render), as_tensor(reference), data_range=1.0))
    assert metrics.ms_ssim(render, reference) == pytest.approx(expected, abs=1e-5)


def test_ms_ssim_of_a_small_image_is_none():
    render, reference = pair(160, 200)
    assert metrics.ms_ssim(render, reference) is None


def test_flip_map_belongs_to_the_pixels_that_differ():
    _, reference = pair(60, 80)
    render = reference.copy()
    render[:20, :20] = 1 - render[:20, :20]
    error, mean = metrics.flip(render, reference)
    assert error.shape == (60, 80)
    assert error[5:15, 5:15].mean() > 0.3
    assert error[45:, 50:].max() < 1e-3
    assert mean == pytest.approx(error.mean(dtype=np.float64))


def test_flip_of_black_against_white_is_near_one():
    black = np.zeros((50, 50, 3), np.float32)
    assert metrics.flip(black, 1 - black).mean == pytest.approx(0.967, abs=0.005)


def test_identical_images_have_perfect_scores():
    _, picture = pair(176, 176)
    assert psnr(picture, picture) == np.inf
    assert metrics.ssim_both(picture, picture) == pytest.approx((1.0, 1.0))
    assert metrics.ms_ssim(picture, picture) == pytest.approx(1.0)
    assert metrics.flip(picture, picture).mean == pytest.approx(0.0, abs=1e-6)


def test_masked_psnr_is_that_of_the_valid_pixels():
    render, reference = pair(20, 30)
    weight = np.zeros((20, 30), np.float32)
    weight[4:15, 6:20] = 1
    crop = np.s_[4:15, 6:20]
    assert psnr(render, reference, weight) == pytest.approx(psnr(render[crop], reference[crop]))
    assert psnr(render, reference, np.ones_like(weight)) == pytest.approx(psnr(render, reference))
    assert np.isnan(psnr(render, reference, np.zeros_like(weight)))


def test_masked_errors_do_not_change_metrics_after_fill():
    _, reference = pair(40, 40)
    weight = np.ones((40, 40), np.float32)
    weight[:10] = 0
    render = reference.copy()
    render[:10] = 0
    filled = metrics.fill_invalid(render, reference, weight)
    assert metrics.ssim(filled, reference) == pytest.approx(1.0)
    assert metrics.ssim(render, reference) < 0.9


def test_rounding_to_8_bits_goes_to_the_nearest_step_and_clips():
    values = np.array([[[-0.2, 0.5, 1.3], [0.4 / 255, 0.6 / 255, 254.4 / 255]]], np.float32)
    assert to_bytes(values).tolist() == [[[0, 128, 255], [0, 1, 254]]]
    assert np.array_equal(metrics.quantize_8_bit(values), to_bytes(values) / np.float32(255))

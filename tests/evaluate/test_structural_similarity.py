"""SSIM and MS-SSIM of masked, gray and tiny images, against plain sums over windows."""

import numpy as np
import pytest
from scipy.ndimage import correlate1d
from skimage.metrics import structural_similarity as similarity_by_skimage

from octasplat.engine.evaluate import metrics


def pair(height, width, seed=0):
    rng = np.random.default_rng(seed)
    image = rng.random((height, width, 3)).astype(np.float32)
    return image, np.clip(image + rng.normal(0, 0.1, image.shape), 0, 1).astype(np.float32)


def terms(x, y):
    """Luminance and structure of each window, as their paper states them."""
    line = np.exp(-((np.arange(11) - 5.0) ** 2) / (2 * 1.5**2))
    line /= line.sum()

    def blur(image):
        down = correlate1d(image, line, axis=0, mode="constant")
        return correlate1d(down, line, axis=1, mode="constant")

    mx, my = blur(x), blur(y)
    vx, vy, vxy = blur(x * x) - mx**2, blur(y * y) - my**2, blur(x * y) - mx * my
    return (2 * mx * my + 1e-4) / (mx**2 + my**2 + 1e-4), (2 * vxy + 9e-4) / (vx + vy + 9e-4)


def halved(image):
    """Means of 2 x 2 pixels; odd sides get a black line before them."""
    even = np.pad(image, [(side % 2, 0) for side in image.shape[:2]] + [(0, 0)])
    return (even[::2, ::2] + even[::2, 1::2] + even[1::2, ::2] + even[1::2, 1::2]) / 4


def masked_ms_ssim(x, y, weight):
    product = np.ones(3)
    for scale, exponent in enumerate((0.0448, 0.2856, 0.3001, 0.2363, 0.1333)):
        luminance, structure = terms(x, y)
        values = (luminance * structure if scale == 4 else structure)[5:-5, 5:-5]
        counts = weight[5:-5, 5:-5]
        product *= np.maximum((values * counts).sum(axis=(0, 1)) / counts.sum(), 0) ** exponent
        x, y, weight = halved(x), halved(y), halved(weight)
    return product.mean()


@pytest.mark.parametrize("size", [(180, 163), (161, 200)])
def test_masked_indices_are_means_over_the_windows_of_valid_pixels(size):
    render, reference = pair(*size)
    weight = (np.random.default_rng(1).random(size) > 0.4).astype(np.float32)
    weight[:60, :70] = 0
    found = metrics.structural_similarity(render, reference, weight)
    x, y, counts = render.astype(np.float64), reference.astype(np.float64), weight[..., None].astype(float)
    similarity = np.prod(terms(x, y), axis=0)
    inner = np.s_[5:-5, 5:-5]
    assert found.ssim == pytest.approx((similarity * counts).sum() / (3 * counts.sum()), rel=1e-12)
    expected = (similarity * counts)[inner].sum() / (3 * counts[inner].sum())
    assert found.ssim_valid == pytest.approx(expected, rel=1e-12)
    assert found.ms_ssim == pytest.approx(masked_ms_ssim(x, y, counts), rel=1e-7)


def test_indices_together_are_those_of_each():
    render, reference = pair(170, 190)
    found = metrics.structural_similarity(render, reference)
    assert found == (*metrics.ssim_both(render, reference), metrics.ms_ssim(render, reference))
    assert found == metrics.structural_similarity(render, reference, np.ones((170, 190), np.float32))


def test_indices_are_the_same_on_any_number_of_threads():
    render, reference = pair(177, 190)
    one = metrics.structural_similarity(render, reference)
    for threads in (2, 3, 5):
        assert metrics.structural_similarity(render, reference, threads=threads) == one


def test_ssim_of_gray_images_is_that_of_one_channel():
    render, reference = (np.repeat(image[..., :1], 3, axis=2) for image in pair(40, 51))
    expected = similarity_by_skimage(
        reference[..., 0].astype(float), render[..., 0].astype(float), gaussian_weights=True, sigma=1.5,
        use_sample_covariance=False, data_range=1,
    )  # fmt: skip
    assert metrics.ssim_valid(render, reference) == pytest.approx(expected, abs=1e-9)


def test_ssim_of_a_pixel_is_that_of_the_middle_of_its_window():
    x, y = np.full((1, 1, 3), 0.25, np.float32), np.full((1, 1, 3), 0.75, np.float32)
    line = np.exp(-((np.arange(11) - 5.0) ** 2) / (2 * 1.5**2))
    share = (line[5] / line.sum()) ** 2
    mx, my = 0.25 * share, 0.75 * share
    vx, vy, vxy = 0.25**2 * share - mx**2, 0.75**2 * share - my**2, 0.25 * 0.75 * share - mx * my
    luminance = (2 * mx * my + 1e-4) / (mx**2 + my**2 + 1e-4)
    structure = (2 * vxy + 9e-4) / (vx + vy + 9e-4)
    ssim, ssim_valid, ms_ssim = metrics.structural_similarity(x, y)
    assert ssim == pytest.approx(luminance * structure, rel=1e-12)
    assert np.isnan(ssim_valid) and ms_ssim is None


@pytest.mark.parametrize("size", [(1, 30), (4, 3), (10, 12)])
def test_ssim_of_images_smaller_than_the_window(size):
    render, reference = pair(*size)
    x, y = render.astype(np.float64), reference.astype(np.float64)
    ssim, ssim_valid, ms_ssim = metrics.structural_similarity(render, reference)
    assert ssim == pytest.approx(np.prod(terms(x, y), axis=0).mean(), rel=1e-12)
    assert np.isnan(ssim_valid) and ms_ssim is None


def test_indices_without_a_valid_pixel_are_undefined():
    render, reference = pair(170, 170)
    ssim, ssim_valid, ms_ssim = metrics.structural_similarity(
        render, reference, np.zeros((170, 170), np.float32)
    )
    assert np.isnan(ssim) and np.isnan(ssim_valid) and ms_ssim is None

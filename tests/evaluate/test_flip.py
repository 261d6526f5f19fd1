"""FLIP against NVIDIA's library."""

import flip_evaluator
import numpy as np
import pytest

from octasplat.engine.evaluate import metrics
from octasplat.engine.evaluate.flip import flip_error


def noisy_pair(height, width, seed=0):
    """An image of random bytes, and one that differs a little."""
    rng = np.random.default_rng(seed)
    image = (rng.integers(0, 256, (height, width, 3)) / np.float32(255)).astype(np.float32)
    return image, np.clip(image + rng.normal(0, 0.05, image.shape), 0, 1).astype(np.float32)


def by_library(render, reference, pixels_per_degree=metrics.PIXELS_PER_DEGREE):
    error, _, _ = flip_evaluator.evaluate(
        reference.copy(), render.copy(), "LDR", applyMagma=False, parameters={"ppd": pixels_per_degree}
    )
    return np.asarray(error).reshape(render.shape[:2])


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (3, 5), (20, 9), (37, 255), (65, 256), (40, 521)])
def test_flip_map_is_that_of_nvidias_library(size):
    render, reference = noisy_pair(*size)
    inverted = render.copy()
    inverted[size[0] // 2 :] = 1 - inverted[size[0] // 2 :]
    for one, other in ((render, reference), (reference, render), (render, inverted)):
        expected = by_library(one, other)
        error, mean = metrics.flip(one, other)
        np.testing.assert_allclose(error, expected, atol=2e-7)
        assert mean == pytest.approx(expected.mean(dtype=np.float64), abs=1e-7)


def test_flip_map_of_gray_images_is_that_of_nvidias_library():
    render, reference = (np.repeat(image[..., :1], 3, axis=2) for image in noisy_pair(50, 70))
    np.testing.assert_allclose(flip_error(render, reference, 67.0), by_library(render, reference), atol=2e-7)


@pytest.mark.parametrize("pixels_per_degree", [11.0, 33.3, 90.0])
def test_flip_map_for_other_screens_is_that_of_nvidias_library(pixels_per_degree):
    render, reference = noisy_pair(60, 80)
    error = flip_error(render, reference, pixels_per_degree)
    np.testing.assert_allclose(error, by_library(render, reference, pixels_per_degree), atol=2e-7)


def test_flip_of_equal_images_is_zero():
    render, _ = noisy_pair(40, 300)
    assert not metrics.flip(render, render).error.any()


def test_flip_map_is_the_same_on_any_number_of_threads():
    render, reference = noisy_pair(161, 300)
    one = flip_error(render, reference, 67.0)
    for threads in (2, 3, 5):
        assert flip_error(render, reference, 67.0, threads).tobytes() == one.tobytes()


def test_masked_flip_is_the_mean_over_the_valid_pixels():
    render, reference = noisy_pair(50, 60)
    weight = np.zeros((50, 60), np.float32)
    weight[10:20, 30:] = 1
    error, mean = metrics.flip(render, reference, weight)
    assert mean == pytest.approx(error[10:20, 30:].mean(dtype=np.float64), abs=1e-12)
    assert np.isnan(metrics.flip(render, reference, np.zeros_like(weight)).mean)

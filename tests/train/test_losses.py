"""Losses against scikit-image, torch's autograd and sums done by hand."""

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity

from octasplat.engine.train.optimization.losses import gaussian_window, pixel_loss, ray_errors, ssim_loss


def patches(seed: int = 0, count: int = 3, side: int = 24) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    target = rng.random((count, side, side, 3)).astype(np.float32)
    render = np.clip(target + 0.2 * rng.normal(size=target.shape), 0, 1).astype(np.float32)
    return render, target


def test_ssim_equals_scikit_image() -> None:
    render, target = patches()
    inner = []
    for x, y in zip(render, target, strict=True):
        _, full = structural_similarity(
            x.astype(np.float64), y.astype(np.float64), gaussian_weights=True, sigma=1.5,
            use_sample_covariance=False, data_range=1.0, channel_axis=-1, full=True,
        )  # fmt: skip
        inner.append(full[5:-5, 5:-5])
    loss, _ = ssim_loss(render, target)
    assert loss == pytest.approx(1 - np.mean(inner), abs=1e-5)


def test_equal_patches_have_no_loss_and_no_gradient() -> None:
    _, target = patches()
    loss, gradient = ssim_loss(target, target)
    assert loss == pytest.approx(0, abs=1e-6)
    assert np.abs(gradient).max() < 1e-7


def autograd_of_ssim(render: np.ndarray, target: np.ndarray) -> tuple[float, np.ndarray]:
    window = torch.tensor(gaussian_window(), dtype=torch.float64)
    kernel = torch.outer(window, window)[None, None].expand(3, 1, 11, 11)

    def blur(images: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.conv2d(images, kernel, groups=3)

    x = torch.tensor(render, dtype=torch.float64).permute(0, 3, 1, 2).requires_grad_()
    y = torch.tensor(target, dtype=torch.float64).permute(0, 3, 1, 2)
    mx, my = blur(x), blur(y)
    covariance = blur(x * y) - mx * my
    top = (2 * mx * my + 1e-4) * (2 * covariance + 9e-4)
    bottom = (mx**2 + my**2 + 1e-4) * (blur(x * x) - mx**2 + blur(y * y) - my**2 + 9e-4)
    loss = 1 - (top / bottom).mean()
    (gradient,) = torch.autograd.grad(loss, x)
    return loss.item(), gradient.permute(0, 2, 3, 1).numpy()


@pytest.mark.parametrize("side", [11, 16, 24])
def test_ssim_gradient_matches_autograd(side: int) -> None:
    render, target = patches(side=side)
    loss, gradient = ssim_loss(render, target)
    expected_loss, expected = autograd_of_ssim(render, target)
    assert loss == pytest.approx(expected_loss, abs=1e-5)
    np.testing.assert_allclose(gradient, expected, atol=1e-4 * np.abs(expected).max())


def test_gradient_of_ssim_on_nearly_flat_patches() -> None:
    rng = np.random.default_rng(1)
    target = np.full((1, 20, 20, 3), 0.7, np.float32)
    render = (0.6 + 1e-3 * rng.normal(size=target.shape)).astype(np.float32)
    _, gradient = ssim_loss(render, target)
    _, expected = autograd_of_ssim(render, target)
    np.testing.assert_allclose(gradient, expected, atol=1e-2 * np.abs(expected).max())


def test_pixel_loss_by_hand() -> None:
    render = np.array([[0.5, 0.5, 0.5], [1.0, 0.0, 0.25]], np.float32)
    target = np.array([[0.25, 0.5, 0.75], [0.0, 0.0, 0.5]], np.float32)
    loss = pixel_loss(render, target, np.ones(2, np.float32), l1=0.5, l2=2.0)
    absolute, squared = 0.25 + 0.25 + 1 + 0.25, 3 * 0.0625 + 1
    assert loss.value == pytest.approx(0.5 * absolute / 6 + 2 * squared / 6)
    assert loss.squared_error == pytest.approx(squared / 6)
    difference = render - target
    np.testing.assert_allclose(loss.gradient, (0.5 * np.sign(difference) + 4 * difference) / 6, rtol=1e-6)
    np.testing.assert_allclose(
        ray_errors(render, target, np.array([1, 0.5], np.float32)), [0.5 / 3, 0.625 / 3], rtol=1e-6
    )


def test_rays_without_weight_do_not_count() -> None:
    rng = np.random.default_rng(0)
    render, target = (rng.random((10, 3)).astype(np.float32) for _ in range(2))
    weight = (np.arange(10) < 6).astype(np.float32)
    masked = pixel_loss(render, target, weight, l1=0.8, l2=0.3)
    alone = pixel_loss(render[:6], target[:6], np.ones(6, np.float32), l1=0.8, l2=0.3)
    assert masked.value == pytest.approx(alone.value)
    assert masked.squared_error == pytest.approx(alone.squared_error)
    np.testing.assert_allclose(masked.gradient[:6], alone.gradient, rtol=1e-6)
    assert not masked.gradient[6:].any() and not ray_errors(render, target, weight)[6:].any()
    nothing = pixel_loss(render, target, np.zeros(10, np.float32), l1=0.8, l2=0.3)
    assert nothing.value == 0 and not nothing.gradient.any()


def test_pixel_gradient_is_the_derivative() -> None:
    rng = np.random.default_rng(0)
    render, target = (rng.random((8, 3)).astype(np.float32) for _ in range(2))
    weight = rng.integers(0, 2, 8).astype(np.float32)
    x = torch.tensor(render, dtype=torch.float64, requires_grad=True)
    difference = (x - torch.tensor(target, dtype=torch.float64)) * torch.tensor(weight)[:, None]
    total = (0.7 * difference.abs() + 0.4 * difference**2).sum() / (3 * weight.sum())
    (expected,) = torch.autograd.grad(total, x)
    loss = pixel_loss(render, target, weight, l1=0.7, l2=0.4)
    assert loss.value == pytest.approx(total.item(), rel=1e-6)
    np.testing.assert_allclose(loss.gradient, expected.numpy(), atol=1e-7)

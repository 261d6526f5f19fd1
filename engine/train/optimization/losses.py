"""Losses on a batch of rays, with their gradients written out (no autograd on the hot path)."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32
from scipy.ndimage import correlate1d

from octasplat.engine.core.compilation import run_ranges
from octasplat.engine.core.threads import threads_in_use
from octasplat.engine.train.config import LossWeights
from octasplat.engine.train.kernels.losses import CHUNKS, PixelTerms, mean_errors, pixel_terms
from octasplat.engine.train.sampling.batches import Batch

SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2
SSIM_WINDOW, SSIM_SIGMA = 11, 1.5


def gaussian_window() -> Float32[np.ndarray, " w"]:
    """Return the normalised 11-tap Gaussian window (sigma 1.5) of SSIM."""
    x = np.arange(SSIM_WINDOW) - SSIM_WINDOW // 2
    window = np.exp(-(x**2) / (2 * SSIM_SIGMA**2))
    return (window / window.sum()).astype(np.float32)


def _gaussian_blur(images: Float32[np.ndarray, "p h w c"]) -> Float32[np.ndarray, "p h w c"]:
    window = gaussian_window()
    rows = correlate1d(images, window, axis=1, mode="constant")
    return correlate1d(rows, window, axis=2, mode="constant")


def ssim_loss(
    render: Float32[np.ndarray, "p h w 3"], target: Float32[np.ndarray, "p h w 3"]
) -> tuple[float, Float32[np.ndarray, "p h w 3"]]:
    """Return 1 - SSIM over the patches' interior, where windows are whole, and its gradient by ``render``.

    The formula of "Image Quality Assessment: From Error Visibility to Structural Similarity"
    (https://doi.org/10.1109/TIP.2003.819861) with its 11 x 11 Gaussian window; the mean is over patches,
    interior pixels and channels.
    """
    x, y = render, target
    mu_x, mu_y = _gaussian_blur(x), _gaussian_blur(y)
    var_x = _gaussian_blur(x * x) - mu_x * mu_x
    var_y = _gaussian_blur(y * y) - mu_y * mu_y
    cov = _gaussian_blur(x * y) - mu_x * mu_y
    a1, a2 = 2 * mu_x * mu_y + np.float32(SSIM_C1), 2 * cov + np.float32(SSIM_C2)
    b1, b2 = mu_x * mu_x + mu_y * mu_y + np.float32(SSIM_C1), var_x + var_y + np.float32(SSIM_C2)
    ssim = a1 * a2 / (b1 * b2)
    edge = SSIM_WINDOW // 2
    inner = np.zeros((*x.shape[:3], 1), np.float32)
    inner[:, edge:-edge, edge:-edge] = 1.0
    count = float(inner.sum()) * x.shape[-1]
    loss = 1.0 - float((ssim * inner).sum(dtype=np.float64)) / count
    weight = -inner / np.float32(count)
    # Through the mean, the variance of x and the covariance; a symmetric window is its own adjoint.
    d_var = weight * -ssim / b2
    d_cov = weight * 2 * a1 / (b1 * b2)
    d_mu = weight * (2 * mu_y * a2 / (b1 * b2) - ssim * 2 * mu_x / b1)
    gradient = (
        _gaussian_blur(d_mu - 2 * mu_x * d_var - mu_y * d_cov)
        + 2 * x * _gaussian_blur(d_var)
        + y * _gaussian_blur(d_cov)
    )
    return loss, gradient.astype(np.float32)


@dataclass(frozen=True)
class BatchLoss:
    """A loss and its gradient by the rendered colors.

    Attributes:
        value: the loss.
        gradient: by the colors.
        squared_error: mean over the rays of non-zero weight and the channels.
    """

    value: float
    gradient: Float32[np.ndarray, "r 3"]
    squared_error: float


def batch_loss(render: Float32[np.ndarray, "r 3"], batch: Batch, weights: LossWeights) -> BatchLoss:
    """Return all terms by the rendered colors: those of the pixels, and SSIM where the batch has patches."""
    target = batch.target_srgb
    pixel = pixel_loss(render, target, batch.weight, l1=weights.l1, l2=weights.l2)
    if not batch.ssim_patch_count or weights.ssim == 0:
        return pixel
    structure, grad_patches = _ssim_term(render, target, batch)
    gradient = pixel.gradient.copy()
    gradient[-len(grad_patches) :] += np.float32(weights.ssim) * grad_patches
    return BatchLoss(pixel.value + weights.ssim * structure, gradient, pixel.squared_error)


def ray_errors(
    render: Float32[np.ndarray, "r 3"],
    target: Float32[np.ndarray, "r 3"],
    weight: Float32[np.ndarray, " r"],
) -> Float32[np.ndarray, " r"]:
    """Return each ray's mean absolute error, 0 without weight, for densification."""
    errors = np.empty(len(render), np.float32)
    mean_errors(render, target, weight, errors)
    return errors


def _ssim_term(
    render: Float32[np.ndarray, "r 3"], target: Float32[np.ndarray, "r 3"], batch: Batch
) -> tuple[float, Float32[np.ndarray, "p 3"]]:
    """Return 1 - SSIM of the batch's patches and its gradient; masked pixels take the photograph's color."""
    count = batch.ssim_patch_count * batch.patch_side**2
    shape = (batch.ssim_patch_count, batch.patch_side, batch.patch_side, 3)
    weight = batch.weight[-count:, None]
    rendered = target[-count:]
    # masked pixels take the photograph's color: no difference, no gradient
    mixed = render[-count:] * weight + rendered * (1 - weight)
    value, gradient = ssim_loss(mixed.reshape(shape), rendered.reshape(shape))
    return value, gradient.reshape(-1, 3) * weight


def pixel_loss(
    render: Float32[np.ndarray, "r 3"],
    target: Float32[np.ndarray, "r 3"],
    weight: Float32[np.ndarray, " r"],
    *,
    l1: float,
    l2: float,
) -> BatchLoss:
    """Return L1 and squared error, averaged over the rays of non-zero weight and the channels."""
    valid = max(float(weight.sum(dtype=np.float64)), 1.0)
    gradient, sums = np.empty(render.shape, np.float32), np.empty((CHUNKS, 2))
    run_ranges(
        pixel_terms, threads_in_use(), CHUNKS,
        PixelTerms(
            render, target, weight, np.float32(l1 / (3 * valid)), np.float32(2 * l2 / (3 * valid)), gradient
        ),
        sums, grain=1,
    )  # fmt: skip
    absolute, squared = sums.sum(axis=0) / (3 * valid)
    return BatchLoss(float(l1 * absolute + l2 * squared), gradient, float(squared))

"""Arrays that the tracer's kernels fill."""

import numpy as np
from jaxtyping import Float32
from numpy.typing import DTypeLike

from engine.trace.protocol import GaussianGradients, TraceResult


def aligned_empty(shape: tuple[int, ...]) -> Float32[np.ndarray, "..."]:
    """Uninitialised float32 array whose memory starts on a cache line (64 bytes)."""
    size = int(np.prod(shape)) * 4
    raw = np.empty(size + 64, np.uint8)
    offset = -raw.ctypes.data % 64
    return raw[offset : offset + size].view(np.float32).reshape(shape)


class Scratch:
    """Memory that is used again: fresh pages for large arrays would cost as much as the work done in them."""

    def __init__(self) -> None:
        self._kept: dict[str, np.ndarray] = {}

    def take(self, name: str, shape: tuple[int, ...], dtype: DTypeLike) -> np.ndarray:
        """Uninitialised array, valid until the same name is taken again."""
        size = int(np.prod(shape))
        kept = self._kept.get(name)
        if kept is None or kept.size < size or kept.dtype != np.dtype(dtype):
            kept = self._kept[name] = np.empty(size + size // 4, dtype)
        return kept[:size].reshape(shape)


def empty_result(rays: int, features: int) -> TraceResult:
    """Uninitialised outputs of ``rays`` rays."""
    return TraceResult(
        rgb_srgb=np.empty((rays, 3), np.float32),
        transmittance=np.empty(rays, np.float32),
        depth_sum=np.empty(rays, np.float32),
        depth_median=np.empty(rays, np.float32),
        normal_world=np.empty((rays, 3), np.float32),
        features=np.empty((rays, features), np.float32),
        hit_counts=np.empty(rays, np.int32),
    )


def empty_gradients(gaussians: int, basis_count: int, features: int) -> GaussianGradients:
    """Uninitialised gradients of ``gaussians`` Gaussians that were hit."""
    return GaussianGradients(
        ids=np.empty(gaussians, np.int32),
        means_world=np.empty((gaussians, 3), np.float32),
        quats_wxyz=np.empty((gaussians, 4), np.float32),
        log_scales=np.empty((gaussians, 2), np.float32),
        opacity_logits=np.empty(gaussians, np.float32),
        sh=np.empty((gaussians, basis_count, 3), np.float32),
        features=np.empty((gaussians, features), np.float32),
        weight_sums=np.empty(gaussians, np.float32),
        error_sums=np.empty(gaussians, np.float32),
        hit_counts=np.empty(gaussians, np.int32),
    )


def contiguous(array: np.ndarray) -> np.ndarray:
    """``array`` as contiguous float32, itself where it is that already."""
    return np.ascontiguousarray(array, dtype=np.float32)


def or_zeros(array: np.ndarray | None, shape: tuple[int, ...]) -> np.ndarray:
    """``array``, or zeros where there is none."""
    return np.zeros(shape, np.float32) if array is None else contiguous(array)

"""Buffers that the tracer's kernels fill."""

import math
import weakref
from itertools import accumulate

import numpy as np
from jaxtyping import Float32, UInt8
from numpy.typing import DTypeLike

from octasplat.engine.trace.cpu.kernels.kernel_args import (
    GaussianGradientArrays,
    OutputArrays,
    OutputGradientArrays,
)
from octasplat.engine.trace.kernels.native import CACHE_LINE_BYTES
from octasplat.engine.trace.protocol import GaussianGradients, TraceGradients, TraceResult


def aligned_empty(shape: tuple[int, ...]) -> Float32[np.ndarray, "..."]:
    """Return an uninitialised float32 array aligned to a cache line."""
    return _aligned_bytes(int(np.prod(shape)) * 4).view(np.float32).reshape(shape)


def _aligned_bytes(size: int) -> UInt8[np.ndarray, " b"]:
    raw = np.empty(size + CACHE_LINE_BYTES, np.uint8)
    offset = -raw.ctypes.data % CACHE_LINE_BYTES
    return raw[offset : offset + size]


class ArrayPool:
    """Pool of arrays whose memory is reused once no array refers to it.

    Fresh pages for large arrays would cost as much as the work done in them. An array, its slices and views
    keep their memory; when the last of them is gone, the memory returns here. So a recording owns what it
    holds for as long as it lives, and many may live at once.
    """

    def __init__(self) -> None:
        self._free: list[np.ndarray] = []

    def empty(self, *specs: tuple[tuple[int, ...], DTypeLike]) -> list[np.ndarray]:
        """Return uninitialised arrays of these shapes and types, each aligned to a cache line.

        They lie in one block, which returns when the last of them is gone; pages are only taken when they are
        written to.
        """
        sizes = [math.prod(shape) * np.dtype(dtype).itemsize for shape, dtype in specs]
        ends = list(accumulate(-(-size // CACHE_LINE_BYTES) * CACHE_LINE_BYTES for size in sizes))
        size = ends[-1]
        # at most four times too large, so that small arrays do not hold large blocks
        fitting = [block for block in self._free if size <= block.nbytes <= 4 * size]
        if fitting:
            block = min(fitting, key=lambda block: block.nbytes)
            self._free = [other for other in self._free if other is not block]
        else:
            # a quarter more, for the somewhat larger requests that follow
            block = _aligned_bytes(size + size // 4)
        lease = _BlockLease(block)
        # at exit nothing is reused
        weakref.finalize(lease, _return_block, weakref.ref(self), block).atexit = False
        held = np.asarray(lease)
        return [
            held[begin : begin + size].view(dtype).reshape(shape)
            # the last of the begins is the end of all
            for begin, size, (shape, dtype) in zip([0, *ends], sizes, specs, strict=False)
        ]

    def _release(self, block: np.ndarray) -> None:
        self._free.append(block)
        if len(self._free) > _MAX_FREE_BLOCKS:
            del self._free[0]


_MAX_FREE_BLOCKS = 32
"""Blocks kept for later; the one that has waited longest goes first."""


class _BlockLease:
    """Owner of a block's arrays, which returns the block to its pool when the last of them is freed."""

    def __init__(self, block: np.ndarray) -> None:
        self.__array_interface__ = block.__array_interface__


def _return_block(pool: "weakref.ref[ArrayPool]", block: np.ndarray) -> None:
    owner = pool()
    if owner is not None:
        owner._release(block)


def empty_result(rays: int, features: int) -> TraceResult:
    """Return uninitialised outputs of ``rays`` rays."""
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
    """Return uninitialised gradients of ``gaussians`` Gaussians that were hit."""
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


def gradient_arrays(gradients: GaussianGradients) -> GaussianGradientArrays:
    """Return the arrays of ``gradients`` as kernels take them."""
    g = gradients
    return GaussianGradientArrays(
        ids=g.ids,
        means=g.means_world,
        quats=g.quats_wxyz,
        log_scales=g.log_scales,
        logits=g.opacity_logits,
        sh=g.sh,
        features=g.features,
        weights=g.weight_sums,
        errors=g.error_sums,
        counts=g.hit_counts,
    )


def output_arrays(result: TraceResult) -> OutputArrays:
    """Return the arrays of ``result`` as kernels take them."""
    r = result
    return OutputArrays(
        rgb=r.rgb_srgb,
        transmittance=r.transmittance,
        depth_sum=r.depth_sum,
        depth_median=r.depth_median,
        normal=r.normal_world,
        features=r.features,
        counts=r.hit_counts,
    )


def output_gradient_arrays(gradients: TraceGradients, rays: int, features: int) -> OutputGradientArrays:
    """Return ``gradients`` as kernels take them, zeros for None."""
    g = gradients
    return OutputGradientArrays(
        rgb=contiguous_float32(g.rgb_srgb),
        transmittance=zeros_if_none(g.transmittance, (rays,)),
        features=zeros_if_none(g.features, (rays, features)),
        ray_errors=zeros_if_none(g.ray_errors, (rays,)),
        depth_sum=zeros_if_none(g.depth_sum, (rays,)),
        depth_median=zeros_if_none(g.depth_median, (rays,)),
        normal=zeros_if_none(g.normal_world, (rays, 3)),
        has_geometry=g.has_geometry,
    )


def contiguous_float32(array: np.ndarray) -> np.ndarray:
    """Return ``array`` as contiguous float32, itself if it is that already."""
    return np.ascontiguousarray(array, dtype=np.float32)


def zeros_if_none(array: np.ndarray | None, shape: tuple[int, ...]) -> np.ndarray:
    """Return ``array``, or zeros if it is None."""
    return np.zeros(shape, np.float32) if array is None else contiguous_float32(array)

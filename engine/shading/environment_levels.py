"""An environment made ready for split-sum shading: blurred levels, each a fixed linear map of its texels.

Level k is what a mirror of a certain roughness sees that looks along its normal; the last is the irradiance
over pi. Since the maps are fixed and linear, gradients go back by their transposes.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from jaxtyping import Float, Float32, Float64, Int32, Int64

from octasplat.engine.core.compilation import run_ranges
from octasplat.engine.core.errors import ConfigError
from octasplat.engine.core.threads import threads_in_use
from octasplat.engine.shading.kernels.environment_levels import EnvironmentLevels, lobe_rows, sparse_product

ROUGHNESSES = (0.05, 0.15, 0.3, 0.5, 0.75, 1.0)
"""Perceptual roughness of each level; the first is the map itself."""
_HALVINGS = (0, 1, 2, 3, 3, 3, 3)
_SOURCES = (0, 1, 2, 2, 3, 3, 3)
"""How often each level, and the map that it is made from, is halved; the last is the irradiance."""
_LEAST = (0.0, 3e-3, 3e-3, 1e-3, 1e-3, 1e-3, 0.0)
"""Share of a lobe's largest weight below which a texel is left out."""
MIN_HEIGHT = 16


@dataclass(frozen=True)
class _SparseRows:
    starts: Int64[np.ndarray, " r1"]
    columns: Int32[np.ndarray, " k"]
    weights: Float32[np.ndarray, " k"]

    def multiply(self, values: Float[np.ndarray, "c 3"], out: Float[np.ndarray, "r 3"]) -> None:
        run_ranges(
            sparse_product, threads_in_use(), len(self.starts) - 1,
            self.starts, self.columns, self.weights, values, out,
        )  # fmt: skip

    def transpose(self, columns: int) -> "_SparseRows":
        from scipy.sparse import csr_matrix  # here, as every render imports this module

        shape = (len(self.starts) - 1, columns)
        transposed = csr_matrix((self.weights, self.columns, self.starts), shape).T.tocsr()
        transposed.sort_indices()
        return _SparseRows(
            transposed.indptr.astype(np.int64),
            transposed.indices.astype(np.int32),
            transposed.data.astype(np.float32),
        )


class EnvironmentPrefilter:
    """The linear maps for an environment of ``height`` x 2 ``height`` texels.

    Raises:
        ConfigError: the height is no multiple of 8, or too small.
    """

    def __init__(self, height: int) -> None:
        if height % 8 or height < MIN_HEIGHT:
            raise ConfigError(f"An environment has {height} rows; make that a multiple of 8, 16 at least.")
        self.height = height
        self.heights = np.array([height >> halving for halving in _HALVINGS], np.int64)
        self.offsets = np.concatenate([[0], np.cumsum(2 * self.heights**2)])
        self._maps: list[_SparseRows] = []
        for level in range(1, len(_HALVINGS)):
            alpha = ROUGHNESSES[level] ** 2 if level < len(ROUGHNESSES) else -1.0
            # blurrier levels are made from coarser maps: fewer texels a lobe
            source = height >> _SOURCES[level]
            self._maps.append(_lobe_matrix(int(self.heights[level]), source, alpha, _LEAST[level]))

    @cached_property
    def _transposed_filters(self) -> list[_SparseRows]:
        """Return the transposed filters, which training alone needs."""
        sources = [self.height >> halving for halving in _SOURCES[1:]]
        return [rows.transpose(2 * s * s) for rows, s in zip(self._maps, sources, strict=True)]

    def levels(self, radiance_linear: Float[np.ndarray, "h w 3"]) -> EnvironmentLevels:
        """Return all levels of an environment."""
        texels = np.empty((int(self.offsets[-1]), 3), np.float32)
        halved = [np.ascontiguousarray(radiance_linear.reshape(-1, 3), np.float32)]
        for _ in range(max(_SOURCES)):
            halved.append(_halve(halved[-1]))
        texels[: self.offsets[1]] = halved[0]
        for level, rows in enumerate(self._maps, start=1):
            rows.multiply(halved[_SOURCES[level]], texels[self.offsets[level] : self.offsets[level + 1]])
        return EnvironmentLevels(texels, self.offsets[:-1], self.heights, np.array(ROUGHNESSES))

    def backward(self, grad_texels: Float64[np.ndarray, "t 3"]) -> Float64[np.ndarray, "h w 3"]:
        """Return gradients by the environment's texels from those by the texels of all its levels."""
        sizes = [2 * (self.height >> halving) ** 2 for halving in range(max(_SOURCES) + 1)]
        sums = [np.zeros((size, 3)) for size in sizes]
        sums[0] += grad_texels[: self.offsets[1]]  # the first level is the map itself
        for level, transposed in enumerate(self._transposed_filters, start=1):
            part = np.empty_like(sums[_SOURCES[level]])
            transposed.multiply(grad_texels[self.offsets[level] : self.offsets[level + 1]], part)
            sums[_SOURCES[level]] += part
        for halving in range(max(_SOURCES), 0, -1):
            sums[halving - 1] += _halve_backward(sums[halving])
        return sums[0].reshape(self.height, 2 * self.height, 3)


@lru_cache(maxsize=4)
def prefilter_for(height: int) -> EnvironmentPrefilter:
    """Return the prefilter for environments of ``height`` rows, made once."""
    return EnvironmentPrefilter(height)


def solid_angles(height: int) -> Float64[np.ndarray, " h"]:
    """Return the solid angle of a texel of each row, steradians."""
    edges = np.cos(np.arange(height + 1) / height * np.pi)
    return (edges[:-1] - edges[1:]) * np.pi / height


def resample_environment(
    radiance_linear: Float[np.ndarray, "h w 3"], height: int
) -> Float32[np.ndarray, "a b 3"]:
    """Return an environment in ``height`` x 2 ``height`` texels: solid-angle means where they are fewer."""
    rows, columns = radiance_linear.shape[:2]
    if (rows, columns) == (height, 2 * height):
        return radiance_linear.astype(np.float32)
    angles = solid_angles(rows)
    down = _interval_overlaps(rows, height) * angles
    down /= down.sum(axis=1, keepdims=True)
    across = _interval_overlaps(columns, 2 * height)
    across /= across.sum(axis=1, keepdims=True)
    return np.einsum("ai,bj,ijc->abc", down, across, radiance_linear, optimize=True).astype(np.float32)


def _interval_overlaps(old: int, new: int) -> Float64[np.ndarray, "n o"]:
    """Return how much of each old cell lies in each new one, where both divide the same length."""
    low = np.maximum(np.arange(new)[:, None] / new, np.arange(old) / old)
    high = np.minimum(np.arange(1, new + 1)[:, None] / new, np.arange(1, old + 1) / old)
    return np.maximum(high - low, 0.0)


def _row_fractions(height: int) -> Float64[np.ndarray, "h2 2"]:
    """Return the share of the upper and of the lower row in each pair of rows."""
    angles = solid_angles(height).reshape(-1, 2)
    return angles / angles.sum(axis=1, keepdims=True)


def _halve(texels: Float[np.ndarray, "t 3"]) -> Float[np.ndarray, "s 3"]:
    height = int(np.sqrt(len(texels) // 2))
    pairs = texels.reshape(height // 2, 2, height, 2, 3).mean(axis=3)
    shares = _row_fractions(height)
    mixed = pairs[:, 0] * shares[:, :1, None] + pairs[:, 1] * shares[:, 1:, None]
    return mixed.reshape(-1, 3).astype(texels.dtype)


def _halve_backward(gradients: Float64[np.ndarray, "s 3"]) -> Float64[np.ndarray, "t 3"]:
    """Apply the transpose of :func:`_halve`."""
    half = int(np.sqrt(len(gradients) // 2))
    rows = gradients.reshape(half, 1, 2 * half, 1, 3) * (_row_fractions(2 * half) / 2)[:, :, None, None, None]
    return np.broadcast_to(rows, (half, 2, 2 * half, 2, 3)).reshape(-1, 3)


def _lobe_matrix(height: int, source: int, alpha: float, least: float) -> _SparseRows:
    starts = np.empty(2 * height * height + 1, np.int64)
    nothing = np.empty(0, np.int32), np.empty(0, np.float32)
    lobe = (height, source, alpha, least, starts)
    # first only counted, so that the arrays have the right size
    run_ranges(lobe_rows, threads_in_use(), len(starts) - 1, *lobe, *nothing, True)
    starts[0] = 0
    np.cumsum(starts, out=starts)
    columns, weights = np.empty(starts[-1], np.int32), np.empty(starts[-1], np.float32)
    run_ranges(lobe_rows, threads_in_use(), len(starts) - 1, *lobe, columns, weights, False)
    return _SparseRows(starts, columns, weights)

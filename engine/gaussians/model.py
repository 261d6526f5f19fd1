"""Flat Gaussians as plain arrays."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float32

from octasplat.engine.gaussians.channels import Channels, check_row_count
from octasplat.engine.gaussians.frames import rotation_matrices
from octasplat.engine.gaussians.rows import (
    RowIndex,
    concatenate_rows,
    map_rows,
    overwrite_rows,
    row_arrays,
    select_rows,
    view_rows,
)

FLAT_SCALE = 1e-5
"""Standard deviation along the normal, s1 = eps of the paper, in world units."""

MAX_LOG_SCALE = float(np.log(np.finfo(np.float32).max)) - 1e-3
"""A little less than that of the largest standard deviation, whose power may be rounded to infinity."""

SH_C0 = 0.28209479177387814
"""Value of the constant spherical harmonic."""


_CHECKED_ROWS = 1 << 16
"""At a time, as what is made of a block stays in the cache."""


@dataclass
class FlatGaussians:
    """Parameters of ``n`` flat Gaussians, before their activations, as in the 3DGS family.

    Attributes:
        means_world: centres m, in world units.
        quats_wxyz: rotations, not necessarily of unit length; the columns of the matrix are the normal r1
            and the in-plane axes r2, r3.
        log_scales: ln of the standard deviations s2, s3 along r2, r3, world units.
        opacity_logits: opacity is their sigmoid.
        sh: spherical-harmonic coefficients of the display (sRGB-encoded) color, coefficient-major, with
            1, 4, 9 or 16 coefficients; color = max(0, 1/2 + sum_k sh[k] Y_k(ray direction)).
        channels: what else is known of each Gaussian, by name.
    """

    means_world: Float32[np.ndarray, "n 3"]
    quats_wxyz: Float32[np.ndarray, "n 4"]
    log_scales: Float32[np.ndarray, "n 2"]
    opacity_logits: Float32[np.ndarray, " n"]
    sh: Float32[np.ndarray, "n k 3"]
    channels: Channels = field(default_factory=Channels)

    def __post_init__(self) -> None:
        """Check that channels have as many rows as there are Gaussians."""
        check_row_count(self.channels, len(self))

    def __len__(self) -> int:
        return len(self.means_world)

    @property
    def sh_degree(self) -> int:
        """Return the degree of the spherical harmonics, 0 to 3."""
        return int(np.sqrt(self.sh.shape[1])) - 1

    @property
    def scales(self) -> Float32[np.ndarray, "n 2"]:
        """Return the standard deviations s2, s3, world units."""
        return np.exp(self.log_scales)

    @property
    def opacities(self) -> Float32[np.ndarray, " n"]:
        """Return the opacities in (0, 1)."""
        decay = np.exp(-np.abs(self.opacity_logits.astype(np.float64)))  # never overflows
        return (np.where(self.opacity_logits >= 0, 1.0, decay) / (1.0 + decay)).astype(np.float32)

    @property
    def rotations(self) -> Float32[np.ndarray, "n 3 3"]:
        """Return the rotation matrices; columns are r1 (the normal), r2 and r3."""
        return rotation_matrices(self.quats_wxyz)

    @property
    def base_rgb_srgb(self) -> Float32[np.ndarray, "n 3"]:
        """Return the constant harmonic's display color, 1/2 + C0 sh[0], clipped below at 0."""
        return np.maximum(0.5 + np.float32(SH_C0) * self.sh[:, 0], 0.0).astype(np.float32)

    def select(self, index: RowIndex) -> "FlatGaussians":
        """Return a copy of the Gaussians at ``index`` (integers, a mask or a slice)."""
        return select_rows(self, index)

    def view(self, part: slice) -> "FlatGaussians":
        """Return the Gaussians of a slice, not copied."""
        return view_rows(self, part)

    def put(self, index: RowIndex, others: "FlatGaussians") -> None:
        """Overwrite the Gaussians at ``index`` by ``others``, in place."""
        overwrite_rows(self, index, others)

    def with_base_color_only(self) -> "FlatGaussians":
        """Return the Gaussians, not copied, with the constant color only and no channels."""
        return replace(self, sh=self.sh[:, :1], channels=Channels())

    def with_channels(self, channels: Mapping[str, np.ndarray]) -> "FlatGaussians":
        """Return the Gaussians, not copied, with ``channels`` added or replaced.

        Args:
            channels: float32 arrays of shape (n, f), not copied either.

        Raises:
            ConfigError: a name cannot be used.
            ValueError: an array has another type or shape.
        """
        return replace(self, channels=Channels({**self.channels, **channels}))

    def without_channels(self, names: Sequence[str]) -> "FlatGaussians":
        """Return the Gaussians, not copied, without the channels ``names``."""
        return replace(self, channels=Channels({n: a for n, a in self.channels.items() if n not in names}))

    def copy(self) -> "FlatGaussians":
        """Return an independent copy."""
        return map_rows(self, lambda array: array.copy())

    def is_finite(self) -> bool:
        """Return whether every parameter is a finite number."""
        return all(
            bool(np.isfinite(array[start : start + _CHECKED_ROWS]).all())
            for array in row_arrays(self).values()
            for start in range(0, len(array), _CHECKED_ROWS)
        )


def concatenate(parts: list[FlatGaussians]) -> FlatGaussians:
    """Return all Gaussians of ``parts``, in order; the parts have the same degree and channels."""
    return concatenate_rows(parts)

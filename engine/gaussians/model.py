"""A set of flat Gaussians as plain arrays."""

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float32

from engine.gaussians.frames import rotation_matrices

FLAT_SCALE = 1e-5
"""Standard deviation along the normal, s1 = eps of the paper, in world units."""

SH_C0 = 0.28209479177387814
"""Value of the constant spherical harmonic."""


@dataclass
class FlatGaussians:
    """Parameters of ``n`` flat Gaussians, before their activations, as in the 3DGS family.

    Attributes:
        means_world: centres m, in world units.
        quats_wxyz: rotations, not necessarily of unit length; the columns of the matrix are the normal r1
            and the in-plane axes r2, r3.
        log_scales: ln of the standard deviations s2, s3 along r2, r3, world units.
        opacity_logits: opacity is their sigmoid.
        sh: spherical-harmonic coefficients of the display (sRGB-encoded) colour, coefficient-major, with
            1, 4, 9 or 16 coefficients; colour = max(0, 1/2 + sum_k sh[k] Y_k(ray direction)).
    """

    means_world: Float32[np.ndarray, "n 3"]
    quats_wxyz: Float32[np.ndarray, "n 4"]
    log_scales: Float32[np.ndarray, "n 2"]
    opacity_logits: Float32[np.ndarray, " n"]
    sh: Float32[np.ndarray, "n k 3"]

    def __len__(self) -> int:
        return len(self.means_world)

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 3."""
        return int(np.sqrt(self.sh.shape[1])) - 1

    @property
    def scales(self) -> Float32[np.ndarray, "n 2"]:
        """Standard deviations s2, s3, world units."""
        return np.exp(self.log_scales)

    @property
    def opacities(self) -> Float32[np.ndarray, " n"]:
        """Opacities in (0, 1)."""
        decay = np.exp(-np.abs(self.opacity_logits.astype(np.float64)))  # never overflows
        return (np.where(self.opacity_logits >= 0, 1.0, decay) / (1.0 + decay)).astype(np.float32)

    @property
    def rotations(self) -> Float32[np.ndarray, "n 3 3"]:
        """Rotation matrices; columns are r1 (the normal), r2 and r3."""
        return rotation_matrices(self.quats_wxyz)

    @property
    def base_rgb_srgb(self) -> Float32[np.ndarray, "n 3"]:
        """Colour of the constant harmonic alone, 1/2 + C0 sh[0], clipped below at 0; display values."""
        return np.maximum(0.5 + np.float32(SH_C0) * self.sh[:, 0], 0.0).astype(np.float32)

    def select(self, index: np.ndarray | slice) -> "FlatGaussians":
        """The Gaussians at ``index`` (integers, a mask or a slice), copied."""
        return FlatGaussians(
            **{field.name: getattr(self, field.name)[index].copy() for field in fields(self)}
        )

    def copy(self) -> "FlatGaussians":
        """An independent copy."""
        return self.select(np.arange(len(self)))

    def is_finite(self) -> bool:
        """Whether every parameter is a finite number."""
        return all(bool(np.isfinite(getattr(self, field.name)).all()) for field in fields(self))


def concatenate(parts: list[FlatGaussians]) -> FlatGaussians:
    """All Gaussians of ``parts``, in order; the parts share one spherical-harmonic degree."""
    return FlatGaussians(
        **{
            field.name: np.concatenate([getattr(part, field.name) for part in parts])
            for field in fields(FlatGaussians)
        }
    )

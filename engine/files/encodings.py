"""Encodings of colors, opacities, rotations and axes in splat formats, shared by readers and writers."""

from dataclasses import replace
from typing import TypeVar

import numpy as np
from jaxtyping import Float, Float32, Float64, Int, UInt8

from octasplat.engine.gaussians.flattening import GaussianCloud
from octasplat.engine.gaussians.frames import quaternions_from_matrices, rotation_matrices
from octasplat.engine.gaussians.model import SH_C0, FlatGaussians
from octasplat.engine.gaussians.spherical_harmonics import rotate_sh

SceneT = TypeVar("SceneT", FlatGaussians, GaussianCloud)
SQRT_HALF = float(np.sqrt(0.5))
MAX_SH_DEGREE = 3
"""The highest degree of spherical harmonics that scenes have."""
HALF_TURN_SIGNS = np.array([1, -1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], dtype=np.float32)
"""Parity of the 16 harmonics under y -> -y, z -> -z."""


def dropped_sh_message(degree: int) -> tuple[str, ...]:
    """Return what to tell of a file with harmonics of ``degree``, of which only degree 3 can be kept."""
    if degree <= MAX_SH_DEGREE:
        return ()
    return (f"Harmonics of degree {degree} were left out; degree {MAX_SH_DEGREE} is the highest here.",)


def sh0_from_rgb(rgb_srgb: Float[np.ndarray, "n 3"]) -> Float32[np.ndarray, "n 1 3"]:
    """Return the coefficients of the constant harmonic for display colors, without higher ones."""
    return ((rgb_srgb.astype(np.float64) - 0.5) / SH_C0).astype(np.float32)[:, None, :]


def logits_from_bytes(opacities: UInt8[np.ndarray, " n"]) -> Float32[np.ndarray, " n"]:
    """Return the logits of opacities stored as bytes.

    0 and 255 stand for the middle of the numbers that round to them, 1/1020 and 1019/1020, so that no logit
    is infinite and writing gives the same byte again.
    """
    opacity = np.clip(opacities.astype(np.float64) / 255.0, 0.25 / 255.0, 254.75 / 255.0)
    return np.log(opacity / (1.0 - opacity)).astype(np.float32)


def unit_quats(quats: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "n 4"]:
    """Return quaternions normalised in float64."""
    q = quats.astype(np.float64)
    return q / np.linalg.norm(q, axis=1, keepdims=True)


def from_smallest_three(
    small: Float[np.ndarray, "n 3"], largest: Int[np.ndarray, " n"]
) -> Float32[np.ndarray, "n 4"]:
    """Return unit quaternions from all components but the largest, which is positive.

    Args:
        small: the other three, in their order.
        largest: place of the left-out component, 0 to 3, in the order of the result.
    """
    quats = np.empty((len(small), 4), dtype=np.float64)
    left_out = np.sqrt(np.maximum(0.0, 1.0 - np.sum(small.astype(np.float64) ** 2, axis=1)))
    for place in range(4):
        rows = largest == place
        quats[rows] = np.insert(small[rows].astype(np.float64), place, left_out[rows], axis=1)
    return quats.astype(np.float32)


def smallest_three(
    quats: Float[np.ndarray, "n 4"],
) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, " n"]]:
    """Return unit quaternions as the three smallest components and the place of the largest."""
    unit = unit_quats(quats)
    largest = np.argmax(np.abs(unit), axis=1)
    # q and -q are one rotation; what is left out is taken to be positive.
    unit *= np.where(np.take_along_axis(unit, largest[:, None], axis=1) < 0, -1.0, 1.0)
    others = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[largest]
    return np.take_along_axis(unit, others, axis=1), largest


def half_turn_sh(sh: Float32[np.ndarray, "n k 3"]) -> Float32[np.ndarray, "n k 3"]:
    """Return the coefficients of colors rotated by 180 degrees about x; exact, as only signs change."""
    return sh * HALF_TURN_SIGNS[: sh.shape[1], None]


def half_turn_quats(quats_wxyz: Float32[np.ndarray, "n 4"]) -> Float32[np.ndarray, "n 4"]:
    """Return the quaternions of F R F with the half turn F about x.

    That is R turned by F, but for the signs of the two last columns, which make no difference to a Gaussian.
    """
    return quats_wxyz * np.array([1, 1, -1, -1], dtype=np.float32)


def half_turn_points(points: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, "n 3"]:
    """Return points rotated by 180 degrees about x."""
    return points * np.array([1, -1, -1], dtype=np.float32)


def half_turn_gaussians(gaussians: SceneT) -> SceneT:
    """Return Gaussians turned by 180 degrees about x: from y down, z forward to y up, z backward, and back.

    Only signs change, so doing it twice gives the same bits.
    """
    return replace(
        gaussians,
        means_world=half_turn_points(gaussians.means_world),
        quats_wxyz=half_turn_quats(gaussians.quats_wxyz),
        sh=half_turn_sh(gaussians.sh),
    )


def turn_cloud(cloud: GaussianCloud, turn: Float64[np.ndarray, "3 3"]) -> GaussianCloud:
    """Return Gaussians after a rotation or a reflection about the origin, harmonics included."""
    frames = turn @ rotation_matrices(cloud.quats_wxyz.astype(np.float64))
    if np.linalg.det(turn) < 0:
        frames[:, :, 0] *= -1.0  # which way an axis points makes no difference to a Gaussian
    return replace(
        cloud,
        means_world=(cloud.means_world.astype(np.float64) @ turn.T).astype(np.float32),
        quats_wxyz=quaternions_from_matrices(frames).astype(np.float32),
        sh=rotate_sh(cloud.sh, np.broadcast_to(turn, (len(frames), 3, 3))),
    )

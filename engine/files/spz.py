"""SPZ, versions 2, 3 and 4."""

from pathlib import Path

import numpy as np
from jaxtyping import Float32

from engine.errors import SceneFileError
from engine.files.encodings import (
    SQRT_HALF,
    from_smallest_three,
    half_turn_points,
    half_turn_quats,
    half_turn_sh,
    logits_from_bytes,
)
from engine.files.gaussian_ply import MAX_SH_DEGREE
from engine.files.importing import Importer, register
from engine.files.spz_container import ANTIALIASED, GZIP_MAGIC, MAGIC, read_spz
from engine.gaussians.flattening import GaussianCloud

COLOUR_SCALE = 0.15
"""Constant harmonics h are written as the byte 255 (0.15 h + 0.5)."""
LOG_SCALE_STEPS = 16.0
LOG_SCALE_OFFSET = 10.0


def read(path: Path) -> GaussianCloud:
    """Read all Gaussians and turn them from y up to y down.

    Raises:
        SceneFileError: the file is no SPZ, is damaged, or of an unknown version.
    """
    file = read_spz(path)
    if file.count == 0:
        raise SceneFileError(f"{path}: holds no Gaussians.")
    positions, opacities, colours, scales, rotations, harmonics = (
        np.frombuffer(stream, np.uint8).reshape(file.count, -1) for stream in file.streams
    )
    kept = (min(file.sh_degree, MAX_SH_DEGREE) + 1) ** 2
    rest = (harmonics.reshape(file.count, -1, 3)[:, : kept - 1].astype(np.float32) - 128.0) / 128.0
    constant = (colours.astype(np.float32) / 255.0 - 0.5) / COLOUR_SCALE
    sh = np.concatenate([constant[:, None, :], rest], axis=1).astype(np.float32)
    quats = _first_three(rotations) if file.version == 2 else _smallest_three(rotations)
    notes = []
    if file.sh_degree > MAX_SH_DEGREE:
        notes.append(f"Harmonics of degree {file.sh_degree} were left out; degree 3 is the highest here.")
    if file.flags & ANTIALIASED:
        notes.append("The scene was trained with antialiasing, which is not modelled here.")
    return GaussianCloud(
        means_world=half_turn_points(_fixed_point(positions, file.fractional_bits)),
        quats_wxyz=half_turn_quats(quats),
        log_scales=scales.astype(np.float32) / LOG_SCALE_STEPS - LOG_SCALE_OFFSET,
        opacity_logits=logits_from_bytes(opacities[:, 0]),
        sh=half_turn_sh(sh),
        notes=tuple(notes),
    )


def _fixed_point(packed: np.ndarray, fractional_bits: int) -> Float32[np.ndarray, "n 3"]:
    """Three little-endian bytes a coordinate, two's complement."""
    parts = packed.reshape(len(packed), 3, 3).astype(np.int32)
    values = parts[:, :, 0] | (parts[:, :, 1] << 8) | (parts[:, :, 2] << 16)
    signed = np.where(values >= 1 << 23, values - (1 << 24), values)
    return (signed / float(1 << fractional_bits)).astype(np.float32)


def _first_three(packed: np.ndarray) -> Float32[np.ndarray, "n 4"]:
    """Version 2: x, y, z as bytes; w is what is missing to length 1."""
    xyz = packed.astype(np.float64) / 127.5 - 1.0
    w = np.sqrt(np.maximum(0.0, 1.0 - np.sum(xyz**2, axis=1)))
    return np.concatenate([w[:, None], xyz], axis=1).astype(np.float32)


def _smallest_three(packed: np.ndarray) -> Float32[np.ndarray, "n 4"]:
    """Two bits for the place of the largest of x, y, z, w; ten each, the sign first, for the others."""
    words = np.ascontiguousarray(packed).view("<u4")[:, 0]
    fields = np.stack([(words >> shift) & 1023 for shift in (20, 10, 0)], axis=1).astype(np.int64)
    small = (fields & 511) * (SQRT_HALF / 511.0) * np.where(fields & 512, -1.0, 1.0)
    xyzw = from_smallest_three(small, (words >> 30).astype(np.int64))
    return np.ascontiguousarray(xyzw[:, [3, 0, 1, 2]])


def _recognises(head: bytes) -> bool:
    return head.startswith((MAGIC, GZIP_MAGIC))


register(Importer("spz", ("*.spz",), "SPZ of Niantic, versions 2 to 4", read, _recognises))

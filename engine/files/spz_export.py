"""Export as SPZ (Niantic), about 15 bytes a Gaussian: version 3, which every viewer reads, or 4."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from engine.errors import SceneFileError
from engine.files.encodings import SQRT_HALF, bytes_from, half_turned, smallest_three
from engine.files.options import ExportOptions
from engine.files.registry import Exporter, register
from engine.files.selection import blocks, selected
from engine.files.spz import COLOUR_SCALE, LOG_SCALE_OFFSET, LOG_SCALE_STEPS
from engine.files.spz_container import SpzFile, write_spz
from engine.gaussians.flattening import FLAT_LOG_SCALE
from engine.gaussians.model import FlatGaussians
from engine.writing import replacing

FRACTIONAL_BITS = 12
"""The least precision of positions where they fit: 1/4096 of a unit."""
SMALL_QUANTILE = 0.05
STEPS_PER_SIGMA = 8.0
"""Positions get as many more bits as it takes to place a small Gaussian this finely."""
SH_STEPS = (8, 16)
"""Steps of the coefficients of degree 1 and of the others, in 1/128; coarser steps compress better."""


def write(gaussians: FlatGaussians, path: Path, options: ExportOptions) -> tuple[Path, ...]:
    """Write the Gaussians in their order, turned to y up.

    Raises:
        SceneFileError: nothing to write, values that are not finite, positions beyond what 24 bits hold, or
            the file cannot be written.
    """
    scene = selected(gaussians, path, options)
    bits = _fractional_bits(scene, path)
    streams = [bytearray() for _ in range(6)]
    for block in blocks(scene):
        for stream, data in zip(streams, _packed(half_turned(block), bits), strict=True):
            stream += data
    packed = tuple(bytes(stream) for stream in streams)
    file = SpzFile(options.spz_version, len(scene), scene.sh_degree, bits, 0, packed)
    try:
        with replacing(path) as temporary:
            write_spz(temporary, file)
    except OSError as error:
        raise SceneFileError(f"{path}: cannot be written ({error.strerror or error}).") from error
    return (path,)


def _packed(scene: FlatGaussians, bits: int) -> tuple[bytes, ...]:
    """The six attributes of a block that is y up."""
    log_scales = np.concatenate([np.full((len(scene), 1), FLAT_LOG_SCALE), scene.log_scales], axis=1)
    return (
        _fixed_point(scene.means_world.astype(np.float64) * (1 << bits)),
        bytes_from(scene.opacities.astype(np.float64) * 255.0).tobytes(),
        bytes_from((scene.sh[:, 0].astype(np.float64) * COLOUR_SCALE + 0.5) * 255.0).tobytes(),
        bytes_from((log_scales.astype(np.float64) + LOG_SCALE_OFFSET) * LOG_SCALE_STEPS).tobytes(),
        _rotations(scene),
        _harmonics(scene),
    )


def _fractional_bits(scene: FlatGaussians, path: Path) -> int:
    largest = float(np.abs(scene.means_world).max())
    fits = int(np.floor(np.log2((2**23 - 1) / max(largest, 1.0 / 256.0))))
    if fits < 0:
        raise SceneFileError(
            f"{path}: not written; SPZ holds positions up to {2**23 - 1} units, one lies at {largest:.3g}."
        )
    small = float(np.quantile(scene.log_scales.min(axis=1).astype(np.float64), SMALL_QUANTILE))
    wanted = int(np.ceil(np.log2(STEPS_PER_SIGMA) - small / np.log(2.0)))
    return min(max(wanted, FRACTIONAL_BITS), fits, 23)


def _fixed_point(steps: Float[np.ndarray, "n 3"]) -> bytes:
    whole = np.ascontiguousarray(np.rint(steps).astype("<i4"))
    return whole.view(np.uint8).reshape(*steps.shape, 4)[:, :, :3].tobytes()


def _rotations(scene: FlatGaussians) -> bytes:
    small, largest = smallest_three(scene.quats_wxyz[:, [1, 2, 3, 0]])
    sizes = np.minimum(np.rint(np.abs(small) / SQRT_HALF * 511.0), 511.0).astype(np.uint32)
    fields = sizes | (np.uint32(512) * (small < 0).astype(np.uint32))
    words = (largest.astype(np.uint32) << 30) | (fields[:, 0] << 20) | (fields[:, 1] << 10) | fields[:, 2]
    return words.astype("<u4").tobytes()


def _harmonics(scene: FlatGaussians) -> bytes:
    if scene.sh_degree == 0:
        return b""
    steps = np.full((scene.sh.shape[1] - 1, 1), SH_STEPS[1], dtype=np.float64)
    steps[:3] = SH_STEPS[0]
    bins = np.rint(scene.sh[:, 1:].astype(np.float64) * 128.0 / steps)
    return bytes_from(bins * steps + 128.0).tobytes()


register(Exporter("spz", ("*.spz",), "SPZ of Niantic, 15 bytes a Gaussian, for web viewers", write))

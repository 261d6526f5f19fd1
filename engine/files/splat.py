""".splat: 32 bytes a Gaussian without a header; color and opacity are bytes, harmonics are missing."""

import functools
from pathlib import Path

import numpy as np

from octasplat.engine.core.color import round_to_bytes
from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.core.writing import atomic_replace
from octasplat.engine.files.channel_columns import ChannelChoice
from octasplat.engine.files.encodings import logits_from_bytes, sh0_from_rgb, unit_quats
from octasplat.engine.files.export_options import ExportOptions
from octasplat.engine.files.range_losses import find_thickness_losses
from octasplat.engine.files.registry import Exporter, Importer, register
from octasplat.engine.files.splat_rows import check_scales, iterate_blocks, select_for_export
from octasplat.engine.gaussians.flattening import CloudBlocks, GaussianCloud, join_blocks, row_slices
from octasplat.engine.gaussians.model import FLAT_SCALE, FlatGaussians

SPLAT_DTYPE = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat_wxyz", "u1", 4)])


def read(path: Path) -> GaussianCloud:
    """Read all Gaussians; scales are standard deviations, rotations are 128 + 128 q.

    Raises:
        SceneFileError: the size is not a multiple of 32 bytes, or the file cannot be read.
    """
    return join_blocks(_read_blocks(path), path)


def _read_blocks(path: Path, _channels: ChannelChoice = "own") -> CloudBlocks:
    try:
        size = path.stat().st_size
        if size % SPLAT_DTYPE.itemsize:
            raise SceneFileError(
                f"{path}: is no .splat, or is truncated; its {size} bytes are not a multiple of 32."
            )
        # an empty file cannot be mapped
        table = np.memmap(path, SPLAT_DTYPE, "r") if size else np.zeros(0, SPLAT_DTYPE)
    except OSError as error:
        raise SceneFileError(f"{path}: cannot be read ({error.strerror or error}).") from error
    return CloudBlocks(len(table), ((rows, _decode(table[rows])) for rows in row_slices(len(table))))


def _decode(rows: np.ndarray) -> GaussianCloud:
    with np.errstate(divide="ignore", invalid="ignore"):
        log_scales = np.log(rows["scale"])
    return GaussianCloud(
        means_world=rows["mean"].astype(np.float32),
        quats_wxyz=((rows["quat_wxyz"].astype(np.float32) - 128.0) / 128.0).astype(np.float32),
        log_scales=log_scales.astype(np.float32),
        opacity_logits=logits_from_bytes(rows["rgba"][:, 3]),
        sh=sh0_from_rgb(rows["rgba"][:, :3] / 255.0),
    )


def write(gaussians: FlatGaussians, path: Path, options: ExportOptions) -> tuple[Path, ...]:
    """Write the Gaussians in their order; the flat axis is the first, with a standard deviation of 1e-5.

    Raises:
        SceneFileError: nothing to write, or values that are not finite.
        OSError: the file cannot be written.
    """
    gaussians = select_for_export(gaussians, path, options)
    check_scales(gaussians, path)
    with atomic_replace(path) as temporary, temporary.open("wb") as handle:
        for block in iterate_blocks(gaussians):
            handle.write(_splat_rows(block).data)
    return (path,)


def _splat_rows(some: FlatGaussians) -> np.ndarray:
    rows = np.empty(len(some), dtype=SPLAT_DTYPE)
    rows["mean"] = some.means_world
    rows["scale"][:, 0] = FLAT_SCALE
    rows["scale"][:, 1:] = some.scales
    rows["rgba"][:, :3] = round_to_bytes(some.base_rgb_srgb.astype(np.float64) * 255.0)
    rows["rgba"][:, 3] = round_to_bytes(some.opacities.astype(np.float64) * 255.0)
    unit = unit_quats(some.quats_wxyz)
    # A byte reaches from -1 to 127/128, so a component near 1 is written as its negative.
    largest = np.take_along_axis(unit, np.argmax(np.abs(unit), axis=1)[:, None], axis=1)
    rows["quat_wxyz"] = round_to_bytes(np.where(largest > 0, -unit, unit) * 128.0 + 128.0)
    return rows


register(
    Importer("splat", ("*.splat",), "32 bytes a Gaussian (antimatter15)", read, read_blocks=_read_blocks)
)
register(
    Exporter(
        "splat",
        ("*.splat",),
        "32 bytes a Gaussian for web viewers (antimatter15)",
        write,
        find_losses=functools.partial(find_thickness_losses, "splat"),
    )
)

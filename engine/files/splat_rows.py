"""Rows that splat formats write: which Gaussians, whether the format can hold them, and in which blocks."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.files.export_options import ExportOptions
from octasplat.engine.gaussians.flattening import row_slices, select_gaussians
from octasplat.engine.gaussians.model import MAX_LOG_SCALE, FlatGaussians


def select_for_export(gaussians: FlatGaussians, path: Path, options: ExportOptions) -> FlatGaussians:
    """Return the Gaussians not fainter than ``options.min_opacity``, all finite.

    Args:
        gaussians: the scene.
        path: the file that is written, named in errors; many Gaussians that are left are in files beside it.
        options: of the export.

    Raises:
        SceneFileError: nothing to write, or values that are not finite.
    """
    if len(gaussians) == 0:
        raise SceneFileError(f"{path}: not written, as there are no Gaussians.")
    if not gaussians.is_finite():
        raise SceneFileError(f"{path}: not written, as some Gaussians hold values that are not finite.")
    if options.min_opacity > 0.0:
        count = len(gaussians)
        is_kept = [block.opacities >= options.min_opacity for block in iterate_blocks(gaussians)]
        gaussians = select_gaussians(gaussians, np.concatenate(is_kept), path.parent)
        if not len(gaussians):
            raise SceneFileError(f"{path}: not written; all {count} Gaussians are below min_opacity.")
    return gaussians


def check_scales(scene: FlatGaussians, path: Path) -> None:
    """Raise for standard deviations beyond float32, which only formats that hold their logarithm can write.

    Raises:
        SceneFileError: some are.
    """
    if len(scene) and float(scene.log_scales.max()) >= MAX_LOG_SCALE:
        raise SceneFileError(f"{path}: not written, as some Gaussians are too large for float32.")


def iterate_blocks(scene: FlatGaussians) -> Iterator[FlatGaussians]:
    """Yield the scene in order, a few thousand Gaussians at a time, without copying it."""
    for part in row_slices(len(scene)):
        yield scene.view(part)

"""Export as a 3DGS PLY: the native file, readable by splat viewers."""

from pathlib import Path

from engine.errors import SceneFileError
from engine.export.options import ExportOptions
from engine.export.registry import Exporter, register
from engine.gaussians.model import FlatGaussians
from engine.gaussians.ply import write_gaussian_ply


def write(gaussians: FlatGaussians, path: Path, options: ExportOptions) -> tuple[Path, ...]:
    """Write the Gaussians that are not fainter than ``options.min_opacity``."""
    if options.min_opacity > 0.0:
        count = len(gaussians)
        gaussians = gaussians.select(gaussians.opacities >= options.min_opacity)
        if count and not len(gaussians):
            raise SceneFileError(f"{path}: not written; all {count} Gaussians are below min_opacity.")
    write_gaussian_ply(gaussians, path, sh_pad_degree=options.sh_pad_degree)
    return (path,)


register(
    Exporter(
        "gaussians", ("*.ply",), "Gaussians as a 3DGS PLY, for splat viewers and for octasplat itself", write
    )
)

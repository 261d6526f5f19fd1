"""Export as a 3DGS PLY: the native file, readable by splat viewers."""

from pathlib import Path

from engine.files.gaussian_ply import write_gaussian_ply
from engine.files.options import ExportOptions
from engine.files.registry import Exporter, register
from engine.files.selection import selected
from engine.gaussians.model import FlatGaussians


def write(gaussians: FlatGaussians, path: Path, options: ExportOptions) -> tuple[Path, ...]:
    """Write the Gaussians that are not fainter than ``options.min_opacity``."""
    write_gaussian_ply(selected(gaussians, path, options), path, sh_pad_degree=options.sh_pad_degree)
    return (path,)


register(
    Exporter(
        "gaussians", ("*.ply",), "Gaussians as a 3DGS PLY, for splat viewers and for octasplat itself", write
    )
)

"""A surface among the files that a scene is exported to: a textured mesh of opaque triangles as GLB."""

from pathlib import Path

from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.files.export_options import ExportOptions
from octasplat.engine.files.glb_surface import write_surface
from octasplat.engine.files.registry import Exporter, register
from octasplat.engine.gaussians.model import FlatGaussians

SURFACE_FORMAT = "surface"


def write(_gaussians: FlatGaussians, path: Path, options: ExportOptions) -> tuple[Path, ...]:
    """Write the surface that the options make.

    Raises:
        SceneFileError: they make none, or it is too large.
        OSError: the file cannot be written.
    """
    if options.surface is None:
        raise SceneFileError(f"{path}: not written; octasplat surface and octasplat export make surfaces.")
    return write_surface(options.surface(), path, options.turn_xyzw)


register(
    Exporter(
        SURFACE_FORMAT,
        ("surface.glb", "*.surface.glb"),
        "small textured mesh of opaque triangles as GLB, for any 3D program (finer: surface)",
        write,
        holds_harmonics=True,
        holds_origin=True,
    )
)

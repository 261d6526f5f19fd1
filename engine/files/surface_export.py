"""Surfaces among the files that a scene is exported to: textured, opaque triangles as GLB or USDZ."""

from pathlib import Path

from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.files import glb_surface, usdz_surface
from octasplat.engine.files.export_options import ExportOptions
from octasplat.engine.files.registry import Exporter, MeshWriter, SceneWriter, register
from octasplat.engine.files.usd_stage import missing_usd
from octasplat.engine.gaussians.model import FlatGaussians

SURFACE_FORMATS = ("surface", "surface-usdz")
"""Names of the exporters of this module."""


def _writer(write_surface: MeshWriter) -> SceneWriter:
    """Return a writer of the surface that the options make.

    It raises SceneFileError where they make none, or where the surface is too large.
    """

    def write(_gaussians: FlatGaussians, path: Path, options: ExportOptions) -> tuple[Path, ...]:
        if options.surface is None:
            raise SceneFileError(
                f"{path}: not written; octasplat surface and octasplat export make surfaces."
            )
        return write_surface(options.surface(), path, options.turn_xyzw)

    return write


register(
    Exporter(
        "surface",
        ("surface.glb", "*.surface.glb"),
        "small textured mesh of opaque triangles as GLB, for any 3D program (finer: surface)",
        _writer(glb_surface.write_surface),
        holds_harmonics=True,
        holds_origin=True,
    )
)
register(
    Exporter(
        "surface-usdz",
        ("surface.usdz", "*.surface.usdz"),
        "the same mesh as USDZ, for AR on iPhone and iPad (Quick Look); needs usd-core",
        _writer(usdz_surface.write_surface),
        missing_usd,
        holds_harmonics=True,
        holds_origin=True,
    )
)

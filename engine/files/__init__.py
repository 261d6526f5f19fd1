"""Files of scenes, meshes and surfaces: one module a format, reading and writing together, one registry.

The rest of the engine knows the functions that are named here, and no format.
"""

from octasplat.engine.files.channel_columns import ChannelChoice
from octasplat.engine.files.exporting import (
    check_surface_path,
    export_losses,
    export_scene,
    surface_files,
    write_surface,
)
from octasplat.engine.files.mesh import Mesh
from octasplat.engine.files.options import ExportOptions
from octasplat.engine.files.reading import read_facts, read_mesh, read_scene
from octasplat.engine.files.registry import (
    Exporter,
    Importer,
    MeshReader,
    SurfaceWriter,
    check_writable,
    exporter_for,
    exporters,
    importer_for,
    importers,
    register,
    writable_formats,
)
from octasplat.engine.gaussians.flattening import ImportReport

__all__ = [
    "ChannelChoice",
    "ExportOptions",
    "Exporter",
    "ImportReport",
    "Importer",
    "Mesh",
    "MeshReader",
    "SurfaceWriter",
    "check_surface_path",
    "check_writable",
    "export_losses",
    "export_scene",
    "exporter_for",
    "exporters",
    "importer_for",
    "importers",
    "read_facts",
    "read_mesh",
    "read_scene",
    "register",
    "surface_files",
    "writable_formats",
    "write_surface",
]

"""Files of scenes, meshes and surfaces: one module a format, reading and writing together, one registry.

The rest of the engine knows the functions that are named here, and no format.
"""

from octasplat.engine.files.channel_columns import ChannelChoice
from octasplat.engine.files.export_options import ExportOptions
from octasplat.engine.files.read_files import read_mesh, read_metadata, read_scene
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
from octasplat.engine.files.write_files import (
    check_surface_path,
    dropped_on_export,
    export_scene,
    surface_files,
    write_surface,
)
from octasplat.engine.gaussians.flattening import ImportReport
from octasplat.engine.geometry.imported_mesh import ImportedMesh

__all__ = [
    "ChannelChoice",
    "ExportOptions",
    "Exporter",
    "ImportReport",
    "ImportedMesh",
    "Importer",
    "MeshReader",
    "SurfaceWriter",
    "check_surface_path",
    "check_writable",
    "dropped_on_export",
    "export_scene",
    "exporter_for",
    "exporters",
    "importer_for",
    "importers",
    "read_mesh",
    "read_metadata",
    "read_scene",
    "register",
    "surface_files",
    "writable_formats",
    "write_surface",
]

"""Scenes and meshes read from files of any known format."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.core.events import EventListener, ignore_events
from octasplat.engine.core.georeference import GEOREFERENCE_FILE, read_georeference
from octasplat.engine.core.progress import phase
from octasplat.engine.files.channel_columns import ChannelChoice
from octasplat.engine.files.gaussian_ply import read_ply_metadata
from octasplat.engine.files.glb_container import read_glb_metadata
from octasplat.engine.files.registry import importer_for, mesh_reader_for, read_head
from octasplat.engine.gaussians.flattening import ImportReport, flatten
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.scene_metadata import UNKNOWN_METADATA, SceneMetadata
from octasplat.engine.geometry.imported_mesh import ImportedMesh

FOLDER_FILES = ("scene.ply", "meta.json")
"""What a folder is read by: the scene of a run, or the description of an unpacked SOG."""
_RUN_FILE = "config.json"
"""What the folder of a run has from its beginning."""


def read_scene(
    path: Path,
    format: str | None = None,
    *,
    drop_invalid: bool = False,
    channels: ChannelChoice = "own",
    progress: EventListener = ignore_events,
    folder: Path | None = None,
) -> tuple[FlatGaussians, ImportReport]:
    """Read the Gaussians of a file of any known format, or of the folder of a run, and flatten them.

    Args:
        path: the file, or a folder with ``scene.ply`` or with the ``meta.json`` of an unpacked SOG.
        format: the name of its format; by default the file shows it.
        drop_invalid: leave out Gaussians with values that are not finite, instead of refusing the file.
        channels: which named channels are wanted: those that the file says are channels, as ours do; all that
            nothing else is known of, too; or names.
        progress: receives events when reading begins and ends (stage ``read``).
        folder: for files that hold a large scene, see :func:`octasplat.engine.gaussians.flattening.flatten`.

    Returns:
        Flat Gaussians, and what flattening and reading lost.

    Raises:
        SceneFileError: the file cannot be read, or has no such channel; the text names it and says why.
    """
    source = _scene_file(path)
    importer = importer_for(source, format)
    with phase("read", progress):
        if not importer.holds_channels and channels not in ("own", "all", ()):
            raise SceneFileError(f"{source}: the format {importer.name} has no place for channels.")
        read = importer.read_blocks
        cloud = importer.read(source) if read is None else read(source, channels)
        return flatten(cloud, source, drop_invalid=drop_invalid, folder=folder)


def read_metadata(path: Path) -> SceneMetadata:
    """Return the metadata that a file or a run's scene states: our PLY all, a GLB its place, others none.

    What the file begins with decides, as it does where the scene is read, whatever the file is called. The
    georeference of a run's scene is in a file beside it, see :mod:`octasplat.engine.core.georeference`.

    Raises:
        SceneFileError: the file cannot be read or is damaged.
        ConfigError: the georeference beside it cannot be read.
    """
    source = _scene_file(path)
    start = read_head(source)
    if start.startswith(b"glTF"):
        return read_glb_metadata(source)
    facts = read_ply_metadata(source) if start.startswith(b"ply") else UNKNOWN_METADATA
    if source.name == FOLDER_FILES[0]:
        beside = read_georeference(source.with_name(GEOREFERENCE_FILE))
        return facts if beside is None else replace(facts, georeference=beside)
    return facts


def read_mesh(path: Path, *, with_materials: bool = False) -> ImportedMesh:
    """Read a PLY, OBJ or GLB mesh; ``with_materials`` asks for materials, normals and colors too.

    Raises:
        SceneFileError: another suffix, a file that cannot be read, is damaged or compressed, or has vertices
            that are not finite.
    """
    reader = mesh_reader_for(path)
    mesh = reader.read_with_materials(path) if with_materials else reader.read(path)
    if len(mesh) == 0:
        raise SceneFileError(f"{path}: holds no vertices.")
    bad = int((~np.isfinite(mesh.vertices)).any(axis=1).sum())
    if bad:
        raise SceneFileError(f"{path}: {bad} of {len(mesh)} vertices are not finite; save the mesh again.")
    if len(mesh.triangles) and not (mesh.triangles.min() >= 0 and mesh.triangles.max() < len(mesh)):
        raise SceneFileError(f"{path}: a face names a vertex that is not there; the file is damaged.")
    return mesh


def _scene_file(path: Path) -> Path:
    if not path.is_dir():
        return path
    for name in FOLDER_FILES:
        if (path / name).exists():
            return path / name
    if (path / _RUN_FILE).exists():
        raise SceneFileError(
            f"{path}: holds no {FOLDER_FILES[0]} yet; finish the run with: octasplat reconstruct --resume."
        )
    raise SceneFileError(f"{path}: is a folder without a scene; it should hold {' or '.join(FOLDER_FILES)}.")

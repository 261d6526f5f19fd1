"""The one registry of file formats: Gaussians in and out, meshes in, surfaces out.

A format is a module of this package that holds all that can be done with it and calls `register`; nothing
else has to know of it.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, TypeVar

from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.files.channel_columns import ChannelChoice
from octasplat.engine.files.export_options import ExportOptions
from octasplat.engine.files.format_table import Entry, FormatTable
from octasplat.engine.gaussians.flattening import CloudBlocks, GaussianCloud
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.scene_metadata import SceneMetadata
from octasplat.engine.geometry.imported_mesh import ImportedMesh
from octasplat.engine.geometry.triangle_mesh import TriangleMesh

HEAD_BYTES = 4096


def no_files(_path: Path) -> tuple[Path, ...]:
    """Return no files: nothing is written beside the one that is named."""
    return ()


SceneReader = Callable[[Path], GaussianCloud]
SceneWriter = Callable[[FlatGaussians, Path, ExportOptions], tuple[Path, ...]]
MeshWriter = Callable[[TriangleMesh, Path, Sequence[float] | None], tuple[Path, ...]]


@dataclass(frozen=True)
class Importer(Entry):
    """One format of Gaussians to read.

    Attributes:
        name: what ``format=`` calls it.
        patterns: file names that it takes where the file's first bytes do not decide.
        description: one line for help texts.
        read: reads the Gaussians as the file has them, in the world frame of the 3DGS family (y down).
        matches_head: whether a file that begins with these bytes (up to ``HEAD_BYTES``) is of this format.
        read_blocks: reads what ``read`` does some thousands of Gaussians at a time, so that memory is that of
            the scene, and the channels that are wanted, too; None where the format does not allow for it.
        holds_channels: whether the format has a place for channels.
    """

    noun: ClassVar[str] = "import"
    description: str
    read: SceneReader
    matches_head: Callable[[bytes], bool] = lambda _head: False
    read_blocks: Callable[[Path, ChannelChoice], CloudBlocks] | None = None
    holds_channels: bool = False


@dataclass(frozen=True)
class Exporter(Entry):
    """One format in which a scene is written, as Gaussians or as octagons.

    Attributes:
        name: what ``format=`` calls it.
        patterns: file names that it takes by default.
        description: one line for help texts.
        write: writes the Gaussians to the path and returns every file written, the path itself first.
        missing_requirement: what is missing on this machine to write it, to be read after the file's name,
            or None.
        holds_channels: whether it writes named channels, too.
        holds_harmonics: whether colors may change with the direction.
        holds_origin: whether it says where a scene of large coordinates has its origin, and its georeference.
        beside: names the files that are written beside the path, if there are any.
        find_losses: returns what of a scene lies beyond the ranges of the format, one sentence a loss.
        find_place_losses: returns what the format cannot do with what is known of a scene's place, likewise.
    """

    noun: ClassVar[str] = "export"
    description: str
    write: SceneWriter
    missing_requirement: Callable[[], str | None] = lambda: None
    holds_channels: bool = False
    holds_harmonics: bool = False
    holds_origin: bool = False
    beside: Callable[[Path], tuple[Path, ...]] = no_files
    find_losses: Callable[[FlatGaussians], tuple[str, ...]] = lambda _scene: ()
    find_place_losses: Callable[[SceneMetadata], tuple[str, ...]] = lambda _facts: ()


@dataclass(frozen=True)
class MeshReader(Entry):
    """One format of meshes to read: those that come back from an editor, or that drive a scene.

    Attributes:
        name: of the format.
        patterns: file names that it takes.
        read: reads all triangles.
        read_with_materials: reads them with materials, normals and colors too.
    """

    noun: ClassVar[str] = "mesh"
    read: Callable[[Path], ImportedMesh]
    read_with_materials: Callable[[Path], ImportedMesh]


@dataclass(frozen=True)
class SurfaceWriter(Entry):
    """One format in which a surface is written.

    Attributes:
        name: of the format.
        patterns: file names that it takes.
        write: writes the surface and returns every file written, the path itself first. The quaternion (x, y,
            z, w) turns the scene upright, y up; None is half a turn about x. Formats that keep the scene's
            frame pass over it.
        textured: whether it can hold a texture.
        lit: whether it can hold materials.
        missing_requirement: see :class:`Exporter`.
        beside: names the files that are written beside the path for a texture, if there are any.
    """

    noun: ClassVar[str] = "surface"
    write: MeshWriter
    textured: bool
    lit: bool = False
    missing_requirement: Callable[[], str | None] = lambda: None
    beside: Callable[[Path], tuple[Path, ...]] = no_files


_TABLE = FormatTable(__name__.rpartition(".")[0])
E = TypeVar("E", bound=Entry)


def register(entry: E) -> E:
    """Add what can be done with a format; its name must be new among entries of its class."""
    _TABLE.register(entry)
    return entry


def importers() -> tuple[Importer, ...]:
    """Return all formats of Gaussians that can be read, by name."""
    return _TABLE.entries(Importer)


def exporters() -> tuple[Exporter, ...]:
    """Return all formats in which scenes can be written, by name."""
    return _TABLE.entries(Exporter)


def importer_for(path: Path, format: str | None = None) -> Importer:
    """Return the format called ``format``, or else the one that ``path``'s first bytes or its name show.

    What a file begins with decides, then its name, so that a file under a wrong name is read all the same.

    Raises:
        SceneFileError: the file cannot be opened, or no format has that name, those bytes or that file name.
    """
    if format is not None:
        return _TABLE.get(Importer, format, path)
    head = read_head(path)
    for importer in importers():
        if importer.matches_head(head):
            return importer
    found = _TABLE.by_file_name(Importer, path)
    if found is None:
        choices = _TABLE.describe_choices(Importer)
        raise SceneFileError(f"{path}: is no scene of a known format; the formats are {choices}.")
    return found


def exporter_for(path: Path, format: str | None = None) -> Exporter:
    """Return the format called ``format``, or else the one that ``path``'s name asks for.

    ``.ply`` means a Gaussian PLY, except ``mesh.ply``, ``*.mesh.ply``, ``*_mesh.ply`` and ``*-mesh.ply``,
    which mean the octagon mesh, as the same names with ``octagons`` do. Upper and lower case are the same.

    Raises:
        SceneFileError: no format has that name or takes that file name; the text lists those that exist.
    """
    if format is not None:
        return _TABLE.get(Exporter, format, path)
    found = _TABLE.by_file_name(Exporter, path)
    if found is None:
        choices = _TABLE.describe_choices(Exporter)
        raise SceneFileError(f"{path}: no export format takes this file name; the formats are {choices}.")
    return found


def writable_formats() -> tuple[str, ...]:
    """Return the names of the formats that this machine can write at present."""
    return tuple(exporter.name for exporter in exporters() if exporter.missing_requirement() is None)


def check_writable(names: Iterable[str]) -> None:
    """Make sure that files of these names can be written on this machine, before any long work.

    Raises:
        SceneFileError: no format takes a name, or what its format needs is missing; the text says what to do.
    """
    for name in names:
        lacking = exporter_for(Path(name)).missing_requirement()
        if lacking is not None:
            raise SceneFileError(f"{name}: {lacking}.")


def mesh_reader_for(path: Path) -> MeshReader:
    """Return the mesh format that ``path``'s name shows.

    Raises:
        SceneFileError: there is none.
    """
    found = _TABLE.by_file_name(MeshReader, path)
    if found is None:
        suffixes = _TABLE.suffixes(MeshReader)
        raise SceneFileError(f"{path}: is no mesh that is read here; save it as {suffixes}.")
    return found


def surface_writer_for(path: Path) -> SurfaceWriter | None:
    """Return the format in which a surface is written to ``path`` by its name; None where there is none."""
    return _TABLE.by_file_name(SurfaceWriter, path)


def surface_suffixes() -> str:
    """Return what names of surfaces may end in, as in ".glb, .ply or .obj"."""
    return _TABLE.suffixes(SurfaceWriter)


def read_head(path: Path) -> bytes:
    """Return the first bytes of a file, up to :data:`HEAD_BYTES`.

    Raises:
        SceneFileError: it cannot be read.
    """
    try:
        with path.open("rb") as handle:
            return handle.read(HEAD_BYTES)
    except OSError as error:
        raise SceneFileError(f"{path}: cannot be read ({error.strerror or error}).") from error

"""Reading of the known geometry of a scene, see :mod:`octasplat.engine.dataset.known_geometry`."""

import struct
from functools import partial
from pathlib import Path

import numpy as np

from octasplat.engine.core.errors import DatasetError
from octasplat.engine.core.name_lists import name_list
from octasplat.engine.core.scene_layout import is_geometry_file
from octasplat.engine.dataset.known_geometry import KnownGeometry
from octasplat.engine.dataset.pixel_cache import file_sha256
from octasplat.engine.files.read_files import read_mesh
from octasplat.engine.geometry.imported_mesh import ImportedMesh

LAS_SUFFIXES = frozenset({".las", ".laz"})
MAX_READ_POINTS = 20_000_000
"""Of a cloud with more points than this, every N-th is read."""
_LAS_1_4_BYTES = 375
_VARIABLE_BYTES, _EXTENDED_VARIABLE_BYTES = 54, 60
"""Least length of a variable length record, and of an extended one."""
_PANIC = "PanicException"
"""What a fault in the library that unpacks LAZ raises; it derives from nothing that can be named here."""
_COMPRESSED = 0x80
"""The bit of the point format that LAZ files set."""


def find_known_geometry(scene: Path) -> KnownGeometry | None:
    """Return the known geometry in the folder of a scene; None where there is none.

    Raises:
        DatasetError: there are several, or the file cannot be read.
    """
    if not scene.is_dir():
        return None
    found = sorted(path for path in scene.iterdir() if is_geometry_file(path.name) and path.is_file())
    if len(found) > 1:
        names = name_list([path.name for path in found])
        raise DatasetError(f"{scene} holds {len(found)} files of known geometry ({names}); leave one there.")
    if not found:
        return None
    return KnownGeometry(found[0], file_sha256(found[0]), partial(read_geometry, found[0]))


def read_geometry(path: Path) -> ImportedMesh:
    """Read a mesh or a cloud of points, which has no triangles.

    Raises:
        DatasetError: the file is damaged or holds nothing.
        SceneFileError: likewise.
    """
    if path.suffix.lower() not in LAS_SUFFIXES:
        return read_mesh(path)
    return ImportedMesh(_las_points(path), np.zeros((0, 3), np.int64))


def _las_points(path: Path) -> np.ndarray:
    """Return the points of a LAS or LAZ file."""
    import laspy
    from laspy.errors import LaspyException

    try:
        _check_las_counts(path)
        with laspy.open(path) as file:
            step = -(-file.header.point_count // MAX_READ_POINTS) or 1
            parts, passed = [], 0
            for chunk in file.chunk_iterator(1_000_000):
                kept = slice((-passed) % step, None, step)
                parts.append(
                    np.stack([np.asarray(axis)[kept] for axis in (chunk.x, chunk.y, chunk.z)], axis=1)
                )
                passed += len(chunk)
    except BaseException as error:
        damage = (LaspyException, OSError, ValueError, RuntimeError, EOFError, struct.error)
        if not isinstance(error, damage) and type(error).__name__ != _PANIC:
            raise
        raise DatasetError(f"{path} cannot be read as a cloud of points ({error}).") from error
    points = np.concatenate(parts) if parts else np.zeros((0, 3))
    if len(points) == 0:
        raise DatasetError(f"{path} holds no points.")
    if not np.isfinite(points).all():
        raise DatasetError(f"{path} holds positions that are no numbers.")
    return points.astype(np.float64)


def _check_las_counts(path: Path) -> None:
    """Refuse a LAS or LAZ file that says it has more parts than it has room for.

    The libraries believe these numbers: they would take all memory, or end the process.

    Raises:
        ValueError: the file is damaged.
        struct.error: it ends within its header.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        header = file.read(_LAS_1_4_BYTES)
        _, minor = struct.unpack_from("<BB", header, 24)
        points_begin, variables, point_format = struct.unpack_from("<IIB", header, 96)
        counts = [variables * _VARIABLE_BYTES]
        if minor >= 4:
            (extended,) = struct.unpack_from("<I", header, 243)
            counts.append(extended * _EXTENDED_VARIABLE_BYTES)
        if point_format & _COMPRESSED:
            file.seek(points_begin)
            (table,) = struct.unpack("<q", file.read(8))
            if table == -1:  # of a file that was written without going back
                file.seek(size - 8)
                (table,) = struct.unpack("<q", file.read(8))
            if not points_begin < table < size:
                raise ValueError("its table of compressed parts lies elsewhere")
            file.seek(table)
            _, chunks = struct.unpack("<II", file.read(8))
            counts.append(chunks)  # of a byte at least
    if max(counts) > size:
        raise ValueError("it ends before what its header tells of")

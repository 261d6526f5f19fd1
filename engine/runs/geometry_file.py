"""Reading of the known geometry of a scene, see :mod:`octasplat.engine.dataset.known_geometry`."""

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
        with laspy.open(path) as file:
            step = -(-file.header.point_count // MAX_READ_POINTS) or 1
            parts, passed = [], 0
            for chunk in file.chunk_iterator(1_000_000):
                kept = slice((-passed) % step, None, step)
                parts.append(
                    np.stack([np.asarray(axis)[kept] for axis in (chunk.x, chunk.y, chunk.z)], axis=1)
                )
                passed += len(chunk)
    except (LaspyException, OSError, ValueError, RuntimeError, EOFError) as error:
        raise DatasetError(f"{path} cannot be read as a cloud of points ({error}).") from error
    points = np.concatenate(parts) if parts else np.zeros((0, 3))
    if len(points) == 0:
        raise DatasetError(f"{path} holds no points.")
    return points.astype(np.float64)

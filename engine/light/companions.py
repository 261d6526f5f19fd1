"""Files that a mesh file needs beside it. Imports neither torch nor numba."""

from collections.abc import Iterable, Iterator
from pathlib import Path

MATERIALS = ".mtl"
IMAGES = frozenset({".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".exr", ".hdr"})


def companions(mesh: Path) -> tuple[str, ...]:
    """Names, relative to the mesh's folder, of files there that the mesh comes with.

    Those are the MTL files whose names an OBJ mentions and the images whose names these mention, in the
    folder itself and in those right below it; any other mesh has none. Rather one too many than one too few:
    whoever sends a mesh elsewhere sends them along.
    """
    if mesh.suffix.lower() != ".obj":
        return ()
    libraries = _mentioned(mesh.parent, (MATERIALS,), [mesh])
    return (*libraries, *_mentioned(mesh.parent, IMAGES, [mesh.parent / name for name in libraries]))


def _mentioned(folder: Path, suffixes: Iterable[str], texts: Iterable[Path]) -> tuple[str, ...]:
    """The files of these kinds whose names a text mentions, by name."""
    said = b"\n".join(path.read_bytes() for path in texts).replace(b"\\", b"/")
    return tuple(name for name in sorted(_files(folder, suffixes)) if name.encode() in said)


def _files(folder: Path, suffixes: Iterable[str]) -> Iterator[str]:
    wanted = set(suffixes)
    for pattern in ("*", "*/*"):
        for path in folder.glob(pattern):
            if path.suffix.lower() in wanted and path.is_file():
                yield path.relative_to(folder).as_posix()

"""Files that a mesh file refers to. Imports neither torch nor numba."""

from collections.abc import Iterable, Iterator
from pathlib import Path

MTL_SUFFIX = ".mtl"
IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".exr", ".hdr"})


def sidecar_files(mesh: Path) -> tuple[str, ...]:
    """Return the files in the mesh's folder that belong to it, relative to that folder.

    Those are the MTL files whose names an OBJ mentions and the images whose names these mention, in the
    folder itself and in those right below it; any other mesh has none. Rather one too many than one too few:
    whoever sends a mesh elsewhere sends them along.
    """
    if mesh.suffix.lower() != ".obj":
        return ()
    libraries = _referenced_files(mesh.parent, (MTL_SUFFIX,), [mesh])
    return (
        *libraries,
        *_referenced_files(mesh.parent, IMAGE_SUFFIXES, [mesh.parent / name for name in libraries]),
    )


def _referenced_files(folder: Path, suffixes: Iterable[str], texts: Iterable[Path]) -> tuple[str, ...]:
    """Return the files of these suffixes whose names occur in a text, by name."""
    content = b"\n".join(path.read_bytes() for path in texts).replace(b"\\", b"/")
    return tuple(name for name in sorted(_files_with_suffix(folder, suffixes)) if name.encode() in content)


def _files_with_suffix(folder: Path, suffixes: Iterable[str]) -> Iterator[str]:
    accepted = set(suffixes)
    for pattern in ("*", "*/*"):
        for path in folder.glob(pattern):
            if path.suffix.lower() in accepted and path.is_file():
                yield path.relative_to(folder).as_posix()

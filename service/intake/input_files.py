"""Validation of uploaded files that options name, such as the meshes and textures of a stage."""

import io
import struct
import zipfile
from collections.abc import Sequence
from pathlib import PurePosixPath
from typing import Any, BinaryIO

from octasplat.engine.core.portable_names import quoted_name
from octasplat.engine.core.scene_layout import IMAGE_SUFFIXES, is_ignored_file
from octasplat.service.intake.dataset import DatasetFile
from octasplat.service.intake.faults import IntakeError, IntakeFault
from octasplat.service.intake.image_completeness import check_complete
from octasplat.service.intake.images import ImageHeader, ImageLimits, read_image_header
from octasplat.service.intake.upload_names import FileNames
from octasplat.workers.storage.protocol import Storage

MAX_FILES = 1000
MAX_TEXT_LINE_BYTES = 1 << 16
"""Longest line of a text file; programs read such files line by line into memory."""
_CHUNK_BYTES = 1 << 20
_MAGIC_NUMBERS = {".glb": b"glTF", ".ply": b"ply"}
_GLB_HEADER_BYTES = 12
_GLB_CHUNK = struct.Struct("<I4s")
"""Length and kind, which begin a chunk."""
_MAX_GLB_CHUNKS = 64
"""What follows is left to the reader of the file."""
_UNCHECKED_SUFFIXES = frozenset({".splat", ".spz"})
"""Nothing in their first bytes says what they are; whoever reads them says so."""
_TEXT_SUFFIXES = frozenset({".obj", ".mtl", ".txt"})
ALLOWED_SUFFIXES = frozenset(
    {".sog", *_TEXT_SUFFIXES, *_MAGIC_NUMBERS, *_UNCHECKED_SUFFIXES, *IMAGE_SUFFIXES}
)


def check_input_name(name: str) -> None:
    """Check the name of an uploaded file.

    Raises:
        IntakeError: ``name-...``; ``name-unexpected``, as nothing reads such files.
    """
    FileNames().add(name)
    if is_ignored_file(name) or PurePosixPath(name).suffix.lower() not in ALLOWED_SUFFIXES:
        detail = (
            f"{quoted_name(name)} is none of the files that options can name: meshes (.obj .mtl .ply .glb), "
            "surroundings (.hdr .exr), textures, splats and matrices (.txt)."
        )
        raise IntakeError(IntakeFault("name-unexpected", detail, name))


def check_input_content(storage: Storage, name: str, sha256: str, limits: ImageLimits) -> ImageHeader | None:
    """Check the first bytes of a stored file; returns the header of an image, else None.

    Raises:
        IntakeError: it is not what its name says, or was cut off.
        StorageError: the content cannot be had.
    """
    suffix = PurePosixPath(name).suffix.lower()
    with storage.open(sha256) as file:
        if suffix in IMAGE_SUFFIXES:
            header = read_image_header(file, name, limits)
            check_complete(file, name, header.kind)
            return header
        if not _matches_suffix(file, suffix):
            what = "text" if suffix in _TEXT_SUFFIXES else f"{suffix[1:].upper()} file"
            detail = f"{quoted_name(name)} is no {what} by its content; send the file anew."
            raise IntakeError(IntakeFault("file-kind", detail, name))
        if suffix == ".glb" and not _is_glb_complete(file):
            detail = (
                f"{quoted_name(name)} is cut off: the end of its GLB data is missing; send the whole file."
            )
            raise IntakeError(IntakeFault("file-kind", detail, name))
        if suffix in _TEXT_SUFFIXES and _has_long_line(file):
            detail = f"{quoted_name(name)} has a line of more than {MAX_TEXT_LINE_BYTES:,} bytes; split it."
            raise IntakeError(IntakeFault("file-kind", detail, name))
    return None


def _matches_suffix(file: BinaryIO, suffix: str) -> bool:
    if suffix == ".sog":
        return zipfile.is_zipfile(file)
    head = file.read(4096)
    if suffix in _TEXT_SUFFIXES:
        return b"\0" not in head
    return head.startswith(_MAGIC_NUMBERS.get(suffix, b""))


def _is_glb_complete(file: BinaryIO) -> bool:
    """Return whether all chunks lie within the file, and the first one has content, as that of JSON does."""
    size_bytes = file.seek(0, io.SEEK_END)
    offset = _GLB_HEADER_BYTES
    for chunk in range(_MAX_GLB_CHUNKS):
        file.seek(offset)
        head = file.read(_GLB_CHUNK.size)
        if len(head) < _GLB_CHUNK.size:
            return chunk > 0
        length, kind = _GLB_CHUNK.unpack(head)
        if chunk == 0 and (kind != b"JSON" or length == 0):
            return False
        offset += _GLB_CHUNK.size + length
        if offset > size_bytes:
            return False
    return True


def _has_long_line(file: BinaryIO) -> bool:
    file.seek(0)
    begun = 0  # bytes of the line that the last chunk ended in
    while chunk := file.read(_CHUNK_BYTES):
        first, *others = chunk.splitlines(keepends=False)
        lengths = [begun + len(first), *map(len, others)]
        if max(lengths) > MAX_TEXT_LINE_BYTES:
            return True
        begun = 0 if chunk.endswith((b"\n", b"\r")) else lengths[-1]
    return False


def check_input_files(files: Sequence[DatasetFile]) -> dict[str, Any]:
    """Check all files together; returns warnings.

    Raises:
        IntakeError: there are none or too many, or two have names that some systems take for one.
    """
    if not 1 <= len(files) <= MAX_FILES:
        detail = f"There are {len(files)} files; 1 to {MAX_FILES} are taken."
        raise IntakeError(IntakeFault("dataset-files", detail))
    known = FileNames()
    for file in files:
        known.add(file.path)
    return {"files": len(files), "size_bytes": sum(file.size_bytes for file in files)}

"""Files that the options of a job name, such as the meshes and textures of a stage, at the door."""

import zipfile
from collections.abc import Sequence
from pathlib import PurePosixPath
from typing import Any, BinaryIO

from octasplat.service.intake.dataset import DatasetFile
from octasplat.service.intake.faults import Fault, IntakeRefused
from octasplat.service.intake.images import ImageHeader, ImageLimits, read_image_header
from octasplat.service.intake.layout import IMAGE_SUFFIXES, is_clutter
from octasplat.service.intake.names import FileNames
from octasplat.service.intake.whole import check_whole
from octasplat.workers.store.names import shown_name
from octasplat.workers.store.protocol import Storage

MAX_FILES = 1000
MAX_TEXT_LINE_BYTES = 1 << 16
_BEGINNINGS = {".glb": b"glTF", ".ply": b"ply"}
_UNKNOWN = frozenset({".splat", ".spz"})
"""Nothing in their first bytes says what they are; whoever reads them says so."""
_TEXTS = frozenset({".obj", ".mtl", ".txt"})
SUFFIXES = frozenset({".sog", *_TEXTS, *_BEGINNINGS, *_UNKNOWN, *IMAGE_SUFFIXES})


def check_input_name(name: str) -> None:
    """Look at a file's name.

    Raises:
        IntakeRefused: ``name-...``; ``name-unexpected``, as nothing reads such files.
    """
    FileNames().add(name)
    if is_clutter(name) or PurePosixPath(name).suffix.lower() not in SUFFIXES:
        detail = (
            f"{shown_name(name)} is none of the files that options can name: meshes (.obj .mtl .ply .glb), "
            "surroundings (.hdr .exr), textures, splats and matrices (.txt)."
        )
        raise IntakeRefused(Fault("name-unexpected", detail, name))


def check_input_content(storage: Storage, name: str, sha256: str, limits: ImageLimits) -> ImageHeader | None:
    """Look at the first bytes of a stored file; the header of an image, else None.

    Raises:
        IntakeRefused: it is not what its name says, or was cut off.
        StorageError: the content cannot be had.
    """
    suffix = PurePosixPath(name).suffix.lower()
    with storage.open(sha256) as file:
        if suffix in IMAGE_SUFFIXES:
            header = read_image_header(file, name, limits)
            check_whole(file, name, header.kind)
            return header
        if not _is_what_it_says(file, suffix):
            what = "text" if suffix in _TEXTS else f"{suffix[1:].upper()} file"
            detail = f"{shown_name(name)} is no {what} by its content; send the file anew."
            raise IntakeRefused(Fault("file-kind", detail, name))
    return None


def _is_what_it_says(file: BinaryIO, suffix: str) -> bool:
    if suffix == ".sog":
        return zipfile.is_zipfile(file)
    head = file.read(4096)
    if suffix in _TEXTS:
        return b"\0" not in head
    return head.startswith(_BEGINNINGS.get(suffix, b""))


def check_inputs(files: Sequence[DatasetFile]) -> dict[str, Any]:
    """Look at all files together; returns what is to be told of them.

    Raises:
        IntakeRefused: there are none or too many, or two have names that some systems take for one.
    """
    if not 1 <= len(files) <= MAX_FILES:
        detail = f"There are {len(files)} files; 1 to {MAX_FILES} are taken."
        raise IntakeRefused(Fault("dataset-files", detail))
    known = FileNames()
    for file in files:
        known.add(file.path)
    return {"files": len(files), "size_bytes": sum(file.size_bytes for file in files)}

"""Folders in a storage: a manifest of names and digests, the files as blobs.

A dataset, a checkpoint and the results of an attempt are such trees. Storing the files can be repeated and
makes nothing visible; publishing the manifest is the one step that creates a tree.
"""

import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import BinaryIO

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from octasplat.engine.core.portable_names import FileNameError, NameSet
from octasplat.workers.storage.errors import StorageError
from octasplat.workers.storage.os_errors import translate_os_errors
from octasplat.workers.storage.protocol import Blob, Storage
from octasplat.workers.storage.untrusted_folder import UntrustedFolder

TREE_ERRORS = (StorageError, FileNameError)
"""What storing and fetching trees raise: also for names that programs and users have chosen."""
_PIECE_BYTES = 1 << 20
_MOST_ANNOUNCED_BYTES = 512 << 30
"""Of a file that is longer a store is not told the length, by which it would hold more of it in memory."""


class TreeFile(BaseModel):
    """One file: its name relative to the tree, with forward slashes, and its content."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    path: str
    sha256: str = Field(pattern="^[0-9a-f]{64}$")
    size_bytes: int = Field(ge=0)


class Manifest(BaseModel):
    """The files of a tree, sorted by name, and metadata of the writer."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    format: int = 1
    files: tuple[TreeFile, ...]
    about: dict[str, str | int | float | bool | None] = {}

    @property
    def size_bytes(self) -> int:
        """Return the sum over the files; content that occurs twice counts twice."""
        return sum(file.size_bytes for file in self.files)

    def to_bytes(self) -> bytes:
        """Return the published bytes; equal manifests give equal bytes."""
        return self.model_dump_json(indent=1).encode("utf-8")


def store_tree(
    storage: Storage,
    folder: Path,
    names: Iterable[str] | None = None,
    *,
    below: str = "",
    metadata: dict[str, str | int | float | bool | None] | None = None,
    on_stored: Callable[[int], None] | None = None,
) -> Manifest:
    """Store the files of ``folder`` as blobs, each as far as it is written when it is opened.

    Args:
        storage: where to.
        folder: local folder; what is below it may have been written by a program that is not trusted.
        names: files to store, relative to the folder ``below``; by default all that it holds.
        below: a folder below ``folder``, which is one of the names that are not trusted.
        metadata: goes into the manifest.
        on_stored: called with the length of every file stored; it may raise to give up.

    Raises:
        StorageError: a file cannot be read, is a link or has a name elsewhere, or the store does not take it.
        FileNameError: a name is not portable.
    """
    known = NameSet()
    files: list[TreeFile] = []
    with UntrustedFolder(folder) as source:
        # Sorted, so that equal folders give equal manifests.
        for name in sorted(source.names(below) if names is None else names):
            known.add(name)
            inner = f"{below}/{name}" if below else name
            with (
                # By the descriptor that was checked, whatever the name stands for by then.
                source.open(inner) as handle,
                translate_os_errors(folder / inner),
            ):
                blob = _store_file(storage, handle)
            files.append(TreeFile(path=name, sha256=blob.sha256, size_bytes=blob.size_bytes))
            if on_stored is not None:
                on_stored(blob.size_bytes)
    return Manifest(files=tuple(files), about=metadata or {})


def _store_file(storage: Storage, handle: BinaryIO) -> Blob:
    """Store a file that may be written meanwhile: no more of it than there is now."""
    left = os.fstat(handle.fileno()).st_size
    # at most so long, and not exactly so, as the file may be cut
    most = left if left <= _MOST_ANNOUNCED_BYTES else None
    with storage.open_writer(max_bytes=most) as writer:
        while piece := handle.read(min(left, _PIECE_BYTES)):
            writer.write(piece)
            left -= len(piece)
        return writer.commit()


def fetch_tree(storage: Storage, files: Iterable[TreeFile], folder: Path, *, writable: bool = False) -> None:
    """Put the files of a tree into the new or empty ``folder``.

    Args:
        storage: where from.
        files: what, e.g. ``manifest.files``.
        folder: where to.
        writable: give every file a copy of its own; otherwise files may be shared with the store and must
            only be read or replaced, not changed.

    Raises:
        StorageError: content is missing or damaged, or the disk is full.
        FileNameError: a name would lead elsewhere.
    """
    files = tuple(files)
    known = NameSet()
    # All names are judged before the first file is written.
    for file in files:
        known.add(file.path)
    with translate_os_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    for file in files:
        storage.materialise(file.sha256, folder / file.path, writable=writable)


def merge_files(*groups: Iterable[TreeFile]) -> tuple[TreeFile, ...]:
    """Return the files of several trees as those of one.

    Raises:
        FileNameError: a name is not portable, or there are two of it.
    """
    files = sorted((file for group in groups for file in group), key=lambda file: file.path)
    known = NameSet()
    for file in files:
        known.add(file.path)
    return tuple(files)


def publish_manifest(storage: Storage, name: str, manifest: Manifest) -> bool:
    """Publish the manifest of a tree whose files are stored; see :meth:`Storage.publish_document`."""
    return storage.publish_document(name, manifest.to_bytes())


def read_manifest(storage: Storage, name: str) -> Manifest | None:
    """Return the manifest published as ``name``, or None.

    Raises:
        StorageError: the document is damaged.
    """
    document = storage.read_document(name)
    if document is None:
        return None
    try:
        return Manifest.model_validate_json(document)
    except ValidationError as error:
        raise StorageError(f"The document {name} of the store is damaged; run octasplat fsck.") from error

"""Protocol of a storage: content addressed by SHA-256, and small documents that are published once.

A *blob* is content of any length whose name is the SHA-256 of its bytes; it becomes visible when it is
complete and its digest is verified, never before. A *document* is a small named text, usually a manifest of
blobs; publishing one is a single atomic step that never replaces another. Photographs, checkpoints and
results are blobs; a table or a document records which of them belong together.

All calls block; a server calls them from threads.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Protocol, Self, runtime_checkable

SHA256 = re.compile(r"[0-9a-f]{64}")
DOCUMENT_NAME = re.compile(r"[a-z0-9][a-z0-9._-]{0,127}(/[a-z0-9][a-z0-9._-]{0,127}){0,7}")
MAX_DOCUMENT_BYTES = 64 << 20


@dataclass(frozen=True)
class Blob:
    """Stored content.

    Attributes:
        sha256: digest of the bytes, 64 hexadecimal digits in lower case.
        size_bytes: their number.
    """

    sha256: str
    size_bytes: int


@dataclass(frozen=True)
class StoredBlob:
    """A blob as a listing of the store shows it; ``modified_unix`` is when it was last written, s."""

    blob: Blob
    modified_unix: float


@runtime_checkable
class BlobWriter(Protocol):
    """Writer of one blob; it is visible after :meth:`commit`. Left as a context, it aborts."""

    def write(self, data: bytes | memoryview) -> None:
        """Take the next bytes.

        Raises:
            ContentTooLargeError: more than announced or allowed.
            StorageFullError: no room is left.
            StorageUnavailableError: the store does not answer.
        """
        ...

    def commit(self) -> Blob:
        """Make the content visible, durably.

        Raises:
            DigestMismatchError: digest or length are not as announced; nothing is stored.
            StorageFullError: no room is left.
            StorageUnavailableError: the store does not answer.
        """
        ...

    def abort(self) -> None:
        """Discard what was written; does nothing after :meth:`commit` or a second time."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(self, *exception: object) -> None: ...


@runtime_checkable
class Storage(Protocol):
    """A storage of blobs and documents, see the module. Digests and names that are malformed: ValueError."""

    def open_writer(
        self, *, sha256: str | None = None, size_bytes: int | None = None, max_bytes: int | None = None
    ) -> BlobWriter:
        """Begin to write a blob.

        Args:
            sha256: digest that the content must turn out to have.
            size_bytes: length that it must turn out to have.
            max_bytes: length at which it is refused.

        Raises:
            StorageFullError: ``size_bytes`` do not fit.
            ContentTooLargeError: ``size_bytes`` is above ``max_bytes``.
        """
        ...

    def stat(self, sha256: str) -> Blob:
        """Return the blob of that digest.

        Raises:
            BlobNotFoundError: there is none.
        """
        ...

    def open(self, sha256: str) -> BinaryIO:
        """Return the content as a seekable file.

        Raises:
            BlobNotFoundError: there is none.
        """
        ...

    def read(self, sha256: str, start: int = 0, stop: int | None = None) -> Iterator[bytes]:
        """Yield bytes ``start`` to ``stop`` of the content, in pieces.

        Raises:
            BlobNotFoundError: there is none.
        """
        ...

    def local_path(self, sha256: str) -> Path | None:
        """Return the content's file on this machine, read-only; None for a remote storage.

        Raises:
            BlobNotFoundError: there is none.
        """
        ...

    def materialise(self, sha256: str, target: Path, *, writable: bool = False) -> None:
        """Put the content at ``target``, which must not exist; its folder is made.

        Args:
            sha256: what.
            target: where.
            writable: a copy of its own; otherwise the file may be shared with the store and must not be
                changed in place.

        Raises:
            BlobNotFoundError: there is none.
            DigestMismatchError: the stored bytes are damaged (only noticed where they are copied).
            StorageFullError: no room is left at ``target``.
        """
        ...

    def delete(self, sha256: str) -> bool:
        """Remove a blob; False if there was none."""
        ...

    def delete_older(self, sha256: str, before_unix: float) -> bool:
        """Remove a blob unless it was written, or written again, since ``before_unix``, s.

        Returns:
            False if it was, or if there was none.
        """
        ...

    def list_blobs(self) -> Iterator[StoredBlob]:
        """Return all blobs, in no order."""
        ...

    def publish_document(self, name: str, document: bytes) -> bool:
        """Store a document under a name that is free, in one atomic step.

        Returns:
            True if the name now holds this very document, also where an earlier call had put it there;
            False if another document holds the name, which then stays.
        """
        ...

    def read_document(self, name: str) -> bytes | None:
        """Return the document of that name, or None."""
        ...

    def list_documents(self, prefix: str = "") -> Iterator[str]:
        """Return names of the documents that begin with ``prefix``, in no order."""
        ...

    def remove_document(self, name: str) -> bool:
        """Remove a document; False if there was none."""
        ...

    def ensure_space(self, size_bytes: int) -> None:
        """Refuse early a size that would not fit.

        Raises:
            StorageFullError: ``size_bytes`` more would go below the floor.
        """
        ...

    def free_bytes(self) -> int | None:
        """Return the space above the floor, negative below it; None where the capacity is unknown."""
        ...

    def check(self) -> None:
        """Check that the storage can be used now.

        Raises:
            StorageUnavailableError: it is not there, does not answer, or refuses the service.
        """
        ...

    def remove_stale_uploads(self, older_than_seconds: float) -> int:
        """Remove the remains of killed uploads; returns how many there were."""
        ...


def check_sha256(sha256: str) -> str:
    """Return the digest if it is valid; raise otherwise.

    Raises:
        ValueError: it is not 64 lower-case hexadecimal digits.
    """
    if not SHA256.fullmatch(sha256):
        raise ValueError(f"{sha256[:80]!r} is not a SHA-256 in lower-case hexadecimal digits")
    return sha256


def check_document_name(name: str) -> str:
    """Return the name if it is valid for a document; raise otherwise.

    Raises:
        ValueError: it is not made of parts like ``a-z0-9._-`` joined by ``/``.
    """
    if not DOCUMENT_NAME.fullmatch(name):
        raise ValueError(f"{name[:80]!r} cannot be the name of a document")
    return name

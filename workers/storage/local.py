"""A store in a folder of this machine, or of a file system that several machines share.

    blobs/ab/abcdef...      content, named by its digest, read-only
    documents/<name>        published documents
    staging/<uuid>          what is being written

Everything is written to ``staging/``, flushed to the disk and then renamed (a blob) or linked (a document,
as a link never replaces a file) to its place. Folders are held open and files are opened relative to them
without following links, so that nothing outside is touched whatever is put into the folder meanwhile.
"""

import errno
import os
import stat
import sys
import time
import uuid
import weakref
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

from octasplat.workers.storage.errors import BlobNotFoundError, StorageFullError, StorageUnavailableError
from octasplat.workers.storage.os_errors import FREE_SPACE_HINT, translate_os_errors
from octasplat.workers.storage.protocol import (
    MAX_DOCUMENT_BYTES,
    SHA256,
    Blob,
    StoredBlob,
    check_document_name,
    check_sha256,
)
from octasplat.workers.storage.verified_copy import copy_verified
from octasplat.workers.storage.verifying_writer import VerifyingWriter

DEFAULT_FLOOR_BYTES = 2 << 30
_CHECK_EVERY_BYTES = 16 << 20
_PIECE_BYTES = 1 << 20
# Another file system, one without links, or too many of them: the content is copied then.
_LINK_ERRORS = frozenset({errno.EXDEV, errno.EPERM, errno.EMLINK, errno.ENOTSUP, errno.EACCES})


class LocalStorage:
    """A :class:`octasplat.workers.storage.protocol.Storage` in a folder.

    Args:
        root: the folder; made with access for its owner only.
        floor_bytes: room on the disk that writing never takes.

    Raises:
        StorageUnavailableError: the folder cannot be made or used.
    """

    def __init__(self, root: Path, *, floor_bytes: int = DEFAULT_FLOOR_BYTES) -> None:
        self.root = root
        self.floor_bytes = floor_bytes
        folders: list[int] = []
        self._finalizer = weakref.finalize(self, _close_all, folders)
        with translate_os_errors(root):
            root.mkdir(parents=True, exist_ok=True, mode=0o700)
            folders.append(os.open(root, os.O_DIRECTORY | os.O_RDONLY | os.O_CLOEXEC))
            for name in ("blobs", "documents", "staging"):
                folders.append(_open_folder(folders[0], name))
        self._root_fd, self._blobs_fd, self._documents_fd, self._staging_fd = folders

    def close(self) -> None:
        """Close the folders; the storage must not be used afterwards."""
        self._finalizer()

    def open_writer(
        self, *, sha256: str | None = None, size_bytes: int | None = None, max_bytes: int | None = None
    ) -> "LocalWriter":
        """Begin to write a blob; see the protocol."""
        return LocalWriter(self, sha256, size_bytes, max_bytes)

    def stat(self, sha256: str) -> Blob:
        """Return the blob of that digest; see the protocol."""
        fd = self._open_blob(sha256)
        try:
            return Blob(sha256, os.fstat(fd).st_size)
        finally:
            os.close(fd)

    def open(self, sha256: str) -> BinaryIO:
        """Return the content as a file; see the protocol."""
        return os.fdopen(self._open_blob(sha256), "rb")

    def read(self, sha256: str, start: int = 0, stop: int | None = None) -> Iterator[bytes]:
        """Yield bytes of the content in pieces; see the protocol."""
        self.stat(sha256)
        return self._chunks(sha256, start, stop)

    def local_path(self, sha256: str) -> Path | None:
        """Return the blob's own file; see the protocol."""
        self.stat(sha256)
        return self.root / "blobs" / sha256[:2] / sha256

    def materialise(self, sha256: str, target: Path, *, writable: bool = False) -> None:
        """Link or copy to ``target``; see the protocol."""
        source = self.stat(sha256)
        with translate_os_errors(target):
            target.parent.mkdir(parents=True, exist_ok=True)
            if not writable:
                try:
                    os.link(
                        f"{sha256[:2]}/{sha256}", target, src_dir_fd=self._blobs_fd, follow_symlinks=False
                    )
                    return
                except OSError as error:
                    if error.errno not in _LINK_ERRORS:
                        raise
            copy_verified(self.read(sha256), source, target)

    def delete(self, sha256: str) -> bool:
        """Remove a blob; see the protocol."""
        check_sha256(sha256)
        with translate_os_errors(self.root):
            try:
                os.unlink(f"{sha256[:2]}/{sha256}", dir_fd=self._blobs_fd)
            except FileNotFoundError:
                return False
            return True

    def delete_older(self, sha256: str, before_unix: float) -> bool:
        """Remove a blob that is old; see the protocol."""
        check_sha256(sha256)
        name, aside = f"{sha256[:2]}/{sha256}", uuid.uuid4().hex
        with translate_os_errors(self.root):
            try:
                if os.stat(name, dir_fd=self._blobs_fd, follow_symlinks=False).st_mtime >= before_unix:
                    return False
                # Looked at once more where nobody replaces it; a young one gets its place back.
                os.rename(name, aside, src_dir_fd=self._blobs_fd, dst_dir_fd=self._staging_fd)
            except FileNotFoundError:
                return False
            try:
                facts = os.stat(aside, dir_fd=self._staging_fd, follow_symlinks=False)
                if facts.st_mtime < before_unix:
                    return True
                # Somebody has written it again meanwhile.
                with suppress(FileExistsError):
                    os.link(
                        aside,
                        name,
                        src_dir_fd=self._staging_fd,
                        dst_dir_fd=self._blobs_fd,
                        follow_symlinks=False,
                    )
                return False
            finally:
                self._remove_staged(aside)

    def list_blobs(self) -> Iterator[StoredBlob]:
        """Yield all blobs; see the protocol."""
        for folder in _list_folder(self._blobs_fd, "."):
            for name in _list_folder(self._blobs_fd, folder):
                with suppress(FileNotFoundError):
                    facts = os.stat(f"{folder}/{name}", dir_fd=self._blobs_fd, follow_symlinks=False)
                    if SHA256.fullmatch(name) and name[:2] == folder and stat.S_ISREG(facts.st_mode):
                        yield StoredBlob(Blob(name, facts.st_size), facts.st_mtime)

    def publish_document(self, name: str, document: bytes) -> bool:
        """Store a document under a free name; see the protocol."""
        check_document_name(name)
        if len(document) > MAX_DOCUMENT_BYTES:
            raise ValueError(f"a document of {len(document)} bytes is too large")
        with translate_os_errors(self.root):
            self.ensure_space(len(document))
            staged, fd = self._stage()
            try:
                with os.fdopen(fd, "wb") as handle:
                    handle.write(document)
                    handle.flush()
                    os.fsync(fd)
                *folders, last = name.split("/")
                folder_fd = os.dup(self._documents_fd)
                try:
                    for folder in folders:
                        inner = _open_folder(folder_fd, folder)
                        os.close(folder_fd)
                        folder_fd = inner
                    os.link(
                        staged,
                        last,
                        src_dir_fd=self._staging_fd,
                        dst_dir_fd=folder_fd,
                        follow_symlinks=False,
                    )
                    os.fsync(folder_fd)
                finally:
                    os.close(folder_fd)
            except FileExistsError:
                return self.read_document(name) == document
            finally:
                self._remove_staged(staged)
        return True

    def read_document(self, name: str) -> bytes | None:
        """Return the document of that name; see the protocol."""
        check_document_name(name)
        with translate_os_errors(self.root):
            try:
                fd = os.open(name, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC, dir_fd=self._documents_fd)
            except (FileNotFoundError, NotADirectoryError):
                return None
            with os.fdopen(fd, "rb") as handle:
                return handle.read()

    def list_documents(self, prefix: str = "") -> Iterator[str]:
        """Yield names of documents; see the protocol."""
        for folder, _, files, _ in os.fwalk(".", dir_fd=self._documents_fd):
            for file in files:
                name = f"{folder}/{file}".removeprefix("./")
                if name.startswith(prefix):
                    yield name

    def remove_document(self, name: str) -> bool:
        """Remove a document; see the protocol."""
        check_document_name(name)
        with translate_os_errors(self.root):
            try:
                os.unlink(name, dir_fd=self._documents_fd)
            except (FileNotFoundError, NotADirectoryError):
                return False
            folder = name.rpartition("/")[0]
            if "/" in folder:  # a job's own; that of all jobs is about to be used by others
                with suppress(OSError):  # other documents are in it
                    os.rmdir(folder, dir_fd=self._documents_fd)
            return True

    def free_bytes(self) -> int:
        """Return the space above the floor; see the protocol."""
        with translate_os_errors(self.root):
            facts = os.fstatvfs(self._root_fd)
        return facts.f_bavail * facts.f_frsize - self.floor_bytes

    def ensure_space(self, size_bytes: int) -> None:
        """Refuse a size that would go below the floor; see the protocol."""
        free = self.free_bytes()
        if size_bytes > free:
            raise StorageFullError(
                f"The disk of the store has {max(0, free)} bytes left to use ({self.floor_bytes} more are "
                f"kept free) but {size_bytes} are needed; {FREE_SPACE_HINT}."
            )

    def check(self) -> None:
        """Check that the folder exists and can be written; see the protocol."""
        with translate_os_errors(self.root):
            # A disk that was unmounted leaves another folder in its place, or none.
            if not os.path.samestat(self.root.stat(), os.fstat(self._root_fd)):
                raise StorageUnavailableError(
                    f"{self.root} is not the folder that the store was opened in; mount it again."
                )
            if not os.access("staging", os.W_OK | os.X_OK, dir_fd=self._root_fd):
                raise StorageUnavailableError(
                    f"{self.root} cannot be written; check its disk and its access."
                )

    def remove_stale_uploads(self, older_than_seconds: float) -> int:
        """Remove old files from staging; see the protocol."""
        removed = 0
        for name in _list_folder(self._staging_fd, "."):
            with suppress(FileNotFoundError):
                facts = os.stat(name, dir_fd=self._staging_fd, follow_symlinks=False)
                if time.time() - facts.st_mtime > older_than_seconds:
                    os.unlink(name, dir_fd=self._staging_fd)
                    removed += 1
        return removed

    def _chunks(self, sha256: str, start: int, stop: int | None) -> Iterator[bytes]:
        left = sys.maxsize if stop is None else max(0, stop - start)
        with self.open(sha256) as handle:
            handle.seek(start)
            while left and (piece := handle.read(min(_PIECE_BYTES, left))):
                left -= len(piece)
                yield piece

    def _open_blob(self, sha256: str) -> int:
        check_sha256(sha256)
        with translate_os_errors(self.root):
            try:
                return os.open(
                    f"{sha256[:2]}/{sha256}",
                    os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC,
                    dir_fd=self._blobs_fd,
                )
            except FileNotFoundError:
                raise BlobNotFoundError(f"The store {self.root} does not hold {sha256}.") from None

    def _stage(self) -> tuple[str, int]:
        name = uuid.uuid4().hex
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
        return name, os.open(name, flags, 0o600, dir_fd=self._staging_fd)

    def _remove_staged(self, name: str) -> None:
        with suppress(OSError):
            os.unlink(name, dir_fd=self._staging_fd)


class LocalWriter(VerifyingWriter):
    """Writes a blob into the staging folder of a :class:`LocalStorage`."""

    def __init__(
        self, storage: LocalStorage, sha256: str | None, size_bytes: int | None, max_bytes: int | None
    ) -> None:
        # Before super(), which discards where the announced length is too large.
        self._fd = -1
        super().__init__(sha256, size_bytes, max_bytes)
        self._storage = storage
        self._until_check = 0
        storage.ensure_space(size_bytes or 0)
        with translate_os_errors(storage.root):
            self._staged, self._fd = storage._stage()

    def _write_bytes(self, data: bytes | memoryview) -> None:
        self._until_check -= len(data)
        if self._until_check < 0:
            self._storage.ensure_space(len(data))
            self._until_check = _CHECK_EVERY_BYTES
        with translate_os_errors(self._storage.root):
            rest = memoryview(data)
            while len(rest):
                rest = rest[os.write(self._fd, rest) :]

    def _publish(self, blob: Blob) -> None:
        storage = self._storage
        with translate_os_errors(storage.root):
            # Read-only, as materialise() may give other folders links to this very file.
            os.fchmod(self._fd, 0o444)
            os.fsync(self._fd)
            folder_fd = _open_folder(storage._blobs_fd, blob.sha256[:2])
            try:
                # A blob that is there already has the same bytes; replacing it also mends a damaged one.
                os.rename(self._staged, blob.sha256, src_dir_fd=storage._staging_fd, dst_dir_fd=folder_fd)
                os.fsync(folder_fd)
            finally:
                os.close(folder_fd)
        os.close(self._fd)
        self._fd = -1

    def _discard(self) -> None:
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1
            self._storage._remove_staged(self._staged)


def _close_all(folders: list[int]) -> None:
    for folder in folders:
        os.close(folder)


def _open_folder(parent_fd: int, name: str) -> int:
    """Open the folder ``name`` below ``parent_fd``; it is made, durably, if it is not there."""
    flags = os.O_DIRECTORY | os.O_NOFOLLOW | os.O_RDONLY | os.O_CLOEXEC
    try:
        return os.open(name, flags, dir_fd=parent_fd)
    except FileNotFoundError:
        with suppress(FileExistsError):
            os.mkdir(name, 0o700, dir_fd=parent_fd)
        os.fsync(parent_fd)
        return os.open(name, flags, dir_fd=parent_fd)


def _list_folder(folder_fd: int, name: str) -> list[str]:
    try:
        fd = os.open(name, os.O_DIRECTORY | os.O_NOFOLLOW | os.O_RDONLY | os.O_CLOEXEC, dir_fd=folder_fd)
    except (FileNotFoundError, NotADirectoryError):
        return []
    try:
        return os.listdir(fd)  # noqa: PTH208 - an open folder has no path
    finally:
        os.close(fd)

"""Base of all blob writers: counts, hashes and compares with the announced length and digest."""

import hashlib
import threading
from abc import ABC, abstractmethod
from typing import Self

from octasplat.workers.storage.errors import ContentTooLargeError, DigestMismatchError
from octasplat.workers.storage.protocol import Blob, check_sha256


class VerifyingWriter(ABC):
    """Base of the writers; subclasses store bytes and make them visible or discard them."""

    def __init__(self, sha256: str | None, size_bytes: int | None, max_bytes: int | None) -> None:
        self._expected_sha256 = None if sha256 is None else check_sha256(sha256)
        self._expected_bytes = size_bytes
        self._max_bytes = max_bytes
        self._hash = hashlib.sha256()
        self._byte_count = 0
        self._open = True
        # A cancelled upload is aborted while a thread may still write; a file must not be closed under it.
        self._lock = threading.RLock()
        if size_bytes is not None:
            self._check_size(size_bytes, max_bytes)

    def write(self, data: bytes | memoryview) -> None:
        """Write the next bytes; see the protocol."""
        with self._lock:
            self._write(data)

    def commit(self) -> Blob:
        """Verify the content and make it visible; see the protocol."""
        with self._lock:
            return self._commit()

    def abort(self) -> None:
        """Discard the content; see the protocol."""
        with self._lock:
            if self._open:
                self._open = False
                self._discard()

    def _write(self, data: bytes | memoryview) -> None:
        if not self._open:
            raise ValueError("the writer is closed")
        count = self._byte_count + len(data)
        self._check_size(count, self._max_bytes)
        if self._expected_bytes is not None and count > self._expected_bytes:
            self.abort()
            raise ContentTooLargeError(
                f"More than the announced {self._expected_bytes} bytes came; send the file again."
            )
        self._hash.update(data)
        try:
            self._write_bytes(data)
        except BaseException:
            self.abort()
            raise
        self._byte_count = count

    def _commit(self) -> Blob:
        if not self._open:
            raise ValueError("the writer is closed")
        blob = Blob(self._hash.hexdigest(), self._byte_count)
        try:
            if self._expected_bytes is not None and blob.size_bytes != self._expected_bytes:
                raise DigestMismatchError(
                    f"{blob.size_bytes} bytes came where {self._expected_bytes} were announced; "
                    "send the file again."
                )
            if self._expected_sha256 is not None and blob.sha256 != self._expected_sha256:
                raise DigestMismatchError(
                    f"The content has the SHA-256 {blob.sha256} where {self._expected_sha256} was "
                    "announced; send the file again."
                )
            self._publish(blob)
        except BaseException:
            self.abort()
            raise
        self._open = False
        return blob

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.abort()

    def _check_size(self, count: int, max_bytes: int | None) -> None:
        if max_bytes is not None and count > max_bytes:
            self.abort()
            raise ContentTooLargeError(
                f"The content is larger than the allowed {max_bytes} bytes.", max_bytes
            )

    @abstractmethod
    def _write_bytes(self, data: bytes | memoryview) -> None:
        """Write the next bytes to the storage."""

    @abstractmethod
    def _publish(self, blob: Blob) -> None:
        """Make all bytes visible as ``blob``, durably."""

    @abstractmethod
    def _discard(self) -> None:
        """Discard all bytes; raises nothing."""

"""A store in a bucket that speaks S3.

    <prefix>blobs/ab/abcdef...      content, named by its digest
    <prefix>documents/<name>        published documents
    <prefix>staging/<uuid>          content whose digest is not known beforehand

Content is sent in parts of a fixed size, so memory does not grow with it, and becomes visible when the upload
is completed, which happens after its digest is verified. A document is published by one conditional write
(``If-None-Match: *``). Credentials and the address are found as every AWS tool finds them
(``AWS_ACCESS_KEY_ID``, ``AWS_ENDPOINT_URL_S3`` and so on).
"""

import io
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import boto3
from botocore.config import Config
from botocore.exceptions import BotoCoreError, ClientError

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

if TYPE_CHECKING:
    from mypy_boto3_s3 import S3Client

PART_BYTES = 8 << 20
"""Length of the first parts; S3 takes at most 10,000 parts of at least 5 MiB."""

_LARGE_PART_BYTES = 64 << 20
_SMALL_PARTS = 2000
_COPY_BYTES = 1 << 30
_PIECE_BYTES = 1 << 20
_NOT_FOUND_CODES = frozenset({"NoSuchKey", "404", "NotFound"})
_EXISTS_CODES = frozenset({"PreconditionFailed", "412"})
_BUSY_CODES = frozenset({"ConditionalRequestConflict", "409", "OperationAborted"})
_FULL_CODES = frozenset({"QuotaExceeded", "XMinioStorageFull", "InsufficientStorage", "507"})


class S3Storage:
    """A :class:`octasplat.workers.storage.protocol.Storage` in a bucket.

    Args:
        bucket: an existing bucket.
        prefix: what all keys begin with, e.g. ``octasplat/``.
        endpoint_url: address of a store that is not Amazon's.
        client: a client to use instead of a new one.
    """

    def __init__(
        self,
        bucket: str,
        prefix: str = "",
        *,
        endpoint_url: str | None = None,
        client: "S3Client | None" = None,
    ) -> None:
        self.bucket = bucket
        self.prefix = prefix
        # Newer checksum headers are only sent where they must be, as not every store knows them.
        self.client: S3Client = client or boto3.client(
            "s3",
            endpoint_url=endpoint_url,
            config=Config(
                retries={"max_attempts": 5, "mode": "standard"},
                connect_timeout=5,
                read_timeout=60,
                max_pool_connections=32,
                request_checksum_calculation="when_required",
                response_checksum_validation="when_required",
            ),
        )

    def close(self) -> None:
        """Close the HTTP connections."""
        self.client.close()

    def open_writer(
        self, *, sha256: str | None = None, size_bytes: int | None = None, max_bytes: int | None = None
    ) -> "S3Writer":
        """Begin to write a blob; see the protocol."""
        return S3Writer(self, sha256, size_bytes, max_bytes)

    def stat(self, sha256: str) -> Blob:
        """Return the blob of that digest; see the protocol."""
        key = self._blob_key(sha256)
        with self._translate_errors(sha256):
            facts = self.client.head_object(Bucket=self.bucket, Key=key)
        return Blob(sha256, facts["ContentLength"])

    def open(self, sha256: str) -> BinaryIO:
        """Return the content as a seekable file, read ahead by 256 KiB; see the protocol."""
        return io.BufferedReader(_RangeReader(self, self.stat(sha256)), 256 << 10)

    def read(self, sha256: str, start: int = 0, stop: int | None = None) -> Iterator[bytes]:
        """Yield bytes of the content in pieces; see the protocol."""
        size = self.stat(sha256).size_bytes
        stop = size if stop is None else min(stop, size)
        return self._chunks(sha256, start, stop)

    def local_path(self, sha256: str) -> None:
        """Return None, as a bucket has no files; see the protocol."""
        self.stat(sha256)

    def materialise(self, sha256: str, target: Path, *, writable: bool = False) -> None:
        """Download to ``target``; see the protocol."""
        blob = self.stat(sha256)
        with translate_os_errors(target):
            target.parent.mkdir(parents=True, exist_ok=True)
            copy_verified(self.read(sha256), blob, target)

    def delete(self, sha256: str) -> bool:
        """Remove a blob; see the protocol."""
        try:
            self.stat(sha256)
        except BlobNotFoundError:
            return False
        with self._translate_errors(sha256):
            self.client.delete_object(Bucket=self.bucket, Key=self._blob_key(sha256))
        return True

    def delete_older(self, sha256: str, before_unix: float) -> bool:
        """Remove a blob that is old; see the protocol. S3 has no atomic check and removal."""
        key = self._blob_key(sha256)
        try:
            with self._translate_errors(sha256):
                facts = self.client.head_object(Bucket=self.bucket, Key=key)
        except BlobNotFoundError:
            return False
        if facts["LastModified"].timestamp() >= before_unix:
            return False
        with self._translate_errors(sha256):
            self.client.delete_object(Bucket=self.bucket, Key=key)
        return True

    def list_blobs(self) -> Iterator[StoredBlob]:
        """Yield all blobs; see the protocol."""
        for item in self._list("blobs/"):
            name = item["Key"].rpartition("/")[2]
            if SHA256.fullmatch(name):
                yield StoredBlob(Blob(name, item["Size"]), item["LastModified"].timestamp())

    def publish_document(self, name: str, document: bytes) -> bool:
        """Store a document under a free name; see the protocol."""
        key = self._document_key(name)
        if len(document) > MAX_DOCUMENT_BYTES:
            raise ValueError(f"a document of {len(document)} bytes is too large")
        with self._translate_errors(name):
            for pause in (0.1, 0.5, 2.0, None):
                try:
                    self.client.put_object(Bucket=self.bucket, Key=key, Body=document, IfNoneMatch="*")
                    return True
                except ClientError as error:
                    if _error_code(error) in _EXISTS_CODES:
                        break
                    if _error_code(error) not in _BUSY_CODES or pause is None:
                        raise
                    time.sleep(pause)
        # A repeated request after a lost answer meets its own document.
        return self.read_document(name) == document

    def read_document(self, name: str) -> bytes | None:
        """Return the document of that name; see the protocol."""
        key = self._document_key(name)
        try:
            with self._translate_errors(name):
                return self.client.get_object(Bucket=self.bucket, Key=key)["Body"].read()
        except BlobNotFoundError:
            return None

    def list_documents(self, prefix: str = "") -> Iterator[str]:
        """Yield names of documents; see the protocol."""
        for item in self._list(f"documents/{prefix}"):
            yield item["Key"].removeprefix(f"{self.prefix}documents/")

    def remove_document(self, name: str) -> bool:
        """Remove a document; see the protocol."""
        key = self._document_key(name)
        try:
            with self._translate_errors(name):
                self.client.head_object(Bucket=self.bucket, Key=key)
                self.client.delete_object(Bucket=self.bucket, Key=key)
        except BlobNotFoundError:
            return False
        return True

    def ensure_space(self, size_bytes: int) -> None:
        """Do nothing, as a bucket has no known capacity; see the protocol."""

    def free_bytes(self) -> None:
        """Return None; see the protocol."""

    def check(self) -> None:
        """Check that the bucket answers; see the protocol."""
        with self._translate_errors("the bucket itself"):
            try:
                self.client.list_objects_v2(Bucket=self.bucket, Prefix=self.prefix, MaxKeys=1)
            except ClientError as error:
                if _error_code(error) in _NOT_FOUND_CODES | {"NoSuchBucket"}:
                    raise StorageUnavailableError(
                        f"There is no bucket {self.bucket}; check its name."
                    ) from error
                raise

    def remove_stale_uploads(self, older_than_seconds: float) -> int:
        """Remove old staged objects and abort old uploads; see the protocol."""
        removed = 0
        latest = time.time() - older_than_seconds
        for item in self._list("staging/"):
            if item["LastModified"].timestamp() < latest:
                with self._translate_errors("staging"):
                    self.client.delete_object(Bucket=self.bucket, Key=item["Key"])
                removed += 1
        with self._translate_errors("staging"):
            pages = self.client.get_paginator("list_multipart_uploads").paginate(
                Bucket=self.bucket, Prefix=self.prefix
            )
            for page in pages:
                for upload in page.get("Uploads", ()):
                    if upload["Initiated"].timestamp() < latest:
                        self.client.abort_multipart_upload(
                            Bucket=self.bucket, Key=upload["Key"], UploadId=upload["UploadId"]
                        )
                        removed += 1
        return removed

    def _blob_key(self, sha256: str) -> str:
        return f"{self.prefix}blobs/{check_sha256(sha256)[:2]}/{sha256}"

    def _document_key(self, name: str) -> str:
        return f"{self.prefix}documents/{check_document_name(name)}"

    def _list(self, folder: str) -> Iterator[Any]:
        with self._translate_errors(folder):
            pages = self.client.get_paginator("list_objects_v2").paginate(
                Bucket=self.bucket, Prefix=f"{self.prefix}{folder}"
            )
            for page in pages:
                yield from page.get("Contents", ())

    def _chunks(self, sha256: str, start: int, stop: int) -> Iterator[bytes]:
        if start >= stop:
            return
        with self._translate_errors(sha256):
            body = self.client.get_object(
                Bucket=self.bucket, Key=self._blob_key(sha256), Range=f"bytes={start}-{stop - 1}"
            )["Body"]
            with body:
                yield from body.iter_chunks(_PIECE_BYTES)

    @contextmanager
    def _translate_errors(self, what: str) -> Iterator[None]:
        """Translate errors of the client into those of a storage."""
        try:
            yield
        except ClientError as error:
            code = _error_code(error)
            if code in _NOT_FOUND_CODES:
                raise BlobNotFoundError(f"The bucket {self.bucket} does not hold {what}.") from error
            if code in _FULL_CODES:
                raise StorageFullError(f"The bucket {self.bucket} is full; {FREE_SPACE_HINT}.") from error
            raise StorageUnavailableError(
                f"The bucket {self.bucket} refuses the service ({code}); check its name and the credentials."
            ) from error
        except BotoCoreError as error:
            raise StorageUnavailableError(
                f"The bucket {self.bucket} cannot be reached ({type(error).__name__}); "
                "check the address of the store."
            ) from error


class S3Writer(VerifyingWriter):
    """Writes a blob into the bucket of an :class:`S3Storage`, holding one part in memory."""

    def __init__(
        self, storage: S3Storage, sha256: str | None, size_bytes: int | None, max_bytes: int | None
    ) -> None:
        self._upload: str | None = None
        super().__init__(sha256, size_bytes, max_bytes)
        self._storage = storage
        self._parts: list[Any] = []
        self._buffer = bytearray()
        self._staging_key = f"{storage.prefix}staging/{uuid.uuid4().hex}"
        self._key = self._staging_key if sha256 is None else storage._blob_key(sha256)

    def _write_bytes(self, data: bytes | memoryview) -> None:
        rest = memoryview(data)
        while len(rest):
            part_bytes = PART_BYTES if len(self._parts) < _SMALL_PARTS else _LARGE_PART_BYTES
            taken = min(len(rest), part_bytes - len(self._buffer))
            self._buffer += rest[:taken]
            rest = rest[taken:]
            if len(self._buffer) >= part_bytes:
                self._send_part()

    def _send_part(self) -> None:
        client, bucket = self._storage.client, self._storage.bucket
        number = len(self._parts) + 1
        with self._storage._translate_errors(self._key):
            if self._upload is None:
                self._upload = client.create_multipart_upload(Bucket=bucket, Key=self._key)["UploadId"]
            answer = client.upload_part(
                Bucket=bucket,
                Key=self._key,
                UploadId=self._upload,
                PartNumber=number,
                Body=bytes(self._buffer),
            )
        self._parts.append({"ETag": answer["ETag"], "PartNumber": number})
        self._buffer.clear()

    def _publish(self, blob: Blob) -> None:
        storage = self._storage
        final_key = storage._blob_key(blob.sha256)
        if self._upload is None:
            with storage._translate_errors(final_key):
                storage.client.put_object(Bucket=storage.bucket, Key=final_key, Body=bytes(self._buffer))
            return
        if self._buffer:
            self._send_part()
        with storage._translate_errors(self._key):
            storage.client.complete_multipart_upload(
                Bucket=storage.bucket,
                Key=self._key,
                UploadId=self._upload,
                MultipartUpload={"Parts": self._parts},
            )
            self._upload = None
            if self._key != final_key:
                self._copy_to_final_key(final_key, blob.size_bytes)

    def _copy_to_final_key(self, final_key: str, size_bytes: int) -> None:
        """Copy inside the storage, in ranges, as a single copy is limited to 5 GiB."""
        client, bucket = self._storage.client, self._storage.bucket
        source: Any = {"Bucket": bucket, "Key": self._key}
        upload = client.create_multipart_upload(Bucket=bucket, Key=final_key)["UploadId"]
        try:
            parts: list[Any] = []
            step = max(_COPY_BYTES, -(-size_bytes // 9000))
            for number, start in enumerate(range(0, size_bytes, step), start=1):
                answer = client.upload_part_copy(
                    Bucket=bucket,
                    Key=final_key,
                    UploadId=upload,
                    PartNumber=number,
                    CopySource=source,
                    CopySourceRange=f"bytes={start}-{min(start + step, size_bytes) - 1}",
                )
                parts.append({"ETag": answer["CopyPartResult"]["ETag"], "PartNumber": number})
            client.complete_multipart_upload(
                Bucket=bucket, Key=final_key, UploadId=upload, MultipartUpload={"Parts": parts}
            )
        except BaseException:
            with suppress(ClientError, BotoCoreError):
                client.abort_multipart_upload(Bucket=bucket, Key=final_key, UploadId=upload)
            raise
        finally:
            with suppress(ClientError, BotoCoreError):
                client.delete_object(Bucket=bucket, Key=self._key)

    def _discard(self) -> None:
        if self._upload is not None:
            with suppress(ClientError, BotoCoreError):
                self._storage.client.abort_multipart_upload(
                    Bucket=self._storage.bucket, Key=self._key, UploadId=self._upload
                )
            self._upload = None


class _RangeReader(io.RawIOBase):
    """A blob as a raw file; every read requests one range."""

    def __init__(self, storage: S3Storage, blob: Blob) -> None:
        self._storage = storage
        self._blob = blob
        self._position = 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        base = {io.SEEK_SET: 0, io.SEEK_CUR: self._position, io.SEEK_END: self._blob.size_bytes}[whence]
        if base + offset < 0:
            raise OSError("seek before the beginning")
        self._position = base + offset
        return self._position

    def readinto(self, buffer: Any) -> int:
        stop = min(self._position + len(buffer), self._blob.size_bytes)
        count = 0
        for piece in self._storage._chunks(self._blob.sha256, self._position, stop):
            buffer[count : count + len(piece)] = piece
            count += len(piece)
        self._position += count
        return count


def _error_code(error: ClientError) -> str:
    return str(error.response.get("Error", {}).get("Code", ""))

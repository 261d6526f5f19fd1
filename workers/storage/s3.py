"""A store in a bucket that speaks S3.

    <prefix>blobs/ab/abcdef...      content, named by its digest
    <prefix>documents/<name>        published documents
    <prefix>staging/<uuid>          content whose digest is not known beforehand

Content is sent in parts of one size, of which one is in memory, and becomes visible when the upload
is completed, which happens after its digest is verified. A document is published by one conditional write
(``If-None-Match: *``). Credentials and the address are found as every AWS tool finds them
(``AWS_ACCESS_KEY_ID``, ``AWS_ENDPOINT_URL_S3`` and so on).
"""

import io
import time
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from botocore.exceptions import ClientError

from octasplat.workers.storage.errors import BlobNotFoundError, StorageUnavailableError
from octasplat.workers.storage.os_errors import translate_os_errors
from octasplat.workers.storage.protocol import (
    MAX_DOCUMENT_BYTES,
    SHA256,
    Blob,
    StoredBlob,
)
from octasplat.workers.storage.s3_bucket import NOT_FOUND_CODES, S3Bucket, error_code
from octasplat.workers.storage.s3_transfers import S3RangeReader, S3Writer
from octasplat.workers.storage.verified_copy import copy_verified

_EXISTS_CODES = frozenset({"PreconditionFailed", "412"})
_BUSY_CODES = frozenset({"ConditionalRequestConflict", "409", "OperationAborted"})


class S3Storage(S3Bucket):
    """A :class:`octasplat.workers.storage.protocol.Storage` in a bucket.

    Args:
        bucket: an existing bucket.
        prefix: what all keys begin with, e.g. ``octasplat/``.
        endpoint_url: address of a store that is not Amazon's.
        client: a client to use instead of a new one.
    """

    def close(self) -> None:
        """Close the HTTP connections."""
        self.client.close()

    def open_writer(
        self, *, sha256: str | None = None, size_bytes: int | None = None, max_bytes: int | None = None
    ) -> S3Writer:
        """Begin to write a blob; see the protocol."""
        return S3Writer(self, sha256, size_bytes, max_bytes)

    def stat(self, sha256: str) -> Blob:
        """Return the blob of that digest; see the protocol."""
        key = self.blob_key(sha256)
        with self.translate_errors(sha256):
            facts = self.client.head_object(Bucket=self.bucket, Key=key)
        return Blob(sha256, facts["ContentLength"])

    def open(self, sha256: str) -> BinaryIO:
        """Return the content as a seekable file, read ahead by 256 KiB; see the protocol."""
        return io.BufferedReader(S3RangeReader(self, self.stat(sha256)), 256 << 10)

    def read(self, sha256: str, start: int = 0, stop: int | None = None) -> Iterator[bytes]:
        """Yield bytes of the content in pieces; see the protocol."""
        size = self.stat(sha256).size_bytes
        stop = size if stop is None else min(stop, size)
        return self.read_chunks(sha256, start, stop)

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
            # S3 answers a deletion in the same way whether or not there was an object.
            self.stat(sha256)
        except BlobNotFoundError:
            return False
        with self.translate_errors(sha256):
            self.client.delete_object(Bucket=self.bucket, Key=self.blob_key(sha256))
        return True

    def delete_older(self, sha256: str, before_unix: float) -> bool:
        """Remove a blob that is old; see the protocol. S3 has no atomic check and removal."""
        key = self.blob_key(sha256)
        try:
            with self.translate_errors(sha256):
                facts = self.client.head_object(Bucket=self.bucket, Key=key)
        except BlobNotFoundError:
            return False
        if facts["LastModified"].timestamp() >= before_unix:
            return False
        with self.translate_errors(sha256):
            self.client.delete_object(Bucket=self.bucket, Key=key)
        return True

    def list_blobs(self) -> Iterator[StoredBlob]:
        """Yield all blobs; see the protocol."""
        for item in self.list_objects("blobs/"):
            name = item["Key"].rpartition("/")[2]
            if SHA256.fullmatch(name):
                yield StoredBlob(Blob(name, item["Size"]), item["LastModified"].timestamp())

    def publish_document(self, name: str, document: bytes) -> bool:
        """Store a document under a free name; see the protocol."""
        key = self.document_key(name)
        if len(document) > MAX_DOCUMENT_BYTES:
            raise ValueError(f"a document of {len(document)} bytes is too large")
        with self.translate_errors(name):
            for pause in (0.1, 0.5, 2.0, None):
                try:
                    self.client.put_object(Bucket=self.bucket, Key=key, Body=document, IfNoneMatch="*")
                    return True
                except ClientError as error:
                    if error_code(error) in _EXISTS_CODES:
                        break
                    if error_code(error) not in _BUSY_CODES or pause is None:
                        raise
                    # Another request for the same key is under way.
                    time.sleep(pause)
        # A repeated request after a lost answer meets its own document.
        return self.read_document(name) == document

    def read_document(self, name: str) -> bytes | None:
        """Return the document of that name; see the protocol."""
        key = self.document_key(name)
        try:
            with self.translate_errors(name):
                return self.client.get_object(Bucket=self.bucket, Key=key)["Body"].read()
        except BlobNotFoundError:
            return None

    def list_documents(self, prefix: str = "") -> Iterator[str]:
        """Yield names of documents; see the protocol."""
        for item in self.list_objects(f"documents/{prefix}"):
            yield item["Key"].removeprefix(f"{self.prefix}documents/")

    def remove_document(self, name: str) -> bool:
        """Remove a document; see the protocol."""
        key = self.document_key(name)
        try:
            with self.translate_errors(name):
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
        with self.translate_errors("the bucket itself"):
            try:
                self.client.list_objects_v2(Bucket=self.bucket, Prefix=self.prefix, MaxKeys=1)
            except ClientError as error:
                if error_code(error) in NOT_FOUND_CODES | {"NoSuchBucket"}:
                    raise StorageUnavailableError(
                        f"There is no bucket {self.bucket}; check its name."
                    ) from error
                raise

    def remove_stale_uploads(self, older_than_seconds: float) -> int:
        """Remove old staged objects and abort old uploads; see the protocol."""
        removed = 0
        latest = time.time() - older_than_seconds
        for item in self.list_objects("staging/"):
            if item["LastModified"].timestamp() < latest:
                with self.translate_errors("staging"):
                    self.client.delete_object(Bucket=self.bucket, Key=item["Key"])
                removed += 1
        with self.translate_errors("staging"):
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

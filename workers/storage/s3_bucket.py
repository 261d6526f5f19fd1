"""A bucket that speaks S3: its keys, and errors of the client as those of a storage."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import boto3
from botocore.config import Config
from botocore.exceptions import BotoCoreError, ClientError

from octasplat.workers.storage.errors import BlobNotFoundError, StorageFullError, StorageUnavailableError
from octasplat.workers.storage.os_errors import FREE_SPACE_HINT
from octasplat.workers.storage.protocol import check_document_name, check_sha256

if TYPE_CHECKING:
    from mypy_boto3_s3 import S3Client

NOT_FOUND_CODES = frozenset({"NoSuchKey", "404", "NotFound"})
_FULL_CODES = frozenset({"QuotaExceeded", "XMinioStorageFull", "InsufficientStorage", "507"})
_PIECE_BYTES = 1 << 20


class S3Bucket:
    """A bucket and the client that reaches it.

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

    def blob_key(self, sha256: str) -> str:
        """Return the key of a blob."""
        return f"{self.prefix}blobs/{check_sha256(sha256)[:2]}/{sha256}"

    def document_key(self, name: str) -> str:
        """Return the key of a document."""
        return f"{self.prefix}documents/{check_document_name(name)}"

    def list_objects(self, folder: str) -> Iterator[Any]:
        """Yield the objects of a folder, as the client describes them."""
        with self.translate_errors(folder):
            pages = self.client.get_paginator("list_objects_v2").paginate(
                Bucket=self.bucket, Prefix=f"{self.prefix}{folder}"
            )
            for page in pages:
                yield from page.get("Contents", ())

    def read_chunks(self, sha256: str, start: int, stop: int) -> Iterator[bytes]:
        """Yield the bytes ``start`` to ``stop`` of a blob in pieces."""
        # A range of HTTP has one byte at least.
        if start >= stop:
            return
        with self.translate_errors(sha256):
            body = self.client.get_object(
                Bucket=self.bucket, Key=self.blob_key(sha256), Range=f"bytes={start}-{stop - 1}"
            )["Body"]
            with body:
                yield from body.iter_chunks(_PIECE_BYTES)

    @contextmanager
    def translate_errors(self, what: str) -> Iterator[None]:
        """Translate errors of the client into those of a storage."""
        try:
            yield
        except ClientError as error:
            code = error_code(error)
            if code in NOT_FOUND_CODES:
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


def error_code(error: ClientError) -> str:
    """Return the code by which S3 names an error."""
    return str(error.response.get("Error", {}).get("Code", ""))

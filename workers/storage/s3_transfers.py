"""Content on its way into a bucket, in parts, and out of it, in ranges."""

import io
import uuid
from contextlib import suppress
from typing import Any

from botocore.exceptions import BotoCoreError, ClientError

from octasplat.workers.storage.errors import ContentTooLargeError
from octasplat.workers.storage.protocol import Blob
from octasplat.workers.storage.s3_bucket import S3Bucket
from octasplat.workers.storage.verifying_writer import VerifyingWriter

PART_BYTES = 8 << 20
"""Least length of all parts but the last, which S3 wants to have 5 MiB, and Cloudflare R2 one length."""
UNKNOWN_PART_BYTES = 64 << 20
"""Length of the parts of content that may have any length, of which S3 takes 625 GiB then."""
MAX_PARTS = 10_000
_MAX_BYTES = 5 << 40  # of R2; S3 takes more by now
_COPY_BYTES = 1 << 30


class S3Writer(VerifyingWriter):
    """Writes a blob into the bucket, holding one part in memory."""

    def __init__(
        self, bucket: S3Bucket, sha256: str | None, size_bytes: int | None, max_bytes: int | None
    ) -> None:
        # Before super(), which discards where the announced length is too large.
        self._upload: str | None = None
        super().__init__(sha256, size_bytes, max_bytes)
        self._bucket = bucket
        self._parts: list[Any] = []
        self._buffer = bytearray()
        self._part_bytes = part_length(max_bytes if size_bytes is None else size_bytes)
        self._staging_key = f"{bucket.prefix}staging/{uuid.uuid4().hex}"
        self._key = self._staging_key if sha256 is None else bucket.blob_key(sha256)

    def _write_bytes(self, data: bytes | memoryview) -> None:
        rest = memoryview(data)
        while len(rest):
            taken = min(len(rest), self._part_bytes - len(self._buffer))
            self._buffer += rest[:taken]
            rest = rest[taken:]
            if len(self._buffer) >= self._part_bytes:
                self._send_part()

    def _send_part(self) -> None:
        client, name = self._bucket.client, self._bucket.bucket
        number = len(self._parts) + 1
        if number > MAX_PARTS:
            most = MAX_PARTS * self._part_bytes
            raise ContentTooLargeError(f"The content is larger than the {most} bytes that fit.", most)
        with self._bucket.translate_errors(self._key):
            if self._upload is None:
                self._upload = client.create_multipart_upload(Bucket=name, Key=self._key)["UploadId"]
            answer = client.upload_part(
                Bucket=name,
                Key=self._key,
                UploadId=self._upload,
                PartNumber=number,
                Body=bytes(self._buffer),
            )
        self._parts.append({"ETag": answer["ETag"], "PartNumber": number})
        self._buffer.clear()

    def _publish(self, blob: Blob) -> None:
        bucket = self._bucket
        final_key = bucket.blob_key(blob.sha256)
        # Less than one part, and nothing was sent yet: one request does it.
        if self._upload is None:
            with bucket.translate_errors(final_key):
                bucket.client.put_object(Bucket=bucket.bucket, Key=final_key, Body=bytes(self._buffer))
            return
        if self._buffer:
            self._send_part()
        with bucket.translate_errors(self._key):
            bucket.client.complete_multipart_upload(
                Bucket=bucket.bucket,
                Key=self._key,
                UploadId=self._upload,
                MultipartUpload={"Parts": self._parts},
            )
            self._upload = None
            if self._key != final_key:
                self._copy_to_final_key(final_key, blob.size_bytes)

    def _copy_to_final_key(self, final_key: str, size_bytes: int) -> None:
        """Copy inside the storage, in ranges, as a single copy is limited to 5 GiB."""
        client, name = self._bucket.client, self._bucket.bucket
        source: Any = {"Bucket": name, "Key": self._key}
        upload = client.create_multipart_upload(Bucket=name, Key=final_key)["UploadId"]
        try:
            parts: list[Any] = []
            # Fewer ranges than the 10,000 parts that an upload may have.
            step = max(_COPY_BYTES, -(-size_bytes // 9000))
            for number, start in enumerate(range(0, size_bytes, step), start=1):
                answer = client.upload_part_copy(
                    Bucket=name,
                    Key=final_key,
                    UploadId=upload,
                    PartNumber=number,
                    CopySource=source,
                    CopySourceRange=f"bytes={start}-{min(start + step, size_bytes) - 1}",
                )
                parts.append({"ETag": answer["CopyPartResult"]["ETag"], "PartNumber": number})
            client.complete_multipart_upload(
                Bucket=name, Key=final_key, UploadId=upload, MultipartUpload={"Parts": parts}
            )
        except BaseException:
            with suppress(ClientError, BotoCoreError):
                client.abort_multipart_upload(Bucket=name, Key=final_key, UploadId=upload)
            raise
        finally:
            with suppress(ClientError, BotoCoreError):
                client.delete_object(Bucket=name, Key=self._key)

    def _discard(self) -> None:
        if self._upload is not None:
            with suppress(ClientError, BotoCoreError):
                self._bucket.client.abort_multipart_upload(
                    Bucket=self._bucket.bucket, Key=self._key, UploadId=self._upload
                )
            self._upload = None


def part_length(most_bytes: int | None) -> int:
    """Return the length of all parts but the last of content that is so long at most; None is not known.

    >>> part_length(1000) == PART_BYTES, part_length(100_000 << 20) >> 20
    (True, 10)
    """
    if most_bytes is None:
        return UNKNOWN_PART_BYTES
    mebibytes = -(-min(most_bytes, _MAX_BYTES) // (MAX_PARTS << 20))
    return max(PART_BYTES, mebibytes << 20)


class S3RangeReader(io.RawIOBase):
    """A blob as a raw file; every read requests one range."""

    def __init__(self, bucket: S3Bucket, blob: Blob) -> None:
        self._bucket = bucket
        self._blob = blob
        self._position = 0

    def readable(self) -> bool:
        """Return True."""
        return True

    def seekable(self) -> bool:
        """Return True."""
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Move the position of the next read; return it."""
        base = {io.SEEK_SET: 0, io.SEEK_CUR: self._position, io.SEEK_END: self._blob.size_bytes}[whence]
        if base + offset < 0:
            raise OSError("seek before the beginning")
        self._position = base + offset
        return self._position

    def readinto(self, buffer: Any) -> int:
        """Request as many bytes as ``buffer`` holds; return how many there were."""
        stop = min(self._position + len(buffer), self._blob.size_bytes)
        count = 0
        for piece in self._bucket.read_chunks(self._blob.sha256, self._position, stop):
            buffer[count : count + len(piece)] = piece
            count += len(piece)
        self._position += count
        return count

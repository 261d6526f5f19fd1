"""Receiving of bodies of any length in constant memory: single files, and archives of datasets."""

import asyncio
import base64
import binascii
import re
import tempfile
import time
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Mapping
from dataclasses import dataclass, field
from typing import BinaryIO

from octasplat.engine.core.portable_names import quoted_name
from octasplat.service.intake.archive import (
    ArchiveFile,
    ArchiveLimits,
    ArchiveListing,
    list_archive,
    unpack_archive,
)
from octasplat.service.intake.dataset import DatasetLimits, check_file_content
from octasplat.service.intake.faults import IntakeError, IntakeFault
from octasplat.service.intake.images import ImageHeader, ImageLimits
from octasplat.service.intake.spool import SpoolSpace
from octasplat.service.thread_pools import ThreadPurpose, run_in_pool
from octasplat.workers.storage.errors import BlobNotFoundError, ContentTooLargeError, StorageUnavailableError
from octasplat.workers.storage.os_errors import translate_os_errors
from octasplat.workers.storage.protocol import Blob, BlobWriter, Storage
from octasplat.workers.storage.verifying_writer import VerifyingWriter

PIECE_BYTES = 1 << 20
PART_BYTES = 16 << 20
"""Parts of an upload that can be continued; what has come of the last one is lost with the process."""
PARALLEL_PART_BYTES = 8 << 20
"""Parts that come in any order, several at once; one whose connection breaks is lost."""
_SHA256 = re.compile(r"(?:^|,)\s*sha-256\s*=\s*:([A-Za-z0-9+/=]*):\s*(?:;[^,]*)?(?=,|$)")


@dataclass(frozen=True)
class ReceivedFile:
    """A file that is stored and passed the checks that a single file can pass.

    Attributes:
        path: name in the dataset.
        blob: its content.
        facts: what its header says: ``kind``, ``width_px``, ``height_px``, ``warning``; empty for a model.
    """

    path: str
    blob: Blob
    facts: Mapping[str, str | int | None]


@dataclass(frozen=True)
class ReceivedArchive:
    """A scene that came as an archive.

    Attributes:
        files: its files, stored and checked one by one.
        left_out: names of files that are no part of a scene.
        notes: sentences on them.
        size_bytes: length of the archive.
    """

    files: tuple[ReceivedFile, ...]
    left_out: tuple[str, ...]
    notes: tuple[str, ...]
    size_bytes: int


@dataclass(frozen=True)
class UploadLimits:
    """Limits of an upload.

    Attributes:
        max_file_bytes: one file.
        max_archive_bytes: an archive as it is sent.
        idle_seconds: silence after which an upload is given up.
        min_bytes_per_second: an upload that is slower over ``idle_seconds`` is given up.
        archive: what an archive may unpack to.
        dataset: what a dataset may be.
    """

    max_file_bytes: int = 4 << 30
    max_archive_bytes: int = 64 << 30
    idle_seconds: float = 60.0
    min_bytes_per_second: float = 4096.0
    archive: ArchiveLimits = field(default_factory=ArchiveLimits)
    dataset: DatasetLimits = field(default_factory=DatasetLimits)


DEFAULT_LIMITS = UploadLimits()
ContentCheck = Callable[[Storage, str, str, ImageLimits], ImageHeader | None]
"""Looks at content that is stored, given its name, digest and limits; see :func:`receive_file`."""


def parse_digest(repr_digest: str | None) -> str | None:
    """Return the SHA-256, in hexadecimal, of a ``Repr-Digest`` header (RFC 9530); None without it.

    Raises:
        IntakeError: ``digest-malformed``.
    """
    if repr_digest is None:
        return None
    found = _SHA256.search(repr_digest)
    try:
        digest = base64.b64decode(found[1], validate=True) if found else b""
    except binascii.Error:
        digest = b""
    if len(digest) != 32:
        raise IntakeError(
            IntakeFault(
                "digest-malformed",
                "The header Repr-Digest holds no SHA-256; write it as sha-256=:<base64 of the 32 bytes>:.",
            )
        )
    return digest.hex()


def format_digest(sha256: str) -> str:
    """Return the header ``Repr-Digest`` of a SHA-256 in hexadecimal digits."""
    return f"sha-256=:{base64.b64encode(bytes.fromhex(sha256)).decode()}:"


async def receive_body(stream: AsyncIterator[bytes], writer: BlobWriter, limits: UploadLimits) -> Blob:
    """Write a body to ``writer`` in threads, about a megabyte at a time, and commit it.

    Args:
        stream: the body, in pieces of any length.
        writer: where to; it is aborted on any error.
        limits: how slow it may be.

    Raises:
        IntakeError: ``upload-stalled`` or ``upload-too-slow``.
        StorageError: the content is not as announced, too large, or there is no room.
    """
    pending = bytearray()
    try:
        async for piece in _limited_in_time(stream, limits):
            pending += piece
            if len(pending) >= PIECE_BYTES:
                await run_in_pool(ThreadPurpose.UPLOADS, writer.write, bytes(pending))
                pending.clear()
        if pending:
            await run_in_pool(ThreadPurpose.UPLOADS, writer.write, bytes(pending))
        return await run_in_pool(ThreadPurpose.UPLOADS, writer.commit)
    except BaseException:
        # In a thread and shielded, as a thread may be writing right now, for which abort waits.
        await asyncio.shield(run_in_pool(ThreadPurpose.UPLOADS, writer.abort))
        raise


async def receive_parts(
    storage: Storage, stream: AsyncIterator[bytes], *, max_bytes: int, limits: UploadLimits = DEFAULT_LIMITS
) -> AsyncGenerator[Blob, None]:
    """Store a body in parts and yield each; what has come of one that breaks off is stored before the error.

    Args:
        storage: where to.
        stream: the body, in pieces of any length.
        max_bytes: length at which it is refused.
        limits: how slow it may be.

    Raises:
        IntakeError: ``upload-stalled`` or ``upload-too-slow``.
        StorageError: it is too long, or there is no room.
    """
    pieces = _limited_in_time(stream, limits)
    writer: BlobWriter | None = None
    pending, stored_bytes, ended = bytearray(), 0, False
    failure: Exception | None = None
    try:
        while not ended:
            try:
                piece = await anext(pieces)
                max_bytes -= len(piece)
                pending += piece if max_bytes >= 0 else b""
                if max_bytes < 0:
                    raise ContentTooLargeError("More came than the upload has left; ask for its offset.")
            except StopAsyncIteration:
                ended = True
            except Exception as error:  # noqa: BLE001 - raised below, once what has come is stored
                failure, ended = error, True
            if len(pending) >= PIECE_BYTES or (ended and pending):
                if writer is None:
                    writer = await run_in_pool(ThreadPurpose.UPLOADS, storage.open_writer)
                await run_in_pool(ThreadPurpose.UPLOADS, writer.write, bytes(pending))
                stored_bytes += len(pending)
                pending.clear()
            if writer is not None and (ended or stored_bytes >= PART_BYTES):
                blob = await run_in_pool(ThreadPurpose.UPLOADS, writer.commit)
                writer, stored_bytes = None, 0
                yield blob
    finally:
        if writer is not None:
            await asyncio.shield(run_in_pool(ThreadPurpose.UPLOADS, writer.abort))
    if failure is not None:
        raise failure


async def _limited_in_time(stream: AsyncIterator[bytes], limits: UploadLimits) -> AsyncIterator[bytes]:
    """Yield the pieces of a body; the time in which nobody waits for one does not count."""
    pieces, seconds = aiter(stream), limits.idle_seconds
    waited_seconds, arrived_bytes = 0.0, 0
    while True:
        began = time.monotonic()
        try:
            async with asyncio.timeout(seconds):
                piece = await anext(pieces)
        except StopAsyncIteration:
            return
        except TimeoutError:
            detail = f"Nothing came for {seconds:g} s; send the file again."
            raise IntakeError(IntakeFault("upload-stalled", detail)) from None
        waited_seconds += time.monotonic() - began
        arrived_bytes += len(piece)
        # Each stretch of so many seconds is judged by itself, so that a fast beginning excuses nothing.
        if waited_seconds >= seconds:
            if arrived_bytes < limits.min_bytes_per_second * waited_seconds:
                detail = (
                    f"In {waited_seconds:.0f} s {arrived_bytes} bytes came, and "
                    f"{limits.min_bytes_per_second:g} are needed each second; send the file over a faster "
                    "connection, or in smaller files."
                )
                raise IntakeError(IntakeFault("upload-too-slow", detail))
            waited_seconds, arrived_bytes = 0.0, 0
        yield piece


async def receive_file(
    storage: Storage,
    path: str,
    stream: AsyncIterator[bytes],
    *,
    sha256: str | None = None,
    size_bytes: int | None = None,
    limits: UploadLimits = DEFAULT_LIMITS,
    max_bytes: int | None = None,
    check: ContentCheck = check_file_content,
) -> ReceivedFile:
    """Receive one file of a dataset and store it; it belongs to nothing yet.

    Args:
        storage: where to.
        path: name in the dataset, which is checked.
        stream: the body.
        sha256: digest that was announced.
        size_bytes: length that was announced.
        limits: what is taken.
        max_bytes: a lower limit than that of ``limits``, e.g. what a quota leaves.
        check: looks at the content.

    Raises:
        IntakeError: the header of the image is refused, or nothing came for too long.
        StorageError: as by :func:`receive_body`.
    """
    most = limits.max_file_bytes if max_bytes is None else min(limits.max_file_bytes, max_bytes)
    writer = await run_in_pool(
        ThreadPurpose.UPLOADS, storage.open_writer, sha256=sha256, size_bytes=size_bytes, max_bytes=most
    )
    blob = await receive_body(stream, writer, limits)
    return await run_in_pool(ThreadPurpose.UPLOADS, _checked_file, check, storage, path, blob, limits)


async def receive_archive(
    storage: Storage,
    stream: AsyncIterator[bytes],
    spool: SpoolSpace,
    *,
    owner: str = "",
    sha256: str | None = None,
    size_bytes: int | None = None,
    limits: UploadLimits = DEFAULT_LIMITS,
    max_bytes: int | None = None,
) -> ReceivedArchive:
    """Receive a dataset as an archive and store its files; they belong to nothing yet.

    Args:
        storage: where to.
        stream: the body.
        spool: for the archive while it is read; the file there has no name and ends with the process.
        owner: whose share of the spool it takes.
        sha256: digest that was announced.
        size_bytes: length that was announced.
        limits: what is taken.
        max_bytes: what the contents may have together, e.g. what a quota leaves.

    Raises:
        IntakeError: the archive or a file in it is refused.
        StorageError: as by :func:`receive_body`.
    """
    most = limits.max_archive_bytes if max_bytes is None else min(limits.max_archive_bytes, max_bytes)
    with translate_os_errors(spool.folder):
        spool.folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        file = tempfile.TemporaryFile(dir=spool.folder)  # noqa: SIM115 - closed below
    with (
        file,
        _SpoolWriter(
            file=file,
            spool=spool,
            owner=owner,
            storage=storage,
            sha256=sha256,
            size_bytes=size_bytes,
            max_bytes=most,
        ) as writer,
    ):
        blob = await receive_body(stream, writer, limits)
        files, listing = await run_in_pool(
            ThreadPurpose.UNPACKING, _unpack_archive, storage, file, limits, max_bytes
        )
    return ReceivedArchive(files, listing.left_out, listing.notes, blob.size_bytes)


def header_facts(header: ImageHeader | None) -> dict[str, str | int | None]:
    """Return the properties of an image header that the table stores."""
    if header is None:
        return {}
    facts: dict[str, str | int | None] = {
        "kind": header.kind,
        "width_px": header.width_px,
        "height_px": header.height_px,
    }
    return facts if header.warning is None else {**facts, "warning": header.warning}


def _checked_file(
    check: ContentCheck, storage: Storage, path: str, blob: Blob, limits: UploadLimits
) -> ReceivedFile:
    """Check content that was just stored.

    Raises:
        StorageUnavailableError: it is gone: the same content had been stored before, and its removal
            as unused was under way.
        Exception: as by ``check``.
    """
    try:
        header = check(storage, path, blob.sha256, limits.dataset.image)
    except BlobNotFoundError as error:
        raise StorageUnavailableError(
            f"The content of {quoted_name(path)} was removed as unused at that moment; send it again."
        ) from error
    return ReceivedFile(path, blob, header_facts(header))


def _unpack_archive(
    storage: Storage, file: BinaryIO, limits: UploadLimits, max_bytes: int | None
) -> tuple[tuple[ReceivedFile, ...], ArchiveListing]:
    listing = list_archive(file, limits.archive)
    if max_bytes is not None and listing.size_bytes > max_bytes:
        detail = f"The archive unpacks to {listing.size_bytes} bytes; {max_bytes} are left of your quota."
        raise IntakeError(IntakeFault("archive-too-large", detail))
    # All of it has to fit before the first file is written.
    storage.ensure_space(listing.size_bytes)
    files: list[ReceivedFile] = []

    def begin(entry: ArchiveFile) -> BlobWriter:
        return storage.open_writer(size_bytes=entry.size_bytes, max_bytes=limits.max_file_bytes)

    def on_file(entry: ArchiveFile, blob: Blob) -> None:
        files.append(_checked_file(check_file_content, storage, entry.name, blob, limits))

    unpack_archive(file, listing, begin, on_file)
    return tuple(files), listing


class _SpoolWriter(VerifyingWriter):
    """Writes an archive into a nameless file of this machine, with space taken as it comes."""

    def __init__(
        self,
        file: BinaryIO,
        spool: SpoolSpace,
        owner: str,
        storage: Storage,
        sha256: str | None,
        size_bytes: int | None,
        max_bytes: int | None,
    ) -> None:
        self._file = file
        self._spool = spool
        self._owner = owner
        self._storage = storage
        self._taken_bytes = 0
        super().__init__(sha256, size_bytes, max_bytes)
        storage.ensure_space(size_bytes or 0)
        spool.ensure(owner, size_bytes or 0)

    def __exit__(self, *exception: object) -> None:
        super().__exit__(*exception)
        self._spool.release(self._owner, self._taken_bytes)
        self._taken_bytes = 0

    def _write_bytes(self, data: bytes | memoryview) -> None:
        self._storage.ensure_space(len(data))
        self._spool.take(self._owner, len(data))
        self._taken_bytes += len(data)
        with translate_os_errors(self._spool.folder):
            self._file.write(data)

    def _publish(self, blob: Blob) -> None:
        with translate_os_errors(self._spool.folder):
            self._file.flush()

    def _discard(self) -> None:
        """Do nothing: the file goes when its opener closes it."""

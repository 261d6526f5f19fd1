"""Reader of untrusted ZIP archives of a dataset.

Everything is checked before the first byte is written, and counted again while writing. What is odd is
refused, never mended; what is no part of a scene is left out unseen. Nothing is written under the names in
the archive: contents go to the store by digest, and names stay data. Only ZIP is taken: the safe part of tar
would hold nothing that ZIP does not.
"""

import stat
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import BinaryIO

from octasplat.engine.core.portable_names import FileNameError, check_name, quoted_name
from octasplat.engine.core.scene_layout import FileRole, file_role, lay_out_scene
from octasplat.service.intake.faults import raise_intake_error, shown_name
from octasplat.service.intake.upload_names import FileNames
from octasplat.service.intake.zip_records import (
    DEFLATED,
    IS_ENCRYPTED,
    IS_STRONG,
    STORED,
    ZipEntry,
    read_listed_records,
    read_records,
)
from octasplat.workers.storage.protocol import Blob, BlobWriter

_PIECE_BYTES = 1 << 20
_MAGIC_NUMBERS = (
    (b"PK\x03\x04", 0, "zip"), (b"PK\x05\x06", 0, "zip"), (b"\x1f\x8b\x08", 0, "gzip"), (b"BZh", 0, "bzip2"),
    (b"\xfd7zXZ\x00", 0, "xz"), (b"7z\xbc\xaf\x27\x1c", 0, "7z"), (b"Rar!\x1a\x07", 0, "rar"),
    (b"\x28\xb5\x2f\xfd", 0, "zstd"), (b"\x04\x22\x4d\x18", 0, "lz4"), (b"MSCF", 0, "cab"),
    (b"ustar", 257, "tar"),
)  # fmt: skip
_LEADING_ELSEWHERE = frozenset(
    {"name-empty", "name-empty-part", "name-traversal", "name-absolute", "name-drive", "name-unc", "name-nul"}
)
"""Why names are refused even where their files are left out."""


@dataclass(frozen=True)
class ArchiveLimits:
    """Limits of an uploaded archive.

    Attributes:
        max_entries: files and folders.
        max_file_bytes: content of one file.
        max_total_bytes: contents together.
        max_ratio: content to archived length of a file longer than ``ratio_from_bytes``.
        ratio_from_bytes: shorter files may be packed at any ratio.
        max_directory_bytes: the list of contents.
    """

    max_entries: int = 50_000
    max_file_bytes: int = 4 << 30
    max_total_bytes: int = 64 << 30
    max_ratio: int = 200
    ratio_from_bytes: int = 1 << 20
    max_directory_bytes: int = 64 << 20


@dataclass(frozen=True)
class ArchiveFile:
    """A file of the archive that is part of a scene: its name in the dataset, and where it is."""

    name: str
    record: ZipEntry

    @property
    def size_bytes(self) -> int:
        """Return the length of the content."""
        return self.record.size_bytes


@dataclass(frozen=True)
class ArchiveListing:
    """Content of an archive that passed all checks.

    Attributes:
        files: parts of a scene, in the order of the archive.
        left_out: names of files that are no part of one.
        notes: sentences on them, but for what file managers leave behind.
        folder: the folder that holds everything and is not part of the names, or an empty text.
    """

    files: tuple[ArchiveFile, ...]
    left_out: tuple[str, ...]
    notes: tuple[str, ...]
    folder: str

    @property
    def size_bytes(self) -> int:
        """Return the total length of the contents."""
        return sum(file.size_bytes for file in self.files)


def list_archive(file: BinaryIO, limits: ArchiveLimits = ArchiveLimits()) -> ArchiveListing:
    """Check an archive without unpacking anything.

    Args:
        file: seekable.
        limits: what it may ask for.

    Raises:
        IntakeError: with one of the codes ``archive-...`` or ``name-...``.
    """
    file.seek(0)
    kind = archive_type(file.read(512))
    if kind is None:
        raise_intake_error(
            "archive-damaged", "This is not an archive; send the scene as a ZIP file, or file by file."
        )
    if kind != "zip":
        raise_intake_error(
            "archive-kind",
            f"This is a {kind} archive; send the scene as a ZIP file, or its files one by one.",
        )
    records = read_records(
        file, max_entries=limits.max_entries, max_directory_bytes=limits.max_directory_bytes
    )
    listing = _scene_listing(records, limits)
    if not listing.files:
        nothing = "The archive holds no part of a scene; put photographs into it."
        raise_intake_error("archive-empty", " ".join((nothing, *listing.notes)))
    return listing


def list_archive_end(file: BinaryIO, limits: ArchiveLimits = ArchiveLimits()) -> ArchiveListing:
    """Return what an archive holds by the list at its end, the only part of ``file`` that is read.

    Raises:
        IntakeError: as by :func:`list_archive`, which looks at the rest as well.
    """
    records = read_listed_records(
        file, max_entries=limits.max_entries, max_directory_bytes=limits.max_directory_bytes
    )
    return _scene_listing(records, limits)


def unpack_archive(
    file: BinaryIO,
    listing: ArchiveListing,
    open_writer: Callable[[ArchiveFile], BlobWriter],
    on_file: Callable[[ArchiveFile, Blob], None],
) -> None:
    """Write the files of an archive to a storage.

    Args:
        file: the archive.
        listing: what :func:`list_archive` said of it.
        open_writer: opens the writer for a file.
        on_file: called with what was stored; it may raise to refuse it. Nothing counts before this
            function returns.

    Raises:
        IntakeError: a content is not what the archive announces, or is an archive itself.
        StorageError: the store does not take it.
    """
    for entry in listing.files:
        with open_writer(entry) as writer:
            _copy_entry(file, entry, writer)
            blob = writer.commit()
        on_file(entry, blob)


def archive_type(head: bytes) -> str | None:
    """Return the kind of archive or compressed file that begins with ``head`` (512 bytes), or None."""
    for magic, position, kind in _MAGIC_NUMBERS:
        if head[position : position + len(magic)] == magic:
            return kind
    return None


def _with_forward_slashes(records: list[ZipEntry]) -> list[ZipEntry]:
    """Return entries with forward slashes where an old Windows program wrote backslashes only."""
    names = [record.name.replace("\\", "/") for record in records]
    if any("/" in record.name for record in records) or not all(map(_is_portable, names)):
        return records
    return [replace(record, name=name) for record, name in zip(records, names, strict=True)]


def _is_portable(name: str) -> bool:
    try:
        check_name(name.removesuffix("/"))
    except FileNameError:
        return False
    return True


def _check_entry(record: ZipEntry) -> None:
    name = quoted_name(record.name)
    form = stat.S_IFMT(record.unix_mode)
    if form == stat.S_IFLNK:
        raise_intake_error("archive-link", f"{name} is a link; send the file itself.", record.name)
    if form not in (0, stat.S_IFREG):
        raise_intake_error("archive-special-file", f"{name} is not a regular file.", record.name)
    if record.flags & (IS_ENCRYPTED | IS_STRONG):
        raise_intake_error(
            "archive-encrypted", f"{name} is encrypted; send the archive without a password.", record.name
        )
    if record.method not in (STORED, DEFLATED):
        raise_intake_error(
            "archive-method",
            f"{name} is packed by the method {record.method}; pack it with deflate or without compression.",
            record.name,
        )


def _check_size(record: ZipEntry, limits: ArchiveLimits) -> None:
    name = quoted_name(record.name)
    if record.size_bytes > limits.max_file_bytes:
        raise_intake_error(
            "archive-file-too-large",
            f"{name} unpacks to {record.size_bytes} bytes; {limits.max_file_bytes} are allowed.",
            record.name,
        )
    if record.method == STORED and record.size_bytes != record.packed_bytes:
        raise_intake_error("archive-mismatch", f"{name} is stored as it is but has two lengths.", record.name)
    packed = max(1, record.packed_bytes)
    if record.size_bytes > max(limits.ratio_from_bytes, limits.max_ratio * packed):
        raise_intake_error(
            "archive-ratio",
            f"{name} unpacks to {record.size_bytes // packed} times its length; {limits.max_ratio} times are "
            "allowed. Send such a file by itself.",
            record.name,
        )


def _scene_listing(records: list[ZipEntry], limits: ArchiveLimits) -> ArchiveListing:
    """Lay out the entries as a scene; what is left out is only looked at for names that lead elsewhere."""
    by_path: dict[str, ZipEntry] = {}
    taken_names = FileNames()
    for record in _with_forward_slashes(records):
        _check_place(record)
        if record.name in by_path:
            detail = f"The file name {quoted_name(record.name)} occurs twice."
            raise_intake_error("name-duplicate", detail, record.name)
        if not record.name.endswith("/"):
            by_path[record.name] = record
    layout = lay_out_scene(list(by_path))
    for name, path in layout.files.items():
        _check_entry(by_path[path])
        _check_size(by_path[path], limits)
        taken_names.add(name)
    files = tuple(ArchiveFile(name, by_path[path]) for name, path in layout.files.items())
    left_out = tuple(map(shown_name, (*layout.left_out, *layout.ignored)))
    listing = ArchiveListing(files, left_out, layout.notes, shown_name(layout.folder))
    if listing.size_bytes > limits.max_total_bytes:
        raise_intake_error(
            "archive-too-large",
            f"The archive unpacks to {listing.size_bytes} bytes; {limits.max_total_bytes} are allowed.",
        )
    return listing


def _check_place(record: ZipEntry) -> None:
    """Refuse a name that may lead elsewhere, whatever the entry is, and a folder with a content."""
    try:
        check_name(record.name.removesuffix("/"))
    except FileNameError as error:
        if error.code in _LEADING_ELSEWHERE:
            raise_intake_error(error.code, str(error), record.name)
    # Some programs deflate folders too, and deflate makes two bytes of nothing.
    if record.name.endswith("/") and (record.size_bytes or record.packed_bytes > 2):
        raise_intake_error(
            "archive-mismatch", f"The folder {quoted_name(record.name)} has a content.", record.name
        )


def _copy_entry(file: BinaryIO, entry: ArchiveFile, writer: BlobWriter) -> None:
    record, name = entry.record, quoted_name(entry.record.name)
    # Without the header of zlib, which entries do not have.
    inflate = zlib.decompressobj(-zlib.MAX_WBITS) if record.method == DEFLATED else None
    checksum = count = 0
    left = record.packed_bytes
    head = b""
    file.seek(record.data_start)
    pending = b""
    while True:
        if not pending and left:
            pending = file.read(min(_PIECE_BYTES, left))
            if not pending:
                raise_intake_error("archive-damaged", "The archive was cut short.")
            left -= len(pending)
        if inflate is None:
            piece, pending = pending, b""
        else:
            try:
                # At most so much at a time, so that a bomb does not fill the memory.
                piece = inflate.decompress(pending, _PIECE_BYTES)
            except zlib.error:
                raise_intake_error(
                    "archive-damaged", f"{name} is damaged in the archive; write it anew.", record.name
                )
            pending = inflate.unconsumed_tail
            if inflate.eof and (inflate.unused_data or left):
                raise_intake_error(
                    "archive-mismatch", f"{name} is shorter than the archive announces.", record.name
                )
        if len(head) < 512:
            head += piece[: 512 - len(head)]
        count += len(piece)
        if count > record.size_bytes:
            raise_intake_error("archive-bomb", f"{name} is longer than the archive announces.", record.name)
        checksum = zlib.crc32(piece, checksum)
        writer.write(piece)
        if not left and not pending and (inflate is None or inflate.eof or not piece):
            break
    if count != record.size_bytes or (inflate is not None and not inflate.eof):
        raise_intake_error("archive-mismatch", f"{name} is shorter than the archive announces.", record.name)
    if checksum != record.crc32:
        raise_intake_error("archive-checksum", f"{name} is damaged: its checksum is wrong.", record.name)
    # The first bytes of a model's file are a count, which may look like anything.
    if file_role(entry.name) is not FileRole.MODEL and archive_type(head) is not None:
        raise_intake_error(
            "archive-nested", f"{name} is an archive inside the archive; unpack it first.", record.name
        )

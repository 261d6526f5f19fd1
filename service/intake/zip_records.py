"""Strict reader of ZIP records: every byte of the file must belong to exactly one of them.

Readers of ZIP files disagree about files whose two lists of contents, the local headers and the central
directory, differ. So this reads both and accepts only files in which they agree, in which the entries follow
each other without gap or overlap, and after which nothing follows. Source: APPNOTE.TXT 6.3.10.
"""

import os
import struct
from dataclasses import dataclass, replace
from typing import BinaryIO

from octasplat.engine.core.portable_names import quoted_name
from octasplat.service.intake.faults import raise_intake_error
from octasplat.service.intake.zip_end import END_LAYOUT, MAX_COMMENT, read_end
from octasplat.service.intake.zip_fields import (
    EXTRA_NAME,
    UNKNOWN_16,
    UNKNOWN_32,
    decode_name,
    extra_fields,
    full_name,
    zip64_values,
)

STORED, DEFLATED = 0, 8
IS_ENCRYPTED, HAS_DESCRIPTOR, IS_PATCHED, IS_STRONG, IS_UTF8, IS_MASKED = 1, 8, 32, 64, 2048, 8192

_LOCAL_LAYOUT = struct.Struct("<4s5H3I2H")
_CENTRAL_LAYOUT = struct.Struct("<4s6H3I5H2I")
_NEWEST_VERSION = 63


@dataclass(frozen=True)
class ZipEntry:
    """One entry, on which both lists agree.

    Attributes:
        name: as stored, a folder's with its final slash.
        method: :data:`STORED` or whatever else the file says.
        flags: general purpose bits.
        crc32: checksum of the content.
        packed_bytes: length of the data in the file.
        size_bytes: announced length of the content.
        header_start: where the local header begins.
        data_start: where the data begins.
        unix_mode: mode bits of the file's home, 0 where it had none.
    """

    name: str
    method: int
    flags: int
    crc32: int
    packed_bytes: int
    size_bytes: int
    header_start: int
    data_start: int
    unix_mode: int


def read_records(file: BinaryIO, *, max_entries: int, max_directory_bytes: int) -> list[ZipEntry]:
    """Return all entries of a ZIP file in the order of their data.

    Args:
        file: seekable.
        max_entries: more are refused before they are read.
        max_directory_bytes: a longer central directory is refused before it is read.

    Raises:
        IntakeError: with a code that begins with ``archive-`` or ``name-``.
    """
    entries, directory_start = _read_directory(file, max_entries, max_directory_bytes)
    records = [_with_local_header(file, *entry, directory_start) for entry in entries]
    # In the order of their data, in which gaps and overlaps show.
    records.sort(key=lambda record: record.header_start)
    _check_coverage(file, records, directory_start)
    return records


def read_listed_records(file: BinaryIO, *, max_entries: int, max_directory_bytes: int) -> list[ZipEntry]:
    """Return the entries that the list at the end of a ZIP file names, without ``data_start``.

    Nothing before that list is read, so that the end of an archive is enough. Arguments and errors are those
    of :func:`read_records`.
    """
    entries, _ = _read_directory(file, max_entries, max_directory_bytes)
    return sorted((record for record, _ in entries), key=lambda record: record.header_start)


def _read_directory(
    file: BinaryIO, max_entries: int, max_directory_bytes: int
) -> tuple[list[tuple[ZipEntry, bytes]], int]:
    """Return records without ``data_start``, with their names as bytes, and where their list begins."""
    length = file.seek(0, os.SEEK_END)
    end = read_end(file, length)
    if end.entries > max_entries:
        raise_intake_error(
            "archive-too-many-entries", f"The archive has {end.entries} entries; {max_entries} are allowed."
        )
    if end.directory_bytes > max_directory_bytes:
        raise_intake_error("archive-directory-too-long", "The list of contents of the archive is too long.")
    if end.directory_start + end.directory_bytes != end.end_of_directory:
        raise_intake_error(
            "archive-gap",
            "The archive holds bytes that belong to none of its entries (before its beginning or between its "
            "parts); write it anew with an ordinary ZIP program.",
        )
    file.seek(end.directory_start)
    directory = file.read(end.directory_bytes)
    if (directory + file.read(END_LAYOUT.size + MAX_COMMENT)).count(b"PK\x05\x06") != 1:
        raise_intake_error(
            "archive-ambiguous", "The archive has two end records; write it anew without a comment."
        )
    return _central_entries(directory, end.entries), end.directory_start


def _central_entries(directory: bytes, count: int) -> list[tuple[ZipEntry, bytes]]:
    """Return records without ``data_start``, with their names as bytes."""
    entries: list[tuple[ZipEntry, bytes]] = []
    position = 0
    for _ in range(count):
        if position + _CENTRAL_LAYOUT.size > len(directory):
            raise_intake_error(
                "archive-damaged", "The list of contents of the archive ends early; write it anew."
            )
        (
            signature, _, version, flags, method, _, _, crc32, packed, size,
            name_length, extra_length, comment_length, disk, _, attributes, start,
        ) = _CENTRAL_LAYOUT.unpack_from(directory, position)  # fmt: skip
        position += _CENTRAL_LAYOUT.size
        after = position + name_length + extra_length + comment_length
        if signature != b"PK\x01\x02" or after > len(directory):
            raise_intake_error(
                "archive-damaged", "The list of contents of the archive is damaged; write it anew."
            )
        raw_name = directory[position : position + name_length]
        name = decode_name(raw_name)
        _check_version(version, name)
        extra = extra_fields(directory[position + name_length : after - comment_length], name)
        size, packed, start, disk = zip64_values(
            extra,
            name,
            (size, UNKNOWN_32, 8), (packed, UNKNOWN_32, 8), (start, UNKNOWN_32, 8), (disk, UNKNOWN_16, 4),
        )  # fmt: skip
        if disk != 0:
            raise_intake_error(
                "archive-several-disks", "The archive is split into several files; send it as one."
            )
        name = full_name(raw_name, name, extra)
        # The upper half of the attributes is the mode on Unix; some programs read it whatever the home.
        entries.append(
            (
                ZipEntry(
                    name=name,
                    method=method,
                    flags=flags,
                    crc32=crc32,
                    packed_bytes=packed,
                    size_bytes=size,
                    header_start=start,
                    data_start=0,
                    unix_mode=attributes >> 16,
                ),
                raw_name,
            )
        )
        position = after
    if position != len(directory):
        raise_intake_error(
            "archive-gap", "The list of contents of the archive is longer than its entries; write it anew."
        )
    return entries


def _with_local_header(file: BinaryIO, record: ZipEntry, raw_name: bytes, directory_start: int) -> ZipEntry:
    # A start behind the entries may be one that no file has, which cannot be sought.
    file.seek(min(record.header_start, directory_start))
    header = file.read(_LOCAL_LAYOUT.size)
    if len(header) < _LOCAL_LAYOUT.size or header[:4] != b"PK\x03\x04":
        raise_intake_error(
            "archive-mismatch",
            f"The entry {quoted_name(record.name)} is listed but is not where it should be.",
            record.name,
        )
    _, version, flags, method, _, _, crc32, packed, size, name_length, extra_length = _LOCAL_LAYOUT.unpack(
        header
    )
    _check_version(version, record.name)
    name = file.read(name_length)
    extra = extra_fields(file.read(extra_length), record.name)
    size, packed = zip64_values(extra, record.name, (size, UNKNOWN_32, 8), (packed, UNKNOWN_32, 8))
    compared = IS_ENCRYPTED | HAS_DESCRIPTOR | IS_PATCHED | IS_STRONG | IS_UTF8 | IS_MASKED
    same = (name, method, flags & compared) == (raw_name, record.method, record.flags & compared)
    facts, announced = (crc32, packed, size), (record.crc32, record.packed_bytes, record.size_bytes)
    # Where a descriptor follows the data, the header may leave each of the three at zero.
    deferred = record.flags & HAS_DESCRIPTOR
    same &= all(
        here == there or (deferred and here == 0) for here, there in zip(facts, announced, strict=True)
    )
    local_name = full_name(raw_name, decode_name(raw_name), extra)
    if EXTRA_NAME in extra and local_name != record.name:
        raise_intake_error(
            "archive-second-name", f"The entry {quoted_name(record.name)} carries a second name.", record.name
        )
    if not same:
        raise_intake_error(
            "archive-mismatch",
            f"The archive describes {quoted_name(record.name)} in two ways that contradict each other.",
            record.name,
        )
    data_start = record.header_start + _LOCAL_LAYOUT.size + name_length + extra_length
    return replace(record, data_start=data_start)


def _check_version(needed: int, name: str) -> None:
    if needed > _NEWEST_VERSION:
        detail = (
            f"{quoted_name(name)} needs a newer reader of ZIP files than there is; write the archive anew."
        )
        raise_intake_error("archive-version", detail, name)


def _check_coverage(file: BinaryIO, records: list[ZipEntry], directory_start: int) -> None:
    position = 0
    starts = [record.header_start for record in records] + [directory_start]
    for record, after in zip(records, starts[1:], strict=True):
        name = quoted_name(record.name)
        data_end = record.data_start + record.packed_bytes
        if record.header_start != position:
            raise_intake_error(
                "archive-gap", "The archive holds bytes that belong to none of its entries; write it anew."
            )
        if data_end > after:
            raise_intake_error(
                "archive-overlap", f"The entry {name} shares its bytes with another.", record.name
            )
        if record.flags & HAS_DESCRIPTOR:
            file.seek(data_end)
            if not _is_descriptor(file.read(min(24, after - data_end)), after - data_end, record):
                raise_intake_error(
                    "archive-mismatch", f"The entry {name} is not followed by what describes it.", record.name
                )
        elif data_end != after:
            raise_intake_error(
                "archive-gap", "The archive holds bytes that belong to none of its entries; write it anew."
            )
        position = after
    if position != directory_start:
        raise_intake_error("archive-gap", "The archive holds bytes but no entries.")


def _is_descriptor(data: bytes, length: int, record: ZipEntry) -> bool:
    facts = (record.crc32, record.packed_bytes, record.size_bytes)
    # Programs write it in 32 or 64 bits, with or without a signature.
    for layout in ("<3I", "<I2Q"):
        for signature in (b"PK\x07\x08", b""):
            if length == len(signature) + struct.calcsize(layout) and data[: len(signature)] == signature:
                return struct.unpack_from(layout, data, len(signature)) == facts
    return False

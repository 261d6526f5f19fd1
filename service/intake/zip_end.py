"""End records of ZIP files, which say where the central directory is.

Source: APPNOTE.TXT 6.3.10, sections 4.3.14 to 4.3.16.
"""

import struct
from dataclasses import dataclass
from typing import BinaryIO

from octasplat.service.intake.faults import raise_intake_error
from octasplat.service.intake.zip_fields import UNKNOWN_16, UNKNOWN_32

END_LAYOUT = struct.Struct("<4s4H2IH")
_END_64_LAYOUT = struct.Struct("<4sQ2H2I4Q")
_LOCATOR_64_LAYOUT = struct.Struct("<4sIQI")
MAX_COMMENT = 65_535


@dataclass(frozen=True)
class EndRecord:
    """Number of entries, place and length of the central directory, and what it must end at."""

    entries: int
    directory_start: int
    directory_bytes: int
    end_of_directory: int


def read_end(file: BinaryIO, length: int) -> EndRecord:
    """Return the end record of a ZIP file of ``length`` bytes, that of ZIP64 if it has one.

    Raises:
        IntakeError: there is none, it is damaged, or the archive has several parts.
    """
    # The record lies before a comment of at most MAX_COMMENT bytes.
    tail_start = max(0, length - END_LAYOUT.size - MAX_COMMENT)
    file.seek(tail_start)
    tail = file.read(length - tail_start)
    position = tail.rfind(b"PK\x05\x06")
    if position < 0 or position + END_LAYOUT.size > len(tail):
        raise_intake_error(
            "archive-damaged", "The archive has no end record; it was cut short or is not a ZIP file."
        )
    _, disk, directory_disk, entries_here, entries, size, start, comment = END_LAYOUT.unpack_from(
        tail, position
    )
    if position + END_LAYOUT.size + comment != len(tail):
        raise_intake_error(
            "archive-data-after-end", "The archive goes on after its end record; write it anew."
        )
    end_start = tail_start + position
    locator = _locator_64(file, end_start)
    if locator is None:
        if disk or directory_disk or entries_here != entries:
            raise_intake_error(
                "archive-several-disks", "The archive is split into several files; send it as one."
            )
        if UNKNOWN_32 in (size, start) or entries == UNKNOWN_16:
            raise_intake_error("archive-damaged", "The archive lacks its ZIP64 record; write it anew.")
        return EndRecord(entries, start, size, end_start)
    return _read_end_64(file, locator, end_start - _LOCATOR_64_LAYOUT.size, (entries, size, start))


def _locator_64(file: BinaryIO, end_start: int) -> int | None:
    if end_start < _LOCATOR_64_LAYOUT.size:
        return None
    file.seek(end_start - _LOCATOR_64_LAYOUT.size)
    signature, disk, where, disks = _LOCATOR_64_LAYOUT.unpack(file.read(_LOCATOR_64_LAYOUT.size))
    if signature != b"PK\x06\x07":
        return None
    if disk != 0 or disks > 1:
        raise_intake_error(
            "archive-several-disks", "The archive is split into several files; send it as one."
        )
    return int(where)


def _read_end_64(file: BinaryIO, where: int, must_end: int, short: tuple[int, int, int]) -> EndRecord:
    if where + _END_64_LAYOUT.size != must_end:
        raise_intake_error(
            "archive-gap", "The ZIP64 record of the archive is not where it must be; write it anew."
        )
    file.seek(where)
    signature, length, _, _, disk, directory_disk, here, entries, size, start = _END_64_LAYOUT.unpack(
        file.read(_END_64_LAYOUT.size)
    )
    # The length leaves out the signature and itself.
    if signature != b"PK\x06\x06" or length != _END_64_LAYOUT.size - 12:
        raise_intake_error("archive-damaged", "The ZIP64 record of the archive is damaged; write it anew.")
    if disk or directory_disk or here != entries:
        raise_intake_error(
            "archive-several-disks", "The archive is split into several files; send it as one."
        )
    for old, new, unknown in zip(
        short, (entries, size, start), (UNKNOWN_16, UNKNOWN_32, UNKNOWN_32), strict=True
    ):
        if old not in (new, unknown):
            raise_intake_error(
                "archive-mismatch", "The two end records of the archive contradict each other."
            )
    return EndRecord(entries, start, size, where)

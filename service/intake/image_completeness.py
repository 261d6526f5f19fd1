"""Check that an image file is complete, without decoding it.

A truncated file still has its header, and readers show the missing part in grey or not at all. Where a format
declares its length or ends with a marker, that is checked; it takes a few reads, whatever the size. Not
detected: data that are damaged in the middle, a JPEG that was truncated and then closed with an end marker,
and HDR files, whose rows have any length, of which the shortest rows would fit into what is left.
"""

import io
import os
import struct
from collections.abc import Callable
from typing import BinaryIO

from octasplat.engine.core.portable_names import quoted_name
from octasplat.service.intake.faults import IntakeError, IntakeFault
from octasplat.service.intake.images import read_hdr_size, read_null_terminated, unpack_struct

_TAIL_BYTES = 64 << 10
_PIECE_BYTES = 1 << 20
_MAX_BYTES = 256 << 20
_MAX_SEGMENTS = 100_000
_READ_ERRORS = (OSError, ValueError, LookupError, ArithmeticError, struct.error)
# Rows of a block by compression: none, RLE, ZIPS, ZIP, PIZ, PXR24, B44, B44A, DWAA, DWAB.
_EXR_ROWS = {0: 1, 1: 1, 2: 1, 3: 16, 4: 32, 5: 16, 6: 32, 7: 32, 8: 32, 9: 256}
_TIFF_LAYOUTS = {3: "H", 4: "I", 16: "Q"}  # SHORT, LONG, LONG8


def check_complete(file: BinaryIO, name: str, kind: str) -> None:
    """Refuse a truncated image.

    Args:
        file: seekable, with a header that :func:`octasplat.service.intake.images.read_image_header` found
            sound.
        name: its name in the dataset, for the sentence.
        kind: of the image.

    Raises:
        IntakeError: ``image-cut-off``.
    """
    size_bytes = file.seek(0, io.SEEK_END)
    file.seek(0)
    try:
        is_complete = _CHECKS.get(kind, _assume_complete)(file, size_bytes)
    except _READ_ERRORS:
        is_complete = False  # what says how long it is lies beyond the end
    if not is_complete:
        detail = (
            f"{quoted_name(name)} is cut off: the end of its {kind} data is missing; send the whole file."
        )
        raise IntakeError(IntakeFault("image-cut-off", detail, name))


def _is_jpeg_complete(file: BinaryIO, size_bytes: int) -> bool:
    """Return whether an end marker follows the first scan; its bytes cannot occur within a scan."""
    start = _first_scan_offset(file)
    file.seek(max(start, size_bytes - _TAIL_BYTES))
    if b"\xff\xd9" in file.read(_TAIL_BYTES):
        return True
    # Some cameras append a film or a second picture.
    file.seek(start)
    last = b""
    for _ in range(_MAX_BYTES // _PIECE_BYTES):
        piece = file.read(_PIECE_BYTES)
        if not piece:
            return False
        if b"\xff\xd9" in last + piece:
            return True
        # The two bytes of the marker may lie in two pieces.
        last = piece[-1:]
    # More than is looked through: not known to be cut off.
    return True


def _first_scan_offset(file: BinaryIO) -> int:
    """Return the offset of the data of the first scan."""
    file.seek(2)
    marked = False
    for _ in range(_MAX_SEGMENTS):
        (byte,) = unpack_struct(file, ">B")
        if not marked or byte in (0, 0xFF) or 0xD0 <= byte <= 0xD8:  # fill bytes and marks without data
            marked = byte == 0xFF
            continue
        (length,) = unpack_struct(file, ">H")
        file.seek(length - 2, os.SEEK_CUR)
        if byte == 0xDA:  # start of scan
            return file.tell()
        marked = False
    raise ValueError("no scan")


def _is_png_complete(file: BinaryIO, size_bytes: int) -> bool:
    """Return whether the end chunk is there."""
    # The end chunk is 12 bytes: a length of zero, its name and a checksum.
    file.seek(max(0, size_bytes - 12))
    if file.read(12)[4:8] == b"IEND":
        return True
    # Some programs write behind the end chunk, which is looked for from the beginning then.
    file.seek(8)
    for _ in range(_MAX_SEGMENTS):
        length, kind = unpack_struct(file, ">I4s")
        if kind == b"IEND":
            return True
        file.seek(length + 4, os.SEEK_CUR)  # its data and checksum
    return True


def _is_webp_complete(file: BinaryIO, size_bytes: int) -> bool:
    """Return whether the container has its stated length; the last padding byte may be missing."""
    (length,) = struct.unpack_from("<I", file.read(8), 4)
    return bool(size_bytes >= 8 + length - 1)


def _is_bmp_complete(file: BinaryIO, size_bytes: int) -> bool:
    """Return whether all rows are there, where they are not compressed."""
    head = file.read(34)
    (start,) = struct.unpack_from("<I", head, 10)
    # An older header, whose fields have other places.
    if struct.unpack_from("<I", head, 14)[0] < 40:
        return True
    width, height, _, bits, compression = struct.unpack_from("<2i2HI", head, 18)
    if compression not in (0, 3):  # none, or masks of bits
        return True
    return bool(size_bytes >= start + abs(height) * ((width * bits + 31) // 32 * 4))


def _is_tiff_complete(file: BinaryIO, size_bytes: int) -> bool:
    """Return whether all strips or tiles of the first page lie within the file."""
    order = "<" if file.read(2) == b"II" else ">"
    (version,) = unpack_struct(file, f"{order}H")
    big = version == 43  # BigTIFF
    file.seek(8 if big else 4)
    address = f"{order}{'Q' if big else 'I'}"
    (start,) = unpack_struct(file, address)
    file.seek(start)
    (count,) = unpack_struct(file, f"{order}{'Q' if big else 'H'}")
    fields = [unpack_struct(file, f"{order}2H{'Q8s' if big else 'I4s'}") for _ in range(min(count, 65_535))]
    values = {
        tag: _tiff_values(file, f"{order}{_TIFF_LAYOUTS[kind]}", number, inline, address)
        for tag, kind, number, inline in fields
        if tag in (273, 279, 324, 325) and kind in _TIFF_LAYOUTS
    }
    # StripOffsets and StripByteCounts, TileOffsets and TileByteCounts.
    for offsets, lengths in ((273, 279), (324, 325)):
        ends = zip(values.get(offsets, ()), values.get(lengths, ()), strict=False)
        if any(offset + length > size_bytes for offset, length in ends):
            return False
    return True


def _tiff_values(file: BinaryIO, layout: str, number: int, inline: bytes, address: str) -> tuple[int, ...]:
    """Return the values of a field, which are in the field itself if they fit."""
    order, letter = layout[0], layout[1]
    length = struct.calcsize(layout) * number
    if length <= len(inline):
        return struct.unpack_from(f"{order}{number}{letter}", inline)
    if length > _MAX_BYTES // 16:
        raise ValueError("too many strips")
    (start,) = struct.unpack_from(address, inline)
    file.seek(start)
    return unpack_struct(file, f"{order}{number}{letter}")


def _is_exr_complete(file: BinaryIO, size_bytes: int) -> bool:
    """Return whether all blocks of rows lie within the file, where it has one part without tiles."""
    _, flags = unpack_struct(file, "<2I")
    if flags & (0x200 | 0x800 | 0x1000):  # tiled, deep, of several parts
        return True
    rows, compression = 0, 0
    while name := read_null_terminated(file):
        read_null_terminated(file)
        (length,) = unpack_struct(file, "<I")
        if name == b"compression":
            (compression,) = unpack_struct(file, "<B")
        elif name == b"dataWindow":
            _, top, _, bottom = unpack_struct(file, "<4i")
            rows = bottom - top + 1
        else:
            file.seek(length, os.SEEK_CUR)
    if compression not in _EXR_ROWS:
        return True
    blocks = -(-rows // _EXR_ROWS[compression])
    if blocks > _MAX_BYTES // 64:
        return False
    last = max(unpack_struct(file, f"<{blocks}Q"))
    file.seek(last)
    _, length = unpack_struct(file, "<2I")
    return bool(last + 8 + length <= size_bytes)


def _is_hdr_complete(file: BinaryIO, size_bytes: int) -> bool:
    """Return whether what follows the header can hold all rows, which are shortest where each is even."""
    width, height, _ = read_hdr_size(file)
    start = file.tell()
    marker, length = unpack_struct(file, ">2H")
    if marker == 0x0202 and length in (width, height):  # runs by channel, of at most 127 values each
        row_bytes = 4 + 4 * 2 * -(-length // 127)
        return bool(size_bytes >= start + width * height // length * row_bytes)
    return bool(size_bytes >= start + 4 * min(width, height))  # a row has one pixel or more of 4 bytes


def _assume_complete(_file: BinaryIO, _size_bytes: int) -> bool:
    return True


_CHECKS: dict[str, Callable[[BinaryIO, int], bool]] = {
    "JPEG": _is_jpeg_complete,
    "PNG": _is_png_complete,
    "WebP": _is_webp_complete,
    "BMP": _is_bmp_complete,
    "TIFF": _is_tiff_complete,
    "EXR": _is_exr_complete,
    "HDR": _is_hdr_complete,
}

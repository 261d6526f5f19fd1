"""Names and extra fields of ZIP records, see APPNOTE.TXT 6.3.10, sections 4.5 and 4.6."""

import struct
import zlib

from octasplat.engine.core.portable_names import quoted_name
from octasplat.service.intake.faults import raise_intake_error

UNKNOWN_16, UNKNOWN_32 = 0xFFFF, 0xFFFFFFFF
"""Full values, which the ZIP64 field has."""
_EXTRA_ZIP64, EXTRA_NAME = 0x0001, 0x7075


def decode_name(name: bytes) -> str:
    """Return a name as UTF-8; other bytes become lone surrogates, which no file that is taken may have."""
    return name.decode("utf-8", "surrogateescape")


def full_name(raw_name: bytes, name: str, extra: dict[int, bytes]) -> str:
    """Return the name of an entry: that of its Unicode field if it has one that belongs to the other name."""
    field = extra.get(EXTRA_NAME)
    if field is None or field[5:] == raw_name:
        return name
    is_for_name = field[:1] == b"\1" and field[1:5] == struct.pack("<I", zlib.crc32(raw_name))
    # A name in ASCII needs no other.
    if not is_for_name or raw_name.isascii():
        raise_intake_error(
            "archive-second-name", f"The entry {quoted_name(name)} carries a second name.", name
        )
    return decode_name(field[5:])


def extra_fields(data: bytes, name: str) -> dict[int, bytes]:
    """Return the extra fields of the entry ``name`` by their ids.

    Raises:
        IntakeError: they are damaged, or one that counts comes twice.
    """
    fields: dict[int, bytes] = {}
    position = 0
    while position < len(data):
        if position + 4 > len(data):
            break  # some programs fill up with up to three zeros
        kind, length = struct.unpack_from("<2H", data, position)
        position += 4
        if position + length > len(data) or (kind in (_EXTRA_ZIP64, EXTRA_NAME) and kind in fields):
            raise_intake_error(
                "archive-damaged", f"The extra data of {quoted_name(name)} in the archive are damaged.", name
            )
        fields[kind] = data[position : position + length]
        position += length
    return fields


def zip64_values(extra: dict[int, bytes], name: str, *values: tuple[int, int, int]) -> tuple[int, ...]:
    """Replace values that are full by those of the ZIP64 field; each is (value, full, width in bytes)."""
    field = extra.get(_EXTRA_ZIP64, b"")
    position = 0
    found: list[int] = []
    for value, full, width in values:
        if value == full:
            if position + width > len(field):
                raise_intake_error(
                    "archive-damaged", f"The archive lacks the length of {quoted_name(name)}.", name
                )
            value = int.from_bytes(field[position : position + width], "little")
            position += width
        found.append(value)
    return tuple(found)

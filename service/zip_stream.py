"""ZIP files that are made while they are sent."""

import zipfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from datetime import datetime

_LARGE_BYTES = 1 << 31
"""From this length on an entry has the fields of ZIP64."""


@dataclass(frozen=True)
class ZipEntry:
    """A file of a ZIP file.

    Attributes:
        name: with forward slashes.
        size_bytes: its length.
        read: yields its content.
    """

    name: str
    size_bytes: int
    read: Callable[[], Iterable[bytes]]


def stream_zip(entries: Iterable[ZipEntry], modified_at: datetime) -> Iterator[bytes]:
    """Yield a ZIP file piece by piece, its entries stored as they are; equal arguments give equal bytes.

    Args:
        entries: the files, in order.
        modified_at: the time that every entry has.
    """
    sink = _Sink()
    time = modified_at.timetuple()[:6]
    with zipfile.ZipFile(sink, "w", zipfile.ZIP_STORED, allowZip64=True) as archive:
        for entry in entries:
            info = zipfile.ZipInfo(entry.name, time)
            # The permissions of Unix are in the upper 16 bits.
            info.external_attr = 0o644 << 16
            # Nothing can go back to the header, so that its form is chosen by the length that is known.
            is_large = entry.size_bytes >= _LARGE_BYTES
            with archive.open(info, "w", force_zip64=is_large) as file:
                for piece in entry.read():
                    file.write(piece)
                    yield sink.take()
            yield sink.take()
    yield sink.take()


class _Sink:
    """A file that is written to and emptied in turns, and in which nobody can go back."""

    def __init__(self) -> None:
        self._pieces: list[bytes] = []

    def write(self, piece: bytes) -> int:
        self._pieces.append(bytes(piece))
        return len(piece)

    def flush(self) -> None:
        """Do nothing: what was written is there."""

    def close(self) -> None:
        """Do nothing: what was written is taken by whoever sends it."""

    def take(self) -> bytes:
        """Return what was written since the last time."""
        taken = b"".join(self._pieces)
        self._pieces.clear()
        return taken

"""The SPZ container (Niantic): one gzip stream in versions 2 and 3, one Zstandard stream an attribute in 4.

Attributes follow each other whole: positions, opacities, colors, scales, rotations, harmonics. The frame is
y up, z backward; harmonics beyond degree 3 are left to the caller.
"""

import contextlib
import gzip
import io
import mmap
import struct
import tempfile
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Protocol, cast, runtime_checkable

import numpy as np
import zstandard
from jaxtyping import Bool

from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.files.spz_records import (
    HAS_LEVELS,
    HAS_RECORDS,
    RIGHT_UP_BACK,
    frame_of,
    parse_records,
)

MAGIC = b"NGSP"
GZIP_MAGIC = b"\x1f\x8b\x08"
"""With the byte for Deflate, as a number that something else begins with may have the first two."""
VERSIONS = (2, 3, 4)
MAX_DEGREE = 4
GZIP_LEVEL, ZSTD_LEVEL = 6, 9
ANTIALIASED = 1
_HEADER = struct.Struct("<4sIIBBBB")
_HEADER_V4 = struct.Struct("<4sIIBBBBI12x")
_TOC_ENTRY = struct.Struct("<QQ")
_GZIP_RATIO = 1040
"""Deflate compresses no better than this, so a header that promises more is wrong."""
_ZSTD_RATIO = 1 << 17
_MAX_EXTENSIONS = 1 << 24
_SKIPPED_BYTES = 1 << 20
_CHILD_COUNT_BYTES, _FIRST_CHILD_BYTES = 2, 4
"""Of a Gaussian in a tree of levels: all counts come before all numbers of first children."""


BinaryFile = IO[bytes] | io.BytesIO


@dataclass(frozen=True)
class SpzHeader:
    """What an SPZ says of its Gaussians.

    Attributes:
        version: 2, 3 or 4.
        count: number of Gaussians.
        sh_degree: 0 to 4.
        fractional_bits: of the 24-bit fixed-point positions.
        flags: bits, of which ``ANTIALIASED`` is one.
        frame: where x, y and z point, see :mod:`octasplat.engine.files.spz_records`.
        record_kinds: types of records of extensions.
    """

    version: int
    count: int
    sh_degree: int
    fractional_bits: int
    flags: int
    frame: str = RIGHT_UP_BACK
    record_kinds: tuple[int, ...] = ()

    @property
    def has_levels(self) -> bool:
        """Return whether coarser Gaussians are among them, and opacities are halved, as Spark has it."""
        return self.version != VERSIONS[-1] and bool(self.flags & HAS_LEVELS)

    @property
    def widths(self) -> tuple[int, ...]:
        """Return bytes per Gaussian of positions, opacities, colors, scales, rotations and harmonics."""
        harmonics = 3 * ((self.sh_degree + 1) ** 2 - 1)
        return (9, 1, 3, 3, 3 if self.version == 2 else 4, harmonics)


@dataclass(frozen=True)
class SpzContent:
    """An SPZ to be written.

    Attributes:
        header: what it says of its Gaussians.
        streams: the six attributes, packed, each in pieces that are made when they are asked for.
    """

    header: SpzHeader
    streams: Sequence[Iterable[bytes]]


@runtime_checkable
class _Readable(Protocol):
    def read(self, size: int, /) -> bytes: ...


class SpzSource:
    """An SPZ to be read, some Gaussians at a time; its attributes are unpacked side by side.

    Attributes:
        path: file that it is from, for errors.
        header: what it says of its Gaussians.
        is_finest: which of them are not coarser ones that stand for some of the others; None where all are.
    """

    def __init__(self, path: Path, open_content: Callable[[], BinaryFile], size: int) -> None:
        """Read the header.

        Args:
            path: file that it is from, for errors.
            open_content: opens all of the SPZ, of which six are open at a time.
            size: of it in bytes.

        Raises:
            SceneFileError: it is no SPZ, is damaged, or is of an unknown version.
        """
        self.path = path
        self._open = open_content
        self._size = size
        self._toc: list[tuple[int, int]] = []
        """Of version 4, where each attribute begins and its length, packed."""
        self.is_finest: Bool[np.ndarray, " n"] | None = None
        with _name_errors(path), open_content() as handle:
            start = handle.read(len(MAGIC))
            handle.seek(0)
            if start == MAGIC:
                self.header = self._read_contents(handle)
            elif start.startswith(GZIP_MAGIC):
                self.header = self._read_gzip_header(handle)
            else:
                raise SceneFileError(f"{path}: is no SPZ file.")

    @property
    def count(self) -> int:
        """Return the number of Gaussians of the finest level."""
        return self.header.count if self.is_finest is None else int(self.is_finest.sum())

    def blocks(self, rows: Iterable[slice]) -> Iterator[tuple[slice, tuple[bytes, ...]]]:
        """Yield the six attributes of the rows of each slice; slices follow each other from the first row on.

        Raises:
            SceneFileError: the file is truncated or damaged.
        """
        with contextlib.ExitStack() as stack, _name_errors(self.path):
            handles = [self._open_attribute(number, stack) for number in range(6)]
            for part in rows:
                lengths = [(part.stop - part.start) * width for width in self.header.widths]
                found = tuple(handle.read(length) for handle, length in zip(handles, lengths, strict=True))
                if any(len(piece) < length for piece, length in zip(found, lengths, strict=True)):
                    raise _truncated_error(self.path, self.header.count)
                yield part, found
            if not self._toc:
                handles[-1].read(_MAX_EXTENSIONS)  # at the end of the stream its checksum is looked at

    def _open_attribute(self, number: int, stack: contextlib.ExitStack) -> _Readable:
        """Open an attribute, unpacked, at its beginning; the stack closes it."""
        content = stack.enter_context(self._open())
        if not self._toc:
            unpacked = stack.enter_context(gzip.GzipFile(fileobj=content))
            _skip(unpacked, _HEADER.size + self.header.count * sum(self.header.widths[:number]))
            return unpacked
        start, length = self._toc[number]
        content.seek(start)
        part = cast("IO[bytes]", _Part(content, length))
        reader = zstandard.ZstdDecompressor().stream_reader(part, closefd=False)
        return stack.enter_context(reader)

    def _read_gzip_header(self, handle: BinaryFile) -> SpzHeader:
        with gzip.open(handle) as unpacked:
            magic, version, count, degree, bits, flags, _ = _HEADER.unpack(unpacked.read(_HEADER.size))
        if magic != MAGIC:
            raise SceneFileError(f"{self.path}: is gzip, but holds no SPZ.")
        if version not in VERSIONS[:2]:
            raise SceneFileError(f"{self.path}: is SPZ version {version}; versions 2, 3 and 4 are read.")
        header = self._checked_header(version, count, degree, bits, flags)
        if count * sum(header.widths) > _GZIP_RATIO * self._size:
            raise _truncated_error(self.path, count)
        return self._read_gzip_end(handle, header) if flags & (HAS_LEVELS | HAS_RECORDS) else header

    def _read_gzip_end(self, handle: BinaryFile, header: SpzHeader) -> SpzHeader:
        """Read what follows the attributes; returns the header with what records say."""
        handle.seek(0)
        with gzip.open(handle) as unpacked:
            _skip(unpacked, _HEADER.size + header.count * sum(header.widths))
            if header.has_levels:
                counts = unpacked.read(header.count * _CHILD_COUNT_BYTES)
                if len(counts) < header.count * _CHILD_COUNT_BYTES:
                    raise _truncated_error(self.path, header.count)
                self.is_finest = np.frombuffer(counts, "<u2") == 0
                _skip(unpacked, header.count * _FIRST_CHILD_BYTES)
            return self._with_records(header, unpacked.read(_MAX_EXTENSIONS))

    def _read_contents(self, handle: BinaryFile) -> SpzHeader:
        start = handle.read(_HEADER_V4.size)
        _, version, count, degree, bits, flags, stream_count, contents = _HEADER_V4.unpack(start)
        if version != VERSIONS[-1]:
            raise SceneFileError(f"{self.path}: is SPZ version {version}; versions 2, 3 and 4 are read.")
        header = self._checked_header(version, count, degree, bits, flags)
        header = self._with_records(header, handle.read(min(max(contents - len(start), 0), _MAX_EXTENSIONS)))
        if stream_count < sum(width > 0 for width in header.widths):
            raise SceneFileError(f"{self.path}: is damaged; it has only {stream_count} of its attributes.")
        handle.seek(contents)
        offset = contents + stream_count * _TOC_ENTRY.size
        for number, width in enumerate(header.widths):
            size, full_size = (0, 0)
            if number < stream_count:
                size, full_size = _TOC_ENTRY.unpack(handle.read(_TOC_ENTRY.size))
            if full_size != count * width:
                raise SceneFileError(
                    f"{self.path}: is damaged; attribute {number} does not have {count} items."
                )
            if offset + size > self._size or full_size > _ZSTD_RATIO * max(1, size):
                raise _truncated_error(self.path, count)
            self._toc.append((offset, size))
            offset += size
        return header

    def _checked_header(self, version: int, count: int, degree: int, bits: int, flags: int) -> SpzHeader:
        if degree > MAX_DEGREE:
            raise SceneFileError(f"{self.path}: is damaged; it claims harmonics of degree {degree}.")
        return SpzHeader(version, count, degree, bits, flags)

    def _with_records(self, header: SpzHeader, data: bytes) -> SpzHeader:
        """Return the header with what records of extensions say."""
        records = parse_records(data) if header.flags & HAS_RECORDS else {}
        frame = frame_of(records)
        if frame is None:
            raise SceneFileError(f"{self.path}: is stored in a coordinate system that is not known here.")
        return replace(header, frame=frame, record_kinds=tuple(records))


class _Part:
    """So many bytes of a file from where it is."""

    def __init__(self, handle: BinaryFile, length: int) -> None:
        self._handle = handle
        self._left = length

    def read(self, size: int = -1) -> bytes:
        wanted = self._left if size < 0 else min(size, self._left)
        found = self._handle.read(wanted)
        self._left -= len(found)
        return found


def open_spz(path: Path) -> SpzSource:
    """Open a file.

    Raises:
        SceneFileError: the file cannot be read, is no SPZ, is damaged, or is of an unknown version.
    """
    with _name_errors(path):
        size = path.stat().st_size
    return SpzSource(path, lambda: path.open("rb"), size)


def parse_spz(path: Path, data: bytes) -> SpzSource:
    """Open the content of a file.

    Args:
        path: file that it is from, for errors.
        data: all of the SPZ.

    Raises:
        SceneFileError: it is no SPZ, is damaged, or is of an unknown version.
    """
    return SpzSource(path, lambda: io.BytesIO(data), len(data))


@contextlib.contextmanager
def _name_errors(path: Path) -> Iterator[None]:
    try:
        yield
    except (OSError, EOFError, zlib.error, zstandard.ZstdError, struct.error) as error:
        raise SceneFileError(f"{path}: is damaged or cannot be read ({error}).") from error


def _skip(handle: gzip.GzipFile, length: int) -> None:
    """Read on by so many bytes, or to the end; seek() would do it in small steps."""
    while length > 0 and (found := len(handle.read(min(length, _SKIPPED_BYTES)))):
        length -= found


def _truncated_error(path: Path, count: int) -> SceneFileError:
    return SceneFileError(f"{path}: is truncated; not all of its {count} Gaussians are there.")


def write_spz(content: SpzContent, handle: BinaryFile, folder: Path | None = None) -> None:
    """Write a file, piece by piece: gzip for version 3, Zstandard for version 4.

    Args:
        content: what to write.
        handle: an empty file; it can be gone back in.
        folder: for a file without a name that holds an attribute of version 4; None for that of the system,
            which may be in memory.
    """
    header = content.header
    if header.version == VERSIONS[-1]:
        _write_v4(content, handle, folder)
        return
    fields = (header.version, header.count, header.sh_degree, header.fractional_bits, header.flags, 0)
    # Without the time, equal scenes give equal files.
    with gzip.GzipFile("", "wb", GZIP_LEVEL, handle, mtime=0) as packed:  # type: ignore[arg-type]
        packed.write(_HEADER.pack(MAGIC, *fields))
        for stream in content.streams:
            for piece in stream:
                packed.write(piece)


def _write_v4(content: SpzContent, handle: BinaryFile, folder: Path | None) -> None:
    header = content.header
    present = [stream for stream, width in zip(content.streams, header.widths, strict=True) if width]
    fields = (header.version, header.count, header.sh_degree, header.fractional_bits, header.flags)
    start = _HEADER_V4.pack(MAGIC, *fields, len(present), _HEADER_V4.size)
    handle.write(start + bytes(len(present) * _TOC_ENTRY.size))
    sizes = []
    for stream in present:
        # Zstandard makes other bytes of a stream in pieces, so that it is put on disk, and mapped.
        with tempfile.TemporaryFile(dir=folder) as spool:
            for piece in stream:
                spool.write(piece)
            spool.flush()
            length = spool.tell()
            with (
                mmap.mmap(spool.fileno(), length, access=mmap.ACCESS_READ) as mapped,
                memoryview(mapped) as whole,
            ):
                packed = zstandard.ZstdCompressor(level=ZSTD_LEVEL).compress(whole)
        handle.write(packed)
        sizes.append(_TOC_ENTRY.pack(len(packed), length))
    handle.seek(len(start))
    handle.write(b"".join(sizes))

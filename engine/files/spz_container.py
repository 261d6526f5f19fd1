"""The SPZ container (Niantic): one gzip stream in versions 2 and 3, one Zstandard stream an attribute in 4.

Attributes follow each other whole: positions, opacities, colors, scales, rotations, harmonics. The frame is
y up, z backward; harmonics beyond degree 3 are left to the caller.
"""

import gzip
import io
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

import zstandard

from octasplat.engine.core.errors import SceneFileError

MAGIC = b"NGSP"
GZIP_MAGIC = b"\x1f\x8b"
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


@dataclass(frozen=True)
class SpzFile:
    """An SPZ file without its compression.

    Attributes:
        version: 2, 3 or 4.
        count: number of Gaussians.
        sh_degree: 0 to 4.
        fractional_bits: of the 24-bit fixed-point positions.
        flags: bits, of which ``ANTIALIASED`` is one.
        streams: the six attributes, packed.
    """

    version: int
    count: int
    sh_degree: int
    fractional_bits: int
    flags: int
    streams: tuple[bytes, ...]


def stream_widths(version: int, sh_degree: int) -> tuple[int, ...]:
    """Return bytes per Gaussian of positions, opacities, colors, scales, rotations and harmonics."""
    return (9, 1, 3, 3, 3 if version == 2 else 4, 3 * ((sh_degree + 1) ** 2 - 1))


def read_spz(path: Path) -> SpzFile:
    """Read and decompress a file.

    Raises:
        SceneFileError: the file is no SPZ, is damaged, or is of an unknown version.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise SceneFileError(f"{path}: is damaged or cannot be read ({error}).") from error
    return parse_spz(path, data)


def parse_spz(path: Path, data: bytes) -> SpzFile:
    """Decompress the content of a file.

    Args:
        path: file that it is from, for errors.
        data: all of the SPZ.

    Raises:
        SceneFileError: it is no SPZ, is damaged, or is of an unknown version.
    """
    try:
        if data.startswith(MAGIC):
            return _read_v4(path, data)
        if data.startswith(GZIP_MAGIC):
            return _read_gzip(path, data)
    except (OSError, EOFError, zlib.error, zstandard.ZstdError, struct.error) as error:
        raise SceneFileError(f"{path}: is damaged or cannot be read ({error}).") from error
    raise SceneFileError(f"{path}: is no SPZ file.")


def _read_gzip(path: Path, data: bytes) -> SpzFile:
    with gzip.open(io.BytesIO(data)) as handle:
        magic, version, count, degree, bits, flags, _ = _HEADER.unpack(handle.read(_HEADER.size))
        if magic != MAGIC:
            raise SceneFileError(f"{path}: is gzip, but holds no SPZ.")
        if version not in VERSIONS[:2]:
            raise SceneFileError(f"{path}: is SPZ version {version}; versions 2, 3 and 4 are read.")
        widths = _checked_widths(path, version, degree)
        if count * sum(widths) > _GZIP_RATIO * len(data):
            raise _truncated_error(path, count)
        streams = tuple(handle.read(count * width) for width in widths)
        handle.read(_MAX_EXTENSIONS)  # the end of the stream is where its checksum is looked at
    if any(len(stream) < count * width for stream, width in zip(streams, widths, strict=True)):
        raise _truncated_error(path, count)
    return SpzFile(
        version=version, count=count, sh_degree=degree, fractional_bits=bits, flags=flags, streams=streams
    )


def _read_v4(path: Path, data: bytes) -> SpzFile:
    _, version, count, degree, bits, flags, stream_count, contents = _HEADER_V4.unpack_from(data)
    if version != VERSIONS[-1]:
        raise SceneFileError(f"{path}: is SPZ version {version}; versions 2, 3 and 4 are read.")
    widths = _checked_widths(path, version, degree)
    if stream_count < sum(width > 0 for width in widths):
        raise SceneFileError(f"{path}: is damaged; it has only {stream_count} of its attributes.")
    offset = contents + stream_count * _TOC_ENTRY.size
    streams = []
    for number, width in enumerate(widths):
        size, full_size = (0, 0)
        if number < stream_count:
            size, full_size = _TOC_ENTRY.unpack_from(data, contents + number * _TOC_ENTRY.size)
        if full_size != count * width:
            raise SceneFileError(f"{path}: is damaged; attribute {number} does not have {count} items.")
        if offset + size > len(data) or full_size > _ZSTD_RATIO * max(1, size):
            raise _truncated_error(path, count)
        packed = data[offset : offset + size]
        reader = zstandard.ZstdDecompressor().stream_reader(packed)
        streams.append(reader.read(full_size) if full_size else b"")
        if len(streams[-1]) < full_size:
            raise _truncated_error(path, count)
        offset += size
    return SpzFile(
        version=version,
        count=count,
        sh_degree=degree,
        fractional_bits=bits,
        flags=flags,
        streams=tuple(streams),
    )


def _checked_widths(path: Path, version: int, degree: int) -> tuple[int, ...]:
    if degree > MAX_DEGREE:
        raise SceneFileError(f"{path}: is damaged; it claims harmonics of degree {degree}.")
    return stream_widths(version, degree)


def _truncated_error(path: Path, count: int) -> SceneFileError:
    return SceneFileError(f"{path}: is truncated; not all of its {count} Gaussians are there.")


def pack_spz(file: SpzFile) -> bytes:
    """Return the content of a file: gzip for version 3, Zstandard for version 4."""
    if file.version == VERSIONS[-1]:
        return _pack_v4(file)
    packed = io.BytesIO()
    header = (file.version, file.count, file.sh_degree, file.fractional_bits, file.flags, 0)
    # Without the time, equal scenes give equal files.
    with gzip.GzipFile("", "wb", GZIP_LEVEL, packed, mtime=0) as handle:
        handle.write(_HEADER.pack(MAGIC, *header))
        for stream in file.streams:
            handle.write(stream)
    return packed.getvalue()


def _pack_v4(file: SpzFile) -> bytes:
    streams = [stream for stream in file.streams if stream]
    packed = [zstandard.ZstdCompressor(level=ZSTD_LEVEL).compress(stream) for stream in streams]
    header = (file.version, file.count, file.sh_degree, file.fractional_bits, file.flags, len(packed))
    contents = [
        _TOC_ENTRY.pack(len(small), len(stream)) for small, stream in zip(packed, streams, strict=True)
    ]
    return b"".join([_HEADER_V4.pack(MAGIC, *header, _HEADER_V4.size), *contents, *packed])

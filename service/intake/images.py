"""Size of an image from its header, without decoding it.

A header may be wrong and may be endless, so every reader works on a file of bounded length. Pillow reads
JPEG, PNG and BMP; of the formats that it refuses, decodes at once (WebP) or does not know, only the fields
that hold the size are read here.
"""

import io
import re
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any, BinaryIO

from PIL import ImageFile
from PIL.BmpImagePlugin import BmpImageFile
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile

from octasplat.engine.core.portable_names import quoted_name
from octasplat.service.intake.faults import IntakeError, IntakeFault

_SUFFIXES = {
    "JPEG": (".jpg", ".jpeg"), "PNG": (".png",), "TIFF": (".tif", ".tiff"), "WebP": (".webp",),
    "BMP": (".bmp",), "EXR": (".exr",), "HDR": (".hdr",),
}  # fmt: skip
# What the plugins of Pillow, and struct, raise where a file is damaged.
_HEADER_ERRORS = (
    OSError, SyntaxError, ValueError, ArithmeticError, LookupError, TypeError, AttributeError, RuntimeError,
    MemoryError, struct.error,
)  # fmt: skip


@dataclass(frozen=True)
class ImageLimits:
    """Limits of an uploaded photograph.

    Attributes:
        max_pixels: width times height.
        max_side_px: width and height.
        max_header_bytes: what may be read before the size is known.
    """

    max_pixels: int = 250_000_000
    max_side_px: int = 65_535
    max_header_bytes: int = 16 << 20


@dataclass(frozen=True)
class ImageHeader:
    """Properties read from an image header.

    Attributes:
        kind: ``JPEG``, ``PNG``, ``TIFF``, ``WebP``, ``BMP``, ``EXR`` or ``HDR``.
        width_px: width as stored; an EXIF orientation is not applied.
        height_px: height as stored.
        warning: one sentence on what is odd but usable, or None.
    """

    kind: str
    width_px: int
    height_px: int
    warning: str | None = None


def read_image_header(file: BinaryIO, name: str, limits: ImageLimits = ImageLimits()) -> ImageHeader:
    """Check the header of an image.

    Args:
        file: seekable, at any position.
        name: its name in the dataset, for the sentences.
        limits: what is taken.

    Raises:
        IntakeError: ``image-kind``, ``image-damaged``, ``image-header-too-long``, ``image-animated``,
            ``image-too-many-pixels`` or ``image-too-long-side``.
    """
    quoted = quoted_name(name)
    bounded: Any = _BoundedFile(file, limits.max_header_bytes)
    head = bounded.read(32)
    bounded.seek(0)
    kind = image_type(head)
    if kind is None:
        raise IntakeError(
            IntakeFault(
                "image-kind",
                f"{quoted} is not an image of a known kind; send JPEG, PNG, TIFF, WebP, BMP, EXR or HDR.",
                name,
            )
        )
    try:
        width, height, frames = _READERS[kind](bounded)
    except _HeaderTooLongError:
        detail = (
            f"{quoted} has no size in its first {limits.max_header_bytes} bytes of header; write it anew."
        )
        raise IntakeError(IntakeFault("image-header-too-long", detail, name)) from None
    except _HEADER_ERRORS:
        detail = f"{quoted} has a damaged {kind} header; replace the file."
        raise IntakeError(IntakeFault("image-damaged", detail, name)) from None
    if width < 1 or height < 1:
        raise IntakeError(IntakeFault("image-damaged", f"{quoted} is {width}x{height} pixels large.", name))
    if frames > 1:
        detail = f"{quoted} is an animation of {frames} frames; send photographs one by one."
        raise IntakeError(IntakeFault("image-animated", detail, name))
    if max(width, height) > limits.max_side_px:
        detail = f"{quoted} is {width}x{height} pixels large; {limits.max_side_px} are allowed on a side."
        raise IntakeError(IntakeFault("image-too-long-side", detail, name))
    if width * height > limits.max_pixels:
        detail = f"{quoted} has {width * height} pixels ({width}x{height}); {limits.max_pixels} are allowed."
        raise IntakeError(IntakeFault("image-too-many-pixels", detail, name))
    suffix = PurePosixPath(name).suffix.lower()
    odd = suffix not in _SUFFIXES[kind]
    return ImageHeader(
        kind, width, height, f"{quoted} is a {kind} file by its content, not by its name." if odd else None
    )


def image_type(head: bytes) -> str | None:
    """Return the kind of image that begins with ``head`` (32 bytes), or None."""
    if head.startswith(b"RIFF") and head[8:12] == b"WEBP":
        return "WebP"
    for magic, kind in (
        (b"\xff\xd8\xff", "JPEG"), (b"\x89PNG\r\n\x1a\n", "PNG"), (b"BM", "BMP"), (b"II*\0", "TIFF"),
        (b"MM\0*", "TIFF"), (b"II+\0", "TIFF"), (b"MM\0+", "TIFF"), (b"v/1\x01", "EXR"),
        (b"#?RADIANCE", "HDR"), (b"#?RGBE", "HDR"),
    ):  # fmt: skip
        if head.startswith(magic):
            return kind
    return None


class _HeaderTooLongError(Exception):
    """More bytes were read than a header may have."""


class _BoundedFile(io.RawIOBase):
    """A file that returns a bounded number of bytes in a bounded number of calls."""

    def __init__(self, file: BinaryIO, max_bytes: int) -> None:
        self._file = file
        self._bytes_left = max_bytes
        # Many small reads take long although they read little.
        self._calls_left = 200_000
        self._file.seek(0)

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        self._charge_read(0)
        return self._file.seek(offset, whence)

    def tell(self) -> int:
        return self._file.tell()

    def read(self, size: int | None = -1) -> bytes:
        requested = -1 if size is None else size
        if requested < 0 or requested > self._bytes_left:
            # One more than is left, by which _charge_read notices that there are more.
            requested = self._bytes_left + 1
        data = self._file.read(requested)
        self._charge_read(len(data))
        return data

    def readline(self, size: int | None = -1) -> bytes:
        data = self._file.readline(4096)
        self._charge_read(len(data))
        return data

    def _charge_read(self, taken: int) -> None:
        self._bytes_left -= taken
        self._calls_left -= 1
        if self._bytes_left < 0 or self._calls_left < 0:
            raise _HeaderTooLongError


def _pillow_reader(reader: Callable[[Any], ImageFile.ImageFile]) -> Callable[[Any], tuple[int, int, int]]:
    """Return a reader of sizes by a plugin of Pillow, called directly, as its pixel limit is not ours."""

    def read(file: Any) -> tuple[int, int, int]:
        image = reader(file)
        width, height = image.size
        return width, height, int(getattr(image, "n_frames", 1))

    return read


def unpack_struct(file: Any, layout: str) -> tuple[Any, ...]:
    """Return the next values of a file, by their layout as of :mod:`struct`."""
    return struct.unpack(layout, file.read(struct.calcsize(layout)))


def _read_webp_size(file: Any) -> tuple[int, int, int]:
    head = file.read(30)
    chunk = head[12:16]
    if chunk == b"VP8X":
        flags, width, height = head[20], head[24:27], head[27:30]
        is_animated = flags & 0x02
        # Each side less one, in 24 bits.
        sizes = (1 + int.from_bytes(side, "little") for side in (width, height))
        return next(sizes), next(sizes), 2 if is_animated else 1
    if chunk == b"VP8L" and head[20] == 0x2F:
        bits = int.from_bytes(head[21:25], "little")
        return (bits & 0x3FFF) + 1, ((bits >> 14) & 0x3FFF) + 1, 1
    if chunk == b"VP8 " and head[23:26] == b"\x9d\x01\x2a":
        width, height = struct.unpack_from("<2H", head, 26)
        return width & 0x3FFF, height & 0x3FFF, 1
    raise ValueError("no WebP frame")


def _read_tiff_size(file: Any) -> tuple[int, int, int]:
    """Return the size of the first page, the only one that counts."""
    order = "<" if file.read(2) == b"II" else ">"
    (version,) = unpack_struct(file, f"{order}H")
    if version == 43:  # BigTIFF
        file.seek(8)
        (start,) = unpack_struct(file, f"{order}Q")
        file.seek(start)
        (count,) = unpack_struct(file, f"{order}Q")
    else:
        (start,) = unpack_struct(file, f"{order}I")
        file.seek(start)
        (count,) = unpack_struct(file, f"{order}H")
    sizes: dict[int, int] = {}
    for _ in range(min(count, 65_535)):
        tag, kind = unpack_struct(file, f"{order}2H")
        values, field = unpack_struct(file, f"{order}Q8s" if version == 43 else f"{order}I4s")
        if tag in (256, 257):  # ImageWidth, ImageLength
            if values != 1:
                raise ValueError("several sizes")
            layout = {1: "B", 3: "H", 4: "I", 16: "Q"}[kind]
            (sizes[tag],) = struct.unpack_from(order + layout, field)
        if len(sizes) == 2 or tag > 257:
            break  # tags are in order
    return sizes[256], sizes[257], 1


def _read_exr_size(file: Any) -> tuple[int, int, int]:
    _, flags = unpack_struct(file, "<2I")
    if flags & 0x800:
        raise ValueError("deep data")
    while name := read_null_terminated(file):
        read_null_terminated(file)
        (length,) = unpack_struct(file, "<i")
        if length < 0:
            raise ValueError("negative length")
        if name == b"dataWindow":
            left, top, right, bottom = unpack_struct(file, "<4i")
            return right - left + 1, bottom - top + 1, 1
        file.seek(length, io.SEEK_CUR)
    raise ValueError("no data window")


def read_null_terminated(file: Any) -> bytes:
    """Return a null-terminated text of at most 255 bytes."""
    text = bytearray()
    while (letter := file.read(1)) != b"\0":
        text += letter
        if not letter or len(text) > 255:
            raise ValueError("text without end")
    return bytes(text)


def read_hdr_size(file: Any) -> tuple[int, int, int]:
    """Return width, height and 1 of a Radiance picture, and leave the file where its pixels begin."""
    while line := file.readline().strip():
        if len(line) > 4000:
            raise ValueError("long line")
    size = re.fullmatch(rb"([-+])([XY]) (\d{1,9}) ([-+])([XY]) (\d{1,9})", file.readline().strip())
    if size is None or size[2] == size[5]:
        raise ValueError("no size")
    first, second = int(size[3]), int(size[6])
    # The axis that is named first is the slower one; with X first the image is stored by columns.
    return (first, second, 1) if size[2] == b"X" else (second, first, 1)


_READERS: dict[str, Callable[[Any], tuple[int, int, int]]] = {
    "JPEG": _pillow_reader(JpegImageFile),
    "PNG": _pillow_reader(PngImageFile),
    "BMP": _pillow_reader(BmpImageFile),
    "WebP": _read_webp_size,
    "TIFF": _read_tiff_size,
    "EXR": _read_exr_size,
    "HDR": read_hdr_size,
}

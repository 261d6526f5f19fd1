"""Image headers: what they say is believed by nobody before it is within limits."""

import io
import struct
import time
import warnings
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from octasplat.service.intake.faults import IntakeError
from octasplat.service.intake.images import ImageHeader, ImageLimits, read_image_header


def header(data: bytes, name: str = "images/a.jpg", **limits: int) -> ImageHeader:
    return read_image_header(io.BytesIO(data), name, ImageLimits(**limits))


def refusal(data: bytes, name: str = "images/a.jpg", **limits: int) -> str:
    with pytest.raises(IntakeError) as caught:
        header(data, name, **limits)
    assert "a.jpg" in str(caught.value) and str(caught.value).endswith(".")
    assert caught.value.faults[0].file == name
    return caught.value.code


def pillow(kind: str, mode: str = "RGB", size: tuple[int, int] = (31, 17), **options: Any) -> bytes:
    out = io.BytesIO()
    Image.new(mode, size).save(out, kind, **options)
    return out.getvalue()


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(width: int, height: int, *extra: bytes, data: bytes = b"") -> bytes:
    start = chunk(b"IHDR", struct.pack(">2I5B", width, height, 8, 2, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + start + b"".join(extra) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def tiff(width: int, height: int, order: str = "<", kind: int = 4, big: bool = False) -> bytes:
    layout = {3: "H", 4: "I", 16: "Q"}[kind]
    room = 8 if big else 4

    def tag(number: int, value: int) -> bytes:
        field = struct.pack(order + layout, value).ljust(room, b"\0")
        return struct.pack(f"{order}2H{'Q' if big else 'I'}", number, kind, 1) + field

    mark = b"II" if order == "<" else b"MM"
    if big:
        head = mark + struct.pack(f"{order}3HQ", 43, 8, 0, 16) + struct.pack(f"{order}Q", 2)
    else:
        head = mark + struct.pack(f"{order}HI", 42, 8) + struct.pack(f"{order}H", 2)
    return head + tag(256, width) + tag(257, height)


GOOD: dict[str, tuple[str, Callable[[], bytes]]] = {
    "jpeg": ("JPEG", lambda: pillow("JPEG")),
    "jpeg gray": ("JPEG", lambda: pillow("JPEG", "L")),
    "jpeg cmyk": ("JPEG", lambda: pillow("JPEG", "CMYK")),
    "jpeg progressive": ("JPEG", lambda: pillow("JPEG", progressive=True)),
    "png": ("PNG", lambda: pillow("PNG")),
    "png 16 bit": ("PNG", lambda: pillow("PNG", "I;16")),
    "png palette": ("PNG", lambda: pillow("PNG", "P")),
    "bmp": ("BMP", lambda: pillow("BMP")),
    "tiff": ("TIFF", lambda: pillow("TIFF")),
    "tiff many pages": (
        "TIFF", lambda: pillow("TIFF", save_all=True, append_images=[Image.new("RGB", (9, 9))] * 50),
    ),
    "tiff other order": ("TIFF", lambda: tiff(31, 17, ">", 3)),
    "tiff big": ("TIFF", lambda: tiff(31, 17, ">", 16, big=True)),
    "webp": ("WebP", lambda: pillow("WEBP")),
    "webp lossless": ("WebP", lambda: pillow("WEBP", "RGBA", lossless=True)),
    "webp with more": ("WebP", lambda: pillow("WEBP", "RGBA", exif=b"Exif\0\0" + bytes(20))),
}  # fmt: skip


@pytest.mark.parametrize("case", GOOD)
def test_image_header_size_is_read(case: str) -> None:
    kind, make = GOOD[case]
    suffix = {"JPEG": "jpeg", "TIFF": "tif"}.get(kind, kind.lower())
    assert header(make(), f"images/a.{suffix}") == ImageHeader(kind, 31, 17)


@pytest.mark.parametrize(
    ("suffix", "kind"), [("exr", "EXR"), ("hdr", "HDR"), ("tif", "TIFF"), ("png", "PNG")]
)
def test_files_of_the_engine_s_library(tmp_path: Path, suffix: str, kind: str) -> None:
    path = tmp_path / f"a.{suffix}"
    out = oiio.ImageOutput.create(str(path))
    assert out is not None
    spec = oiio.ImageSpec(31, 17, 3, "uint16" if suffix == "png" else "float")
    spec.x, spec.y = (5, 7) if suffix == "exr" else (0, 0)
    assert out.open(str(path), spec), out.geterror()
    assert out.write_image(np.zeros((17, 31, 3), np.float32)), out.geterror()
    out.close()
    assert header(path.read_bytes(), f"images/a.{suffix}") == ImageHeader(kind, 31, 17)


def test_image_header_of_large_photograph_is_accepted() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert header(png(16_320, 12_240), "images/a.png") == ImageHeader("PNG", 16_320, 12_240)


def test_orientation_is_not_applied() -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    assert header(pillow("JPEG", exif=exif)) == ImageHeader("JPEG", 31, 17)


def test_image_header_wrong_suffix_warns() -> None:
    found = header(pillow("PNG"), "images/a.jpg")
    assert found.kind == "PNG" and found.warning is not None and "PNG" in found.warning


def webp_canvas(width: int, height: int, flags: int = 0) -> bytes:
    sides = (width - 1).to_bytes(3, "little") + (height - 1).to_bytes(3, "little")
    return b"RIFF" + bytes(4) + b"WEBPVP8X" + struct.pack("<I4B", 10, flags, 0, 0, 0) + sides


def jpeg(*segments: tuple[int, bytes]) -> bytes:
    return b"\xff\xd8" + b"".join(
        b"\xff" + bytes([kind]) + struct.pack(">H", len(data) + 2) + data for kind, data in segments
    )


def sof(width: int, height: int) -> tuple[int, bytes]:
    return 0xC0, struct.pack(">B2HB", 8, height, width, 1) + b"\x01\x11\0"


BAD: dict[str, tuple[Callable[[], bytes], str]] = {
    "png of 900 megapixels": (lambda: png(30_000, 30_000), "image-too-many-pixels"),
    "png of 2^31": (lambda: png(2**31 - 1, 2**31 - 1), "image-too-long-side"),
    "png of no width": (lambda: png(0, 5), "image-damaged"),
    "long png": (lambda: png(70_000, 1), "image-too-long-side"),
    "bmp of 2^31": (
        lambda: b"BM" + struct.pack("<I2HI", 100, 0, 0, 54) + struct.pack("<I2i2H", 40, 2**31 - 1, 9, 1, 24)
        + bytes(64), "image-too-long-side",
    ),
    "jpeg of 4 gigapixels": (
        lambda: jpeg(sof(65_535, 65_535), (0xDA, b"\x01\x01\0\0?\0")), "image-too-many-pixels",
    ),
    "tiff of 2^32": (lambda: tiff(2**32 - 1, 2**32 - 1), "image-too-long-side"),
    "big tiff of 2^64": (lambda: tiff(2**64 - 1, 1, "<", 16, big=True), "image-too-long-side"),
    "tiff without size": (lambda: b"II*\0\x08\0\0\0\0\0", "image-damaged"),
    "tiff pointing nowhere": (lambda: b"II*\0\xff\xff\xff\xff", "image-damaged"),
    "big tiff of 2^64 tags": (
        lambda: b"II+\0\x08\0\0\0" + struct.pack("<2Q", 16, 2**64 - 1) + bytes(4_000_000), "image-damaged",
    ),
    "webp canvas": (lambda: webp_canvas(2**24, 2**24), "image-too-long-side"),
    "animated webp": (lambda: webp_canvas(10, 10, 2), "image-animated"),
    "animated png": (
        lambda: png(10, 10, chunk(b"acTL", struct.pack(">2I", 1000, 0))), "image-animated",
    ),
    "cut png": (lambda: png(10, 10)[:20], "image-damaged"),
    "cut jpeg": (lambda: pillow("JPEG")[:60], "image-damaged"),
    "text": (lambda: b"hello, this is no photograph", "image-kind"),
    "page": (lambda: b"<svg onload=alert(1)>", "image-kind"),
    "program": (lambda: b"\x7fELF" + bytes(100), "image-kind"),
    "heic": (lambda: b"\0\0\0\x18ftypheic" + bytes(100), "image-kind"),
    "gif": (lambda: pillow("GIF"), "image-kind"),
    "nothing": (lambda: b"", "image-kind"),
    "jpeg with an endless head": (
        lambda: jpeg(*[(0xE1, bytes(65_000))] * 300, sof(10, 10)), "image-header-too-long",
    ),
    "jpeg of junk": (lambda: b"\xff\xd8\xff" + b"\0" * 3_000_000, "image-header-too-long"),
    "png with an endless head": (
        lambda: png(10, 10, *[chunk(b"prIv", bytes(1 << 20))] * 20), "image-header-too-long",
    ),
    "png with one long chunk": (
        lambda: png(10, 10, chunk(b"prIv", bytes(40 << 20))), "image-header-too-long",
    ),
    "png with a packed bomb": (
        lambda: png(10, 10, chunk(b"iCCP", b"x\0\0" + zlib.compress(bytes(200_000_000), 9))), "image-damaged",
    ),
    "exr without window": (lambda: b"v/1\x01\x02\0\0\0\0", "image-damaged"),
    "exr with a long text": (lambda: b"v/1\x01\x02\0\0\0" + b"a" * 9000, "image-damaged"),
    "exr of 2^32": (
        lambda: b"v/1\x01\x02\0\0\0dataWindow\0box2i\0" + struct.pack("<5i", 16, -(2**31), 0, 2**31 - 1, 0),
        "image-too-long-side",
    ),
    "deep exr": (lambda: b"v/1\x01\x02\x08\0\0", "image-damaged"),
    "hdr without size": (lambda: b"#?RADIANCE\n\nhello\n", "image-damaged"),
    "hdr with endless lines": (lambda: b"#?RADIANCE\n" + b"a\n" * 300_000, "image-header-too-long"),
    "hdr of one line": (lambda: b"#?RADIANCE" + b"a" * 300_000, "image-damaged"),
    "huge hdr": (lambda: b"#?RGBE\n\n-Y 999999999 +X 9\n", "image-too-long-side"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_image_header_damaged_is_refused(case: str) -> None:
    make, code = BAD[case]
    data = make()
    began = time.perf_counter()
    assert refusal(data) == code
    assert time.perf_counter() - began < 3


def test_image_header_limits_are_configurable() -> None:
    data = pillow("PNG")
    assert refusal(data, max_pixels=31 * 17 - 1) == "image-too-many-pixels"
    assert refusal(data, max_side_px=30) == "image-too-long-side"
    assert header(data, max_pixels=31 * 17, max_side_px=31).width_px == 31


def samples() -> list[bytes]:
    damaged = [make() for make, _ in BAD.values()]
    return [make() for _, make in GOOD.values()] + [data for data in damaged if len(data) < 500]


@pytest.mark.exhaustive
@settings(max_examples=500, deadline=None)
@given(
    st.deferred(lambda: st.sampled_from(samples())),
    st.lists(st.tuples(st.integers(0, 400), st.integers(0, 255)), max_size=8),
    st.integers(0, 2000),
)
def test_damage_is_refused_or_within_limits(sample: bytes, changes: list[tuple[int, int]], cut: int) -> None:
    data = bytearray(sample[:cut])
    for position, value in changes:
        if position < len(data):
            data[position] = value
    try:
        found = header(bytes(data))
    except IntakeError as error:
        assert error.code.startswith("image-")
    else:
        assert 1 <= found.width_px * found.height_px <= ImageLimits().max_pixels
        replace(found)

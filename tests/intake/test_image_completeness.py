"""Images that were cut off are refused by their name, whole ones are not, whatever follows their end."""

import io
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
from PIL import Image

from octasplat.service.intake.faults import IntakeError
from octasplat.service.intake.image_completeness import check_complete
from octasplat.service.intake.images import read_image_header

PIXELS = np.random.default_rng(1).integers(0, 255, (96, 128, 3), np.uint8)


def pillow(kind: str, **options: Any) -> bytes:
    out = io.BytesIO()
    Image.fromarray(PIXELS).save(out, kind, **options)
    return out.getvalue()


def with_thumbnail() -> bytes:
    """A JPEG with a small JPEG, end mark and all, in its header."""
    small = io.BytesIO()
    Image.fromarray(PIXELS[::4, ::4]).save(small, "JPEG")
    note = b"Exif\0\0" + small.getvalue()
    whole = pillow("JPEG")
    return whole[:2] + b"\xff\xe1" + (len(note) + 2).to_bytes(2, "big") + note + whole[2:]


def by_oiio(suffix: str, folder: Path, **attributes: Any) -> bytes:
    path = folder / f"a.{suffix}"
    spec = oiio.ImageSpec(128, 96, 3, oiio.HALF if suffix == "exr" else oiio.UINT8)
    for name, value in attributes.items():
        spec.attribute(name, value)
    if attributes.get("tiled"):
        spec.tile_width = spec.tile_height = 32
    out = oiio.ImageOutput.create(str(path))
    pixels = np.full_like(PIXELS, 128) if attributes.get("even") else PIXELS
    assert out.open(str(path), spec) and out.write_image(pixels) and out.close()
    return path.read_bytes()


def look(data: bytes, name: str = "images/a") -> str:
    """The kind of an image that is complete."""
    file = io.BytesIO(data)
    kind = read_image_header(file, name).kind
    check_complete(file, name, kind)
    return kind


MADE = {
    "JPEG": lambda folder: pillow("JPEG", quality=95),
    "progressive JPEG": lambda folder: pillow("JPEG", progressive=True),
    "JPEG with a thumbnail": lambda folder: with_thumbnail(),
    "JPEG with restarts": lambda folder: pillow("JPEG", restart_marker_blocks=2),
    "PNG": lambda folder: pillow("PNG"),
    "WebP": lambda folder: pillow("WebP"),
    "lossless WebP": lambda folder: pillow("WebP", lossless=True),
    "BMP": lambda folder: pillow("BMP"),
    "TIFF": lambda folder: pillow("TIFF"),
    "compressed TIFF": lambda folder: pillow("TIFF", compression="tiff_lzw"),
    "tiled TIFF": lambda folder: by_oiio("tif", folder, tiled=1),
    "EXR": lambda folder: by_oiio("exr", folder, compression="zip"),
    "EXR of single rows": lambda folder: by_oiio("exr", folder, compression="zips"),
    "raw EXR": lambda folder: by_oiio("exr", folder, compression="none"),
    "even HDR": lambda folder: by_oiio("hdr", folder, even=True),
    "EXR by PIZ": lambda folder: by_oiio("exr", folder, compression="piz"),
}


@pytest.mark.parametrize("case", MADE)
def test_truncated_image_is_refused(tmp_path: Path, case: str) -> None:
    data = MADE[case](tmp_path)
    look(data)
    for length in (*(len(data) * n // 16 for n in range(2, 16)), len(data) - 16):
        with pytest.raises(IntakeError, match="'images/a'") as caught:
            look(data[:length])
        # Where so much is missing that there is no header, or it lay at the end, that is what is wrong.
        assert caught.value.code in ("image-cut-off", "image-damaged")
    if "TIFF" not in case:
        with pytest.raises(IntakeError, match="cut off: the end of its") as caught:
            look(data[: len(data) * 9 // 10])


@pytest.mark.parametrize("case", ["JPEG", "progressive JPEG", "JPEG with a thumbnail", "PNG"])
def test_image_with_trailing_data_is_accepted(tmp_path: Path, case: str) -> None:
    film = np.random.default_rng(2).integers(0, 200, 300_000, np.uint8).tobytes()
    assert look(MADE[case](tmp_path) + film) == ("PNG" if case == "PNG" else "JPEG")


@pytest.mark.parametrize("size", [b"-Y 96 +X 128", b"+X 128 -Y 96"])
def test_hdr_without_pixels_is_refused(size: bytes) -> None:
    header = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n" + size + b"\n"
    for pixels in (b"", b"0123456789", b"\2\2\0\x80" + b"\xff\1\x81\1" * 4):
        with pytest.raises(IntakeError, match="cut off: the end of its HDR") as caught:
            look(header + pixels)
        assert caught.value.code == "image-cut-off"
    assert look(header + PIXELS.tobytes() + bytes(128 * 96)) == "HDR"


def test_complete_images_of_other_programs_are_accepted() -> None:
    paths = sorted((Path(__file__).parents[2] / "docs" / "images").glob("*.jpg"))
    assert paths
    for path in paths:
        assert look(path.read_bytes()) == "JPEG", path

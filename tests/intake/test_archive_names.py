"""Names in ZIP files that are not UTF-8, as Windows and old programs write them."""

import io
import struct
import zlib

import pytest

from octasplat.service.intake.archive import list_archive
from octasplat.service.intake.faults import IntakeError
from tests.support.zip_builder import ZipMember, build_zip

PHOTOGRAPHS = ("images/a.jpg", "images/b.jpg", "images/c.jpg")


def _unicode_field(raw: bytes, name: str) -> bytes:
    text = name.encode()
    return struct.pack("<2HBI", 0x7075, 5 + len(text), 1, zlib.crc32(raw)) + text


@pytest.mark.parametrize(
    ("outer", "encoding"), [("\u6a21\u578b", "gbk"), ("H\u00e4user", "cp437"), ("\u00dc", "latin-1")]
)
def test_a_folder_around_everything_may_have_a_name_in_any_encoding(outer: str, encoding: str) -> None:
    raw = outer.encode(encoding)
    members = [ZipMember(raw + b"/" + name.encode(), b"x", flags=0) for name in PHOTOGRAPHS]
    listing = list_archive(io.BytesIO(build_zip(*members, ZipMember(raw + b"/notes.txt", b"x", flags=0))))
    assert [file.name for file in listing.files] == list(PHOTOGRAPHS)
    assert len(listing.left_out) == 1 and listing.left_out[0].isprintable() and listing.folder.isprintable()


def test_photographs_are_not_guessed_at() -> None:
    raw = "images/\u6811.jpg".encode("gbk")
    with pytest.raises(IntakeError) as refusal:
        list_archive(io.BytesIO(build_zip(ZipMember(raw, b"x", flags=0), ZipMember("images/b.jpg", b"x"))))
    assert refusal.value.faults[0].code == "name-not-text"


@pytest.mark.parametrize("encoding", ["gbk", "cp932"])
def test_unicode_names_beside_others_are_taken(encoding: str) -> None:
    name = "images/\u6728.jpg"
    raw = name.encode(encoding)
    field = _unicode_field(raw, name)
    both = ZipMember(raw, b"x", flags=0, local_extra=field, central_extra=field)
    listed = ZipMember(raw, b"x", flags=0, central_extra=field)
    for member in (both, listed):
        assert [file.name for file in list_archive(io.BytesIO(build_zip(member))).files] == [name]


def test_unicode_names_that_belong_to_other_names_are_refused() -> None:
    raw = "images/\u6728.jpg".encode("gbk")
    wrong = _unicode_field(b"images/x.jpg", "images/y.jpg")
    plain = _unicode_field(b"images/a.jpg", "images/y.jpg")
    right, other = _unicode_field(raw, "images/y.jpg"), _unicode_field(raw, "images/z.jpg")
    for member in (
        ZipMember(raw, b"x", flags=0, local_extra=wrong, central_extra=wrong),
        ZipMember("images/a.jpg", b"x", local_extra=plain, central_extra=plain),
        ZipMember(raw, b"x", flags=0, local_extra=other, central_extra=right),
    ):
        with pytest.raises(IntakeError) as refusal:
            list_archive(io.BytesIO(build_zip(member)))
        assert refusal.value.faults[0].code == "archive-second-name"

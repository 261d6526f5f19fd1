"""Archives: the good ones come out whole, each kind of bad one is refused for its own reason."""

import io
import os
import shutil
import stat
import struct
import subprocess
import tarfile
import time
import zipfile
import zlib
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from octasplat.service.intake.archive import ArchiveFile, list_archive, unpack_archive
from octasplat.service.intake.faults import IntakeError
from octasplat.workers.storage.local import LocalStorage
from octasplat.workers.storage.protocol import Blob
from tests.support.archive_intake import LIMITS, MODEL, PHOTO, good, refusal, take
from tests.support.zip_builder import ZipMember, build_zip, deflated


def written_by_zipfile(stream: bool, **files: bytes) -> bytes:
    class Pipe(io.RawIOBase):
        """Cannot seek, so that zipfile writes descriptors."""

        def __init__(self) -> None:
            self.data = bytearray()

        def writable(self) -> bool:
            return True

        def write(self, data: object) -> int:
            self.data += bytes(data)  # type: ignore[call-overload]
            return len(bytes(data))  # type: ignore[call-overload]

    target = Pipe() if stream else io.BytesIO()
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:  # type: ignore[call-overload]
        archive.mkdir("images") if hasattr(archive, "mkdir") and not stream else None
        for name, data in files.items():
            with archive.open(name, "w", force_zip64=stream) as handle:
                handle.write(data)
    return bytes(target.data) if isinstance(target, Pipe) else target.getvalue()


@pytest.mark.parametrize("stream", [False, True])
def test_archive_by_zipfile_is_accepted(local_storage: LocalStorage, stream: bool) -> None:
    files = {
        "images/a.jpg": PHOTO,
        "images/ä/ü.jpg": b"\xff\xd8\xff" + os.urandom(3_000_000),
        "images/empty.png": b"",
        "masks/a.jpg.png": b"mask",
        "sparse/0/points3D.bin": MODEL,
    }
    assert take(written_by_zipfile(stream, **files), local_storage) == files


def test_archive_in_one_folder_with_clutter_is_accepted(local_storage: LocalStorage) -> None:
    data = build_zip(
        ZipMember("fox/", mode=0o40755),
        good("fox/images/a.jpg"),
        ZipMember("fox/images/.DS_Store", b"x"),
        ZipMember("__MACOSX/fox/images/._a.jpg", b"x"),
        ZipMember("fox/README.md", b"x"),
        ZipMember("fox/sparse/0/cameras.bin", MODEL),
    )
    listing = list_archive(io.BytesIO(data))
    assert listing.folder == "fox/"
    assert set(listing.left_out) == {
        "fox/images/.DS_Store", "__MACOSX/fox/images/._a.jpg", "fox/README.md",
    }  # fmt: skip
    assert set(take(data, local_storage)) == {"images/a.jpg", "sparse/0/cameras.bin"}


def test_descriptors_with_and_without_signature(local_storage: LocalStorage) -> None:
    packed = deflated(PHOTO)
    plain = struct.pack("<3I", zlib.crc32(PHOTO), len(packed), len(PHOTO))
    for descriptor in (plain, b"PK\x07\x08" + plain):
        member = replace(good(), flags=0x808, descriptor=descriptor, local={"crc": 0, "packed": 0, "size": 0})
        assert take(build_zip(member, good("images/b.jpg")), local_storage)["images/a.jpg"] == PHOTO


def test_archive_comment_is_accepted(local_storage: LocalStorage) -> None:
    assert take(build_zip(good(), comment=b"0123456789abcdef" * 2), local_storage) == {"images/a.jpg": PHOTO}


NAMES = {
    "../evil.jpg": "name-traversal",
    "images/../../evil.jpg": "name-traversal",
    "images/./a.jpg": "name-traversal",
    "/etc/passwd": "name-absolute",
    "images/C:\\evil.jpg": "name-backslash",
    "C:/evil.jpg": "name-drive",
    "c:evil.jpg": "name-drive",
    "\\\\server\\share\\a.jpg": "name-unc",
    "//server/share/a.jpg": "name-unc",
    "images/x\\a.jpg": "name-backslash",
    "images/a\0.jpg": "name-nul",
    "images/a\n.jpg": "name-control",
    "images/a\u202eexe.jpg": "name-control",
    "images/a\u200b.jpg": "name-control",
    "images/CON/a.jpg": "name-reserved",
    "images/con.jpg": "name-reserved",
    "images/Lpt1.tar.jpg": "name-reserved",
    "images/aux /a.jpg": "name-trailing",
    "images/NUL/a.jpg": "name-reserved",
    "images/COM\u00b9.jpg": "name-reserved",
    "images/a.jpg./a.jpg": "name-trailing",
    "images/a.jpg /a.jpg": "name-trailing",
    "images/ a.jpg": "name-trailing",
    "images/x./a.jpg": "name-trailing",
    "images//a.jpg": "name-empty-part",
    "images/a:stream.jpg": "name-character",
    "images/a?.jpg": "name-character",
    "images/" + "a" * 300 + ".jpg": "name-too-long",
    "images/" + "a/" * 40 + "a.jpg": "name-too-deep",
    "images/" + "a" * 50_000 + ".jpg": "name-too-long",
    "": "name-empty",
    "/": "name-empty",
    "images/\ud800.jpg": "name-not-text",
}


@pytest.mark.parametrize(("name", "code"), NAMES.items(), ids=[ascii(name)[:40] for name in NAMES])
def test_archive_hostile_name_is_refused(local_storage: LocalStorage, name: str, code: str) -> None:
    assert (
        refusal(build_zip(good(), ZipMember(name, b"" if name == "/" else PHOTO, mode=0)), local_storage)
        == code
    )
    assert list(local_storage.list_blobs()) == []


TWINS = {
    ("images/a.jpg", "images/a.jpg"): "name-duplicate",
    ("images/a.jpg", "images/A.JPG"): "name-twin",
    ("images/\u00e4.jpg", "images/a\u0308.jpg"): "name-twin",
    ("images/straße.jpg", "images/STRASSE.jpg"): "name-twin",
    ("images/x/a.jpg", "images/X/b.jpg"): "name-twin",
    ("images/a.jpg", "images/a.jpg/b.jpg"): "name-conflict",
    ("images/x.jpg/b.jpg", "images/X.jpg"): "name-conflict",
}


@pytest.mark.parametrize(("pair", "code"), TWINS.items())
def test_archive_names_differing_by_case_are_refused(
    local_storage: LocalStorage, pair: tuple[str, str], code: str
) -> None:
    assert refusal(build_zip(*(good(name) for name in pair)), local_storage) == code


def linked_kinds() -> dict[str, tuple[int, str]]:
    return {
        "link": (stat.S_IFLNK | 0o777, "archive-link"),
        "fifo": (stat.S_IFIFO, "archive-special-file"),
        "character": (stat.S_IFCHR, "archive-special-file"),
        "block": (stat.S_IFBLK, "archive-special-file"),
        "socket": (stat.S_IFSOCK, "archive-special-file"),
        "folder without slash": (stat.S_IFDIR, "archive-special-file"),
    }


@pytest.mark.parametrize(("mode", "code"), linked_kinds().values(), ids=linked_kinds())
def test_archive_special_file_is_refused(local_storage: LocalStorage, mode: int, code: str) -> None:
    member = ZipMember("images/b.jpg", b"/etc/passwd", mode=mode)
    assert refusal(build_zip(good(), member), local_storage) == code


def test_archive_other_format_is_named(local_storage: LocalStorage) -> None:
    target = io.BytesIO()
    with tarfile.open(fileobj=target, mode="w") as archive:
        link = tarfile.TarInfo("images/a.jpg")
        link.type = tarfile.SYMTYPE
        link.linkname = "/etc/passwd"
        archive.addfile(link)
    assert refusal(target.getvalue(), local_storage) == "archive-kind"
    for head in (b"\x1f\x8b\x08\0", b"7z\xbc\xaf\x27\x1c", b"Rar!\x1a\x07\0", b"\xfd7zXZ\0", b"BZh9"):
        assert refusal(head + bytes(600), local_storage) == "archive-kind"


def test_archive_inconsistent_content_is_refused(local_storage: LocalStorage) -> None:
    zeros = bytes(600_000)
    cases = {
        "archive-bomb": ZipMember("images/a.jpg", PHOTO, packed=deflated(PHOTO + zeros)),
        "archive-checksum": ZipMember("images/a.jpg", PHOTO, packed=deflated(PHOTO[::-1])),
        "archive-damaged": ZipMember("images/a.jpg", PHOTO, packed=b"\xff" * 50),
        "archive-mismatch": ZipMember("images/a.jpg", PHOTO, packed=deflated(PHOTO[:-1])),
    }
    for code, member in cases.items():
        assert refusal(build_zip(member), local_storage) == code
    more = ZipMember("images/a.jpg", PHOTO, packed=deflated(PHOTO) + b"hidden")
    assert refusal(build_zip(more), local_storage) == "archive-mismatch"
    cut = ZipMember("images/a.jpg", PHOTO, packed=deflated(PHOTO)[:-4])
    assert refusal(build_zip(cut), local_storage) == "archive-mismatch"
    assert list(local_storage.list_blobs()) == []


def test_archive_bomb_is_refused(local_storage: LocalStorage) -> None:
    flat = build_zip(ZipMember("images/a.bmp", bytes(50_000_000)))
    assert len(flat) < 60_000
    assert refusal(flat, local_storage) == "archive-ratio"
    many = build_zip(*(ZipMember(f"images/{i}.bmp", bytes(1_000_000)) for i in range(20)))
    small = replace(LIMITS, max_total_bytes=10_000_000)
    assert refusal(many, local_storage, small) == "archive-too-large"
    one = build_zip(ZipMember("images/a.jpg", os.urandom(2000)))
    assert refusal(one, local_storage, replace(LIMITS, max_file_bytes=1000)) == "archive-file-too-large"
    assert list(local_storage.list_blobs()) == []


def test_archive_too_many_entries_is_refused_early(local_storage: LocalStorage) -> None:
    entries = [ZipMember(f"images/{i}.jpg", b"", method=0) for i in range(200)]
    limits = replace(LIMITS, max_entries=199)
    assert refusal(build_zip(*entries), local_storage, limits) == "archive-too-many-entries"
    assert len(list_archive(io.BytesIO(build_zip(*entries))).files) == 200
    long_list = build_zip(good(), directory_extra=bytes(70_000))
    limits = replace(LIMITS, max_directory_bytes=60_000)
    assert refusal(long_list, local_storage, limits) == "archive-directory-too-long"


def test_archive_with_million_entries_is_refused_quickly(local_storage: LocalStorage) -> None:
    locator = struct.pack("<4sIQI", b"PK\6\7", 0, 4, 1)
    end = struct.pack("<4sQ2H2I4Q", b"PK\6\6", 44, 45, 45, 0, 0, 10**6, 10**6, 0, 4)
    data = b"PK\3\4" + end + locator + struct.pack("<4s4H2IH", b"PK\5\6", 0, 0, 65535, 65535, 0, 4, 0)
    began = time.perf_counter()
    assert refusal(data, local_storage) == "archive-too-many-entries"
    assert time.perf_counter() - began < 0.5


def test_archive_under_the_name_of_a_photograph_is_refused(local_storage: LocalStorage) -> None:
    inner = ZipMember("images/b.jpg", build_zip(good()), method=0)
    assert refusal(build_zip(good(), inner), local_storage) == "archive-nested"


LEFT_OUT = [
    "images/b.zip", "masks/x.tar.gz", "c.7z", "images/CON", "NUL/a.jpg", "images/a.jpg.", "images/a.jpg ",
    "images\\a.jpg", "a\u202egpj.exe", "images/a.jpg:stream", "Images/b.jpg", "images/A.JPG.txt",
]  # fmt: skip


@pytest.mark.parametrize("name", LEFT_OUT, ids=ascii)
def test_archive_file_that_is_no_part_of_a_scene_is_left_out_whatever_its_name(
    local_storage: LocalStorage, name: str
) -> None:
    data = build_zip(good(), ZipMember(name, build_zip(good()), method=0, mode=0))
    assert take(data, local_storage) == {"images/a.jpg": PHOTO}
    listing = list_archive(io.BytesIO(data))
    assert listing.left_out == (name,) and len(listing.notes) == 1


def test_gzip_like_model_is_accepted(local_storage: LocalStorage) -> None:
    data = build_zip(good(), ZipMember("sparse/0/points3D.bin", MODEL))
    assert take(data, local_storage)["sparse/0/points3D.bin"] == MODEL


def test_quota_refusal_stops_reading(local_storage: LocalStorage) -> None:
    data = build_zip(good(), good("images/b.jpg"))
    listing = list_archive(io.BytesIO(data))
    with pytest.raises(RuntimeError, match="quota"):
        unpack_archive(io.BytesIO(data), listing, lambda _: local_storage.open_writer(), _no_quota)


def _no_quota(_file: ArchiveFile, _blob: Blob) -> None:
    raise RuntimeError("quota")


SAMPLE = build_zip(
    good(),
    replace(
        good("images/b.jpg"),
        flags=0x808,
        descriptor=struct.pack("<3I", zlib.crc32(PHOTO), len(deflated(PHOTO)), len(PHOTO)),
    ),
    ZipMember("sparse/0/cameras.txt", b"# cameras\n", method=0),
    comment=b"hello",
)


@settings(max_examples=400, deadline=None)
@given(
    st.lists(st.tuples(st.integers(0, len(SAMPLE) - 1), st.integers(0, 255)), min_size=1, max_size=6),
    st.integers(0, 3 * len(SAMPLE)),
)
def test_damage_is_refused_or_harmless(changes: list[tuple[int, int]], cut: int) -> None:
    data = bytearray(SAMPLE)
    for position, value in changes:
        data[position] = value
    file = io.BytesIO(bytes(data[:cut]))
    contents: dict[str, Memory] = {}

    def begin(entry: ArchiveFile) -> Memory:
        contents[entry.record.name] = Memory()
        return contents[entry.record.name]

    try:
        listing = list_archive(file)
        unpack_archive(file, listing, begin, lambda _file, _blob: None)
    except IntakeError as error:
        assert error.code.split("-")[0] in ("archive", "name")
        return
    # What is taken means the same to another reader.
    with zipfile.ZipFile(file) as archive:
        for name, memory in contents.items():
            assert archive.read(name) == memory.data


class Memory:
    """A writer into memory."""

    def __init__(self) -> None:
        self.data = b""

    def write(self, data: bytes | memoryview) -> None:
        self.data += data

    def commit(self) -> Blob:
        return Blob("0" * 64, len(self.data))

    def abort(self) -> None: ...

    def __enter__(self) -> "Memory":
        return self

    def __exit__(self, *exception: object) -> None: ...


@pytest.mark.parametrize("streamed", [False, True])
def test_archives_of_info_zip(local_storage: LocalStorage, tmp_path: Path, streamed: bool) -> None:
    program = shutil.which("zip")
    if program is None:
        pytest.skip("the program zip is not installed")
    (tmp_path / "fox" / "images").mkdir(parents=True)
    (tmp_path / "fox" / "images" / "ä b.jpg").write_bytes(PHOTO)
    (tmp_path / "fox" / "images" / "link.jpg").symlink_to("ä b.jpg")
    archive = tmp_path / "out.zip"

    def pack(*flags: str) -> bytes:
        archive.unlink(missing_ok=True)
        command = [program, "-q", "-r", *flags, "-" if streamed else str(archive), "fox"]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, check=True, timeout=60)
        return done.stdout if streamed else archive.read_bytes()

    assert take(pack(), local_storage) == {"images/ä b.jpg": PHOTO, "images/link.jpg": PHOTO}
    if not streamed:  # it cannot stream links
        assert refusal(pack("-y"), local_storage) == "archive-link"

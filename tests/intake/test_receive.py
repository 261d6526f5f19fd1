"""Bodies of any length come in with constant memory; what is refused leaves nothing behind."""

import asyncio
import hashlib
import subprocess
import sys
import time
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from octasplat.service.intake.faults import IntakeError
from octasplat.service.intake.receive import (
    PIECE_BYTES,
    UploadLimits,
    format_digest,
    parse_digest,
    receive_archive,
    receive_body,
    receive_file,
)
from octasplat.service.intake.spool import SpoolSpace
from octasplat.workers.storage import ContentTooLargeError, DigestMismatchError, StorageFullError
from octasplat.workers.storage.local import LocalStorage
from tests.support.model_builder import ColmapModelBuilder, photograph, photographs
from tests.support.zip_builder import ZipMember, build_zip


async def body(data: bytes, piece: int = 1000) -> AsyncIterator[bytes]:
    for start in range(0, len(data), piece):
        yield data[start : start + piece]


def sha(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


@given(st.binary(min_size=32, max_size=32))
def test_repr_digest_round_trips(digest: bytes) -> None:
    header = format_digest(digest.hex())
    assert parse_digest(header) == digest.hex()
    assert parse_digest(f"sha-512=:AAAA:, {header};x=1") == digest.hex()


@pytest.mark.parametrize(
    "header",
    [
        "",
        "sha-256",
        "sha-256=abc",
        "sha-256=:AAAA:",
        "sha-256=:????:",
        "md5=:AAAA:",
        "xsha-256=:" + "A" * 44 + ":",
    ],
)
def test_repr_digest_malformed_is_refused(header: str) -> None:
    with pytest.raises(IntakeError) as caught:
        parse_digest(header)
    assert caught.value.code == "digest-malformed"
    assert parse_digest(None) is None


def test_receive_file_stores_content(local_storage: LocalStorage) -> None:
    data = photograph()
    found = asyncio.run(
        receive_file(local_storage, "images/a.png", body(data, 7), sha256=sha(data), size_bytes=len(data))
    )
    assert found.blob.sha256 == sha(data)
    assert found.facts == {"kind": "PNG", "width_px": 32, "height_px": 24}
    model = ColmapModelBuilder().files()["sparse/0/points3D.bin"]
    assert asyncio.run(receive_file(local_storage, "sparse/0/points3D.bin", body(model))).facts == {}


def test_receive_file_invalid_content_is_refused(local_storage: LocalStorage) -> None:
    data = photograph()
    with pytest.raises(IntakeError) as caught:
        asyncio.run(receive_file(local_storage, "images/a.png", body(b"#!/bin/sh\n" * 9)))
    assert caught.value.code == "image-kind"
    with pytest.raises(DigestMismatchError):
        asyncio.run(receive_file(local_storage, "images/a.png", body(data), sha256="0" * 64))
    with pytest.raises(ContentTooLargeError):
        asyncio.run(receive_file(local_storage, "images/a.png", body(data), max_bytes=20))
    assert local_storage.remove_stale_uploads(-60) == 0


def test_receive_stalled_upload_is_refused(local_storage: LocalStorage) -> None:
    async def slow() -> AsyncIterator[bytes]:
        yield b"first"
        await asyncio.sleep(60)

    began = time.perf_counter()
    with pytest.raises(IntakeError) as caught:
        asyncio.run(receive_body(slow(), local_storage.open_writer(), UploadLimits(idle_seconds=0.2)))
    assert caught.value.code == "upload-stalled" and time.perf_counter() - began < 5
    assert local_storage.remove_stale_uploads(-60) == 0


def test_receive_trickling_upload_is_ended(local_storage: LocalStorage) -> None:
    async def trickle() -> AsyncIterator[bytes]:
        while True:
            await asyncio.sleep(0.05)
            yield b"x"

    limits = UploadLimits(idle_seconds=0.5, min_bytes_per_second=100)
    began = time.perf_counter()
    with pytest.raises(IntakeError, match="100 are needed each second") as caught:
        asyncio.run(receive_body(trickle(), local_storage.open_writer(), limits))
    assert caught.value.code == "upload-too-slow" and time.perf_counter() - began < 5
    assert local_storage.remove_stale_uploads(-60) == 0


def test_receive_slow_writing_does_not_count(local_storage: LocalStorage) -> None:
    async def quick() -> AsyncIterator[bytes]:
        for _ in range(4):
            yield bytes(1 << 20)

    writer = local_storage.open_writer()
    write = writer.write

    def write_slowly(data: bytes | memoryview) -> None:
        time.sleep(0.3)
        write(data)

    writer.write = write_slowly  # type: ignore[method-assign]
    limits = UploadLimits(idle_seconds=0.5, min_bytes_per_second=10 << 20)
    assert asyncio.run(receive_body(quick(), writer, limits)).size_bytes == 4 << 20


async def test_receive_disconnected_client_stores_nothing(local_storage: LocalStorage) -> None:
    arrived = asyncio.Event()

    async def endless() -> AsyncIterator[bytes]:
        while True:
            yield bytes(1 << 20)
            arrived.set()
            await asyncio.sleep(0.001)

    task = asyncio.create_task(receive_body(endless(), local_storage.open_writer(), UploadLimits()))
    await arrived.wait()
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert local_storage.remove_stale_uploads(-60) == 0
    assert list(local_storage.list_blobs()) == []


def scene_archive() -> bytes:
    files = {**photographs(), **ColmapModelBuilder().files()}
    return build_zip(
        *(ZipMember(f"fox/{name}", data) for name, data in files.items()), ZipMember("fox/notes.txt", b"x")
    )


def test_receive_archive_stores_contents(local_storage: LocalStorage, tmp_path: Path) -> None:
    data = scene_archive()
    found = asyncio.run(
        receive_archive(local_storage, body(data), SpoolSpace(tmp_path / "spool"), sha256=sha(data))
    )
    assert {file.path for file in found.files} == {*photographs(), *ColmapModelBuilder().files()}
    assert found.left_out == ("fox/notes.txt",) and found.size_bytes == len(data)
    facts = {file.path: file.facts for file in found.files}
    assert facts["images/v0.png"] == {"kind": "PNG", "width_px": 32, "height_px": 24}
    assert list((tmp_path / "spool").iterdir()) == []


def test_receive_archive_invalid_is_refused(local_storage: LocalStorage, tmp_path: Path) -> None:
    bad_image = build_zip(ZipMember("images/a.png", b"not an image"))
    for data, code in ((b"PK\3\4 nonsense", "archive-damaged"), (bad_image, "image-kind")):
        with pytest.raises(IntakeError) as caught:
            asyncio.run(receive_archive(local_storage, body(data), SpoolSpace(tmp_path / "spool")))
        assert caught.value.code == code
    data = scene_archive()
    with pytest.raises(DigestMismatchError):
        asyncio.run(
            receive_archive(local_storage, body(data), SpoolSpace(tmp_path / "spool"), sha256="0" * 64)
        )
    with pytest.raises(ContentTooLargeError):
        limits = UploadLimits(max_archive_bytes=100)
        asyncio.run(receive_archive(local_storage, body(data), SpoolSpace(tmp_path / "spool"), limits=limits))
    blank = build_zip(ZipMember("images/a.bmp", bytes(900_000)))
    with pytest.raises(IntakeError, match="quota"):
        asyncio.run(
            receive_archive(local_storage, body(blank), SpoolSpace(tmp_path / "spool"), max_bytes=len(blank))
        )
    assert list((tmp_path / "spool").iterdir()) == []


def test_receive_without_disk_space_is_refused(tmp_path: Path) -> None:
    storage = LocalStorage(tmp_path / "store", floor_bytes=1 << 60)
    try:
        with pytest.raises(StorageFullError, match="kept free"):
            asyncio.run(receive_file(storage, "images/a.png", body(photograph())))
        with pytest.raises(StorageFullError, match="kept free"):
            asyncio.run(receive_archive(storage, body(scene_archive()), SpoolSpace(tmp_path / "spool")))
    finally:
        storage.close()


MEMORY = """
import asyncio, resource, sys
from pathlib import Path
from octasplat.service.intake.receive import UploadLimits, receive_body
from octasplat.workers.storage.local import LocalStorage

async def body(megabytes):
    piece = bytes(65536)
    for _ in range(16 * megabytes):
        yield piece

storage = LocalStorage(Path(sys.argv[1]), floor_bytes=0)
asyncio.run(receive_body(body(4), storage.open_writer(), UploadLimits()))
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
blob = asyncio.run(receive_body(body(int(sys.argv[2])), storage.open_writer(), UploadLimits()))
after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
print(blob.size_bytes, after - before)
"""


@pytest.mark.exhaustive
def test_memory_does_not_grow_with_the_upload(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", MEMORY, str(tmp_path), "300"],
        capture_output=True, text=True, timeout=120, check=True,
    )  # fmt: skip
    size, grown_kib = map(int, done.stdout.split())
    assert size == 300 << 20
    assert grown_kib < 16 << 10


async def test_receive_archive_counts_what_arrived(local_storage: LocalStorage, tmp_path: Path) -> None:
    data = scene_archive()
    spool = SpoolSpace(tmp_path / "spool", max_bytes=3 * len(data))
    arrived = asyncio.Event()

    async def trickle() -> AsyncIterator[bytes]:
        yield data[:1]
        arrived.set()
        await asyncio.sleep(600)

    announced = receive_archive(local_storage, trickle(), spool, owner="alice", size_bytes=3 * len(data))
    trickling = asyncio.create_task(announced)
    await arrived.wait()
    for owner in ("alice", "bob"):
        found = await receive_archive(local_storage, body(data), spool, owner=owner, size_bytes=len(data))
        assert found.size_bytes == len(data)
    trickling.cancel()


async def test_receive_archive_leaves_space_to_other_owners(
    local_storage: LocalStorage, tmp_path: Path
) -> None:
    data = scene_archive() + bytes(2 * PIECE_BYTES)
    spool = SpoolSpace(tmp_path / "spool", max_bytes=3 * len(data), owner_share=0.4)
    arrived = asyncio.Event()

    async def most_of_it() -> AsyncIterator[bytes]:
        yield data[:PIECE_BYTES]
        arrived.set()
        await asyncio.sleep(600)

    sending = asyncio.create_task(receive_archive(local_storage, most_of_it(), spool, owner="alice"))
    await arrived.wait()
    with pytest.raises(StorageFullError, match="Your archives"):
        await receive_archive(local_storage, body(data), spool, owner="alice", size_bytes=len(data))
    with pytest.raises(StorageFullError, match="Your archives"):
        await receive_archive(local_storage, body(data, PIECE_BYTES), spool, owner="alice")
    with pytest.raises(IntakeError):  # it arrived in full, with bytes after its end
        await receive_archive(local_storage, body(data), spool, owner="bob", size_bytes=len(data))
    sending.cancel()

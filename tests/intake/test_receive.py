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
from model_builder import Model, photograph, photographs
from zip_builder import Member, build

from octasplat.service.intake.faults import IntakeRefused
from octasplat.service.intake.receive import (
    UploadLimits,
    format_digest,
    parse_digest,
    receive,
    receive_archive,
    receive_file,
)
from octasplat.service.intake.spool import Spool
from octasplat.workers.store import DigestMismatch, StorageFull, TooLarge
from octasplat.workers.store.local import LocalStorage


async def body(data: bytes, piece: int = 1000) -> AsyncIterator[bytes]:
    for start in range(0, len(data), piece):
        yield data[start : start + piece]


def sha(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


@given(st.binary(min_size=32, max_size=32))
def test_digests_go_round(digest: bytes) -> None:
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
def test_malformed_digests(header: str) -> None:
    with pytest.raises(IntakeRefused) as caught:
        parse_digest(header)
    assert caught.value.code == "digest-malformed"
    assert parse_digest(None) is None


def test_a_file_is_taken_in(local_storage: LocalStorage) -> None:
    data = photograph()
    found = asyncio.run(
        receive_file(local_storage, "images/a.png", body(data, 7), sha256=sha(data), size_bytes=len(data))
    )
    assert found.blob.sha256 == sha(data)
    assert found.facts == {"kind": "PNG", "width_px": 32, "height_px": 24}
    model = Model().files()["sparse/0/points3D.bin"]
    assert asyncio.run(receive_file(local_storage, "sparse/0/points3D.bin", body(model))).facts == {}


def test_refused_files(local_storage: LocalStorage) -> None:
    data = photograph()
    with pytest.raises(IntakeRefused) as caught:
        asyncio.run(receive_file(local_storage, "images/a.png", body(b"#!/bin/sh\n" * 9)))
    assert caught.value.code == "image-kind"
    with pytest.raises(DigestMismatch):
        asyncio.run(receive_file(local_storage, "images/a.png", body(data), sha256="0" * 64))
    with pytest.raises(TooLarge):
        asyncio.run(receive_file(local_storage, "images/a.png", body(data), max_bytes=20))
    assert local_storage.sweep(-60) == 0


def test_an_upload_that_stalls_is_given_up(local_storage: LocalStorage) -> None:
    async def slow() -> AsyncIterator[bytes]:
        yield b"first"
        await asyncio.sleep(60)

    began = time.perf_counter()
    with pytest.raises(IntakeRefused) as caught:
        asyncio.run(receive(slow(), local_storage.begin(), idle_seconds=0.2))
    assert caught.value.code == "upload-stalled" and time.perf_counter() - began < 5
    assert local_storage.sweep(-60) == 0


def test_a_client_that_leaves_leaves_nothing(local_storage: LocalStorage) -> None:
    async def leave() -> None:
        arrived = asyncio.Event()

        async def endless() -> AsyncIterator[bytes]:
            while True:
                yield bytes(1 << 20)
                arrived.set()
                await asyncio.sleep(0.001)

        task = asyncio.create_task(receive(endless(), local_storage.begin()))
        await arrived.wait()
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task

    asyncio.run(leave())
    assert local_storage.sweep(-60) == 0
    assert list(local_storage.blobs()) == []


def scene_archive() -> bytes:
    files = {**photographs(), **Model().files()}
    return build(
        *(Member(f"fox/{name}", data) for name, data in files.items()), Member("fox/notes.txt", b"x")
    )


def test_an_archive_is_taken_in(local_storage: LocalStorage, tmp_path: Path) -> None:
    data = scene_archive()
    found = asyncio.run(
        receive_archive(local_storage, body(data), Spool(tmp_path / "spool"), sha256=sha(data))
    )
    assert {file.path for file in found.files} == {*photographs(), *Model().files()}
    assert found.left_out == ("fox/notes.txt",) and found.size_bytes == len(data)
    facts = {file.path: file.facts for file in found.files}
    assert facts["images/v0.png"] == {"kind": "PNG", "width_px": 32, "height_px": 24}
    assert list((tmp_path / "spool").iterdir()) == []


def test_refused_archives(local_storage: LocalStorage, tmp_path: Path) -> None:
    bad_image = build(Member("images/a.png", b"not an image"))
    for data, code in ((b"PK\3\4 nonsense", "archive-damaged"), (bad_image, "image-kind")):
        with pytest.raises(IntakeRefused) as caught:
            asyncio.run(receive_archive(local_storage, body(data), Spool(tmp_path / "spool")))
        assert caught.value.code == code
    data = scene_archive()
    with pytest.raises(DigestMismatch):
        asyncio.run(receive_archive(local_storage, body(data), Spool(tmp_path / "spool"), sha256="0" * 64))
    with pytest.raises(TooLarge):
        limits = UploadLimits(max_archive_bytes=100)
        asyncio.run(receive_archive(local_storage, body(data), Spool(tmp_path / "spool"), limits=limits))
    blank = build(Member("images/a.bmp", bytes(900_000)))
    with pytest.raises(IntakeRefused, match="quota"):
        asyncio.run(
            receive_archive(local_storage, body(blank), Spool(tmp_path / "spool"), max_bytes=len(blank))
        )
    assert list((tmp_path / "spool").iterdir()) == []


def test_no_room(tmp_path: Path) -> None:
    storage = LocalStorage(tmp_path / "store", floor_bytes=1 << 60)
    try:
        with pytest.raises(StorageFull, match="kept free"):
            asyncio.run(receive_file(storage, "images/a.png", body(photograph())))
        with pytest.raises(StorageFull, match="kept free"):
            asyncio.run(receive_archive(storage, body(scene_archive()), Spool(tmp_path / "spool")))
    finally:
        storage.close()


MEMORY = """
import asyncio, resource, sys
from pathlib import Path
from octasplat.service.intake.spool import Spool
from octasplat.service.intake.receive import receive
from octasplat.workers.store.local import LocalStorage

async def body(megabytes):
    piece = bytes(65536)
    for _ in range(16 * megabytes):
        yield piece

storage = LocalStorage(Path(sys.argv[1]), floor_bytes=0)
asyncio.run(receive(body(4), storage.begin()))
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
blob = asyncio.run(receive(body(int(sys.argv[2])), storage.begin()))
after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
print(blob.size_bytes, after - before)
"""


def test_memory_does_not_grow_with_the_upload(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", MEMORY, str(tmp_path), "300"],
        capture_output=True, text=True, timeout=120, check=True,
    )  # fmt: skip
    size, grown_kib = map(int, done.stdout.split())
    assert size == 300 << 20
    assert grown_kib < 16 << 10

"""What only a store in a folder can get wrong: full disks, links put in its way, kills."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from octasplat.engine.core.errors import ConfigError
from octasplat.workers.storage import StorageFullError, StorageUnavailableError, open_storage
from octasplat.workers.storage.local import LocalStorage
from octasplat.workers.storage.s3 import S3Storage
from tests.support.small_disk import small_disk


def put(storage: LocalStorage, data: bytes) -> str:
    with storage.open_writer() as writer:
        writer.write(data)
        return writer.commit().sha256


def test_local_storage_keeps_reserved_space(tmp_path: Path) -> None:
    facts = os.statvfs(tmp_path)
    free = facts.f_bavail * facts.f_frsize
    storage = LocalStorage(tmp_path / "store", floor_bytes=free - (256 << 20))
    try:
        assert storage.free_bytes() == pytest.approx(256 << 20, abs=200 << 20)
        with pytest.raises(StorageFullError, match="kept free"):
            storage.open_writer(size_bytes=1 << 30)
        storage.floor_bytes = free * 2
        assert storage.free_bytes() < 0
        with pytest.raises(StorageFullError, match="delete datasets or jobs"):
            storage.open_writer()
        with pytest.raises(StorageFullError):
            storage.publish_document("a", b"document")
    finally:
        storage.close()


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    with small_disk(tmp_path / "disk", 8) as folder:
        yield folder


def test_local_storage_full_disk_raises_and_allows_delete(disk: Path) -> None:
    storage = LocalStorage(disk / "store", floor_bytes=0)
    try:
        first = put(storage, bytes(3 << 20))
        with storage.open_writer() as writer, pytest.raises(StorageFullError):
            for _ in range(100):
                writer.write(bytes(1 << 20))
        assert storage.remove_stale_uploads(-60) == 0
        assert [entry.blob.sha256 for entry in storage.list_blobs()] == [first]
        with pytest.raises(StorageFullError, match="full"):
            storage.materialise(put(storage, b"1" * (3 << 20)), disk / "copy", writable=True)
        assert not (disk / "copy").exists()
        storage.delete(first)
        put(storage, bytes(4 << 20))
    finally:
        storage.close()


def test_links_are_not_followed(local_storage: LocalStorage, tmp_path: Path) -> None:
    outside = tmp_path / "outside"
    outside.mkdir()
    sha256 = put(local_storage, b"content")
    blob = local_storage.local_path(sha256)
    assert blob is not None
    blob.unlink()
    (outside / sha256).write_bytes(b"secret")
    blob.symlink_to(outside / sha256)
    with pytest.raises(StorageUnavailableError):
        local_storage.open(sha256)
    assert list(local_storage.list_blobs()) == []
    blob.unlink()
    blob.parent.rmdir()
    blob.parent.symlink_to(outside)
    with pytest.raises(StorageUnavailableError):
        put(local_storage, b"content")
    assert (outside / sha256).read_bytes() == b"secret"
    (local_storage.root / "documents" / "results").symlink_to(outside)
    with pytest.raises(StorageUnavailableError):
        local_storage.publish_document("results/a", b"x")
    assert not (outside / "a").exists()


def test_local_storage_survives_folder_move(local_storage: LocalStorage, tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    local_storage.root.rename(elsewhere)
    local_storage.root.symlink_to(tmp_path)  # somebody puts a link in its place
    sha256 = put(local_storage, b"content")
    assert (elsewhere / "blobs" / sha256[:2] / sha256).read_bytes() == b"content"


def test_local_storage_damaged_blob_is_detected_and_replaced(
    local_storage: LocalStorage, tmp_path: Path
) -> None:
    sha256 = put(local_storage, b"content")
    blob = local_storage.local_path(sha256)
    assert blob is not None and blob.stat().st_mode & 0o222 == 0
    blob.chmod(0o600)
    blob.write_bytes(b"CONTENT")
    with pytest.raises(Exception, match="damaged"):
        local_storage.materialise(sha256, tmp_path / "copy", writable=True)
    assert not (tmp_path / "copy").exists()
    put(local_storage, b"content")
    local_storage.materialise(sha256, tmp_path / "copy", writable=True)


WRITER = """
import sys
from pathlib import Path
from octasplat.workers.storage.local import LocalStorage
storage = LocalStorage(Path(sys.argv[1]), floor_bytes=0)
number = 0
while True:
    with storage.open_writer() as writer:
        for _ in range(8):
            writer.write(number.to_bytes(8, "big") * 8192)
        blob = writer.commit()
    storage.publish_document(f"done/{number}", blob.sha256.encode())
    print(number, flush=True)
    number += 1
"""


def test_local_storage_killed_writer_leaves_no_partial_blob(tmp_path: Path) -> None:
    storage = LocalStorage(tmp_path / "store", floor_bytes=0)
    try:
        for round_number in range(3):
            child = subprocess.Popen(
                [sys.executable, "-c", WRITER, str(tmp_path / "store")], stdout=subprocess.PIPE, text=True
            )
            assert child.stdout is not None
            child.stdout.readline()
            time.sleep(0.05 + 0.03 * round_number)
            child.send_signal(signal.SIGKILL)
            child.wait()
            child.stdout.close()
        published = list(storage.list_documents("done/"))
        assert published
        for name in published:
            document = storage.read_document(name)
            assert document is not None
            storage.materialise(document.decode(), tmp_path / "copy", writable=True)  # verifies the digest
            (tmp_path / "copy").unlink()
        storage.remove_stale_uploads(-60)
        assert storage.remove_stale_uploads(-60) == 0
    finally:
        storage.close()


def test_open_storage_accepts_addresses(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    for address in (tmp_path / "a", str(tmp_path / "b"), f"file://{tmp_path}/c"):
        storage = open_storage(address, floor_bytes=5)
        assert isinstance(storage, LocalStorage) and storage.floor_bytes == 5
        storage.close()
    bucket = open_storage("s3://bucket/some/prefix?endpoint_url=http://127.0.0.1:9")
    assert isinstance(bucket, S3Storage)
    assert (bucket.bucket, bucket.prefix) == ("bucket", "some/prefix/")
    bucket.close()
    for address in ("ftp://host/x", "s3:///x", "s3://key:secret@bucket/x"):
        with pytest.raises(ConfigError) as caught:
            open_storage(address)
        assert "secret" not in str(caught.value)


def test_s3_storage_unreachable_raises_unavailable(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.setenv(name, "test")
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    monkeypatch.setenv("AWS_MAX_ATTEMPTS", "1")
    storage = S3Storage("bucket", endpoint_url="http://127.0.0.1:9")
    with pytest.raises(StorageUnavailableError, match="cannot be reached"):
        storage.stat("0" * 64)
    storage.close()


def test_s3_storage_missing_bucket_raises_unavailable(s3_address: str) -> None:
    storage = S3Storage("nobody-s-bucket", endpoint_url=s3_address)
    with pytest.raises(StorageUnavailableError, match="NoSuchBucket"):
        storage.publish_document("a", b"x")
    storage.close()


def test_local_storage_unusable_root_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(StorageUnavailableError, match="file"):
        LocalStorage(tmp_path / "file" / "store")

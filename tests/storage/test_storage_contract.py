"""What every store keeps to, whatever it is made of."""

import hashlib
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from octasplat.engine.core.portable_names import FileNameError
from octasplat.workers.storage import (
    Blob,
    BlobNotFoundError,
    ContentTooLargeError,
    DigestMismatchError,
    Manifest,
    Storage,
    StorageError,
    TreeFile,
    fetch_tree,
    publish_manifest,
    read_manifest,
    store_tree,
)
from octasplat.workers.storage.s3 import S3Storage

MIB = 1 << 20


def digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def put(storage: Storage, data: bytes, piece: int = MIB) -> Blob:
    with storage.open_writer() as writer:
        for start in range(0, len(data), piece):
            writer.write(data[start : start + piece])
        return writer.commit()


def noise(size: int, seed: int = 0) -> bytes:
    return hashlib.shake_128(bytes([seed])).digest(size)


@pytest.mark.parametrize("size", [0, 1, 65_537, 17 * MIB + 3])
@pytest.mark.parametrize("announced", [False, True])
def test_storage_content_round_trips(storage: Storage, size: int, announced: bool) -> None:
    data = noise(size)
    with storage.open_writer(
        sha256=digest(data) if announced else None, size_bytes=size if announced else None
    ) as writer:
        for start in range(0, size, 999_983):
            writer.write(memoryview(data)[start : start + 999_983])
        blob = writer.commit()
    assert blob == Blob(digest(data), size)
    assert storage.stat(blob.sha256) == blob
    assert b"".join(storage.read(blob.sha256)) == data
    assert [entry.blob for entry in storage.list_blobs()] == [blob]
    assert storage.remove_stale_uploads(-60) == 0  # nothing is left of the upload


def test_storage_reads_ranges_and_seeks(storage: Storage) -> None:
    data = noise(3 * MIB)
    sha256 = put(storage, data).sha256
    assert b"".join(storage.read(sha256, 5, 5)) == b""
    assert b"".join(storage.read(sha256, 1_000_001, 2_500_007)) == data[1_000_001:2_500_007]
    assert b"".join(storage.read(sha256, 3 * MIB - 4, 9 * MIB)) == data[-4:]
    with storage.open(sha256) as handle:
        assert handle.seek(-10, 2) == 3 * MIB - 10
        assert handle.read() == data[-10:]
        handle.seek(12_345)
        assert handle.read(7) == data[12_345:12_352]
        assert handle.read(MIB) == data[12_352 : 12_352 + MIB]


@pytest.mark.parametrize("size", [10, 9 * MIB])
def test_storage_wrong_digest_stores_nothing(storage: Storage, size: int) -> None:
    data, other = noise(size), noise(size, 1)
    with storage.open_writer(sha256=digest(other)) as writer:
        writer.write(data)
        with pytest.raises(DigestMismatchError, match=digest(data)):
            writer.commit()
    assert list(storage.list_blobs()) == []
    assert storage.remove_stale_uploads(-60) == 0


def test_storage_wrong_length_is_refused(storage: Storage) -> None:
    with storage.open_writer(size_bytes=10) as writer:
        writer.write(b"123456789")
        with pytest.raises(DigestMismatchError, match="9 bytes came where 10"):
            writer.commit()
    with storage.open_writer(size_bytes=10) as writer, pytest.raises(ContentTooLargeError, match="10 bytes"):
        writer.write(b"12345678901")
    with storage.open_writer(max_bytes=10) as writer:
        writer.write(b"1234567890")
        with pytest.raises(ContentTooLargeError, match="10 bytes"):
            writer.write(b"1")
    with pytest.raises(ContentTooLargeError):
        storage.open_writer(size_bytes=11, max_bytes=10)
    assert list(storage.list_blobs()) == []


@pytest.mark.parametrize("size", [10, 9 * MIB])
def test_unfinished_content_is_not_seen(storage: Storage, size: int) -> None:
    data = noise(size)
    writer = storage.open_writer(sha256=digest(data))
    writer.write(data)
    assert list(storage.list_blobs()) == []
    with pytest.raises(BlobNotFoundError):
        storage.stat(digest(data))
    writer.abort()
    writer.abort()
    assert list(storage.list_blobs()) == []
    assert storage.remove_stale_uploads(-60) == 0
    with pytest.raises(ValueError, match="closed"):
        writer.write(b"more")


@pytest.mark.parametrize("announced", [False, True])
def test_sweep_removes_killed_uploads(storage: Storage, announced: bool) -> None:
    data = noise(9 * MIB)
    writer = storage.open_writer(sha256=digest(data) if announced else None, max_bytes=32 * MIB)
    writer.write(data)  # more than one part, and then the process is killed
    if not isinstance(storage, S3Storage):
        assert (
            storage.remove_stale_uploads(3600) == 0
        )  # the S3 server of the tests gives every upload the same old date
    assert storage.remove_stale_uploads(-60) == 1
    assert storage.remove_stale_uploads(-60) == 0


def test_storage_deduplicates_content(storage: Storage) -> None:
    first, second = put(storage, b"same"), put(storage, b"same")
    assert first == second
    assert len(list(storage.list_blobs())) == 1


def test_storage_delete_removes_blob(storage: Storage) -> None:
    sha256 = put(storage, b"short-lived").sha256
    assert storage.delete(sha256)
    assert not storage.delete(sha256)
    missing: list[Callable[[], object]] = [
        lambda: storage.stat(sha256),
        lambda: storage.open(sha256),
        lambda: storage.read(sha256),
        lambda: storage.local_path(sha256),
        lambda: storage.materialise(sha256, Path("never")),
    ]
    for call in missing:
        with pytest.raises(BlobNotFoundError, match=sha256):
            call()


@pytest.mark.parametrize("name", ["", "../../etc/passwd", "A" * 64, "0" * 63, "0" * 64 + "\n"])
def test_storage_invalid_digest_is_refused(storage: Storage, name: str) -> None:
    calls: list[Callable[[], object]] = [
        lambda: storage.open_writer(sha256=name),
        lambda: storage.stat(name),
        lambda: storage.open(name),
        lambda: storage.read(name),
        lambda: storage.delete(name),
        lambda: storage.materialise(name, Path("never")),
    ]
    for call in calls:
        with pytest.raises(ValueError, match="SHA-256"):
            call()


@pytest.mark.parametrize("writable", [False, True])
def test_storage_materialise_writes_file(storage: Storage, tmp_path: Path, writable: bool) -> None:
    data = noise(2 * MIB)
    sha256 = put(storage, data).sha256
    target = tmp_path / "deep" / "er" / "file.bin"
    storage.materialise(sha256, target, writable=writable)
    assert target.read_bytes() == data
    with pytest.raises(StorageError, match="exists"):
        storage.materialise(sha256, target, writable=writable)
    if writable:
        with target.open("ab") as handle:
            handle.write(b"own")
    else:
        target.unlink()
    assert b"".join(storage.read(sha256)) == data


def test_documents_are_published_once(storage: Storage) -> None:
    assert storage.read_document("results/job-1.json") is None
    assert storage.publish_document("results/job-1.json", b"first")
    assert not storage.publish_document("results/job-1.json", b"second")
    assert storage.publish_document("results/job-1.json", b"first")  # a repeat after a lost answer
    assert storage.read_document("results/job-1.json") == b"first"
    assert storage.publish_document("results/job-2.json", b"other")
    assert storage.publish_document("checkpoints/job-1/0001", b"state")
    assert sorted(storage.list_documents("results/")) == ["results/job-1.json", "results/job-2.json"]
    assert len(list(storage.list_documents())) == 3
    assert storage.remove_document("results/job-1.json")
    assert not storage.remove_document("results/job-1.json")
    assert storage.publish_document("results/job-1.json", b"second")
    assert list(storage.list_blobs()) == []


def test_storage_concurrent_publish_has_one_winner(storage: Storage) -> None:
    winners: list[int] = []
    start = threading.Barrier(8)

    def publish(number: int) -> None:
        start.wait()
        if storage.publish_document("results/contested", f"attempt {number}".encode()):
            winners.append(number)

    threads = [threading.Thread(target=publish, args=(number,)) for number in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(winners) == 1
    assert storage.read_document("results/contested") == f"attempt {winners[0]}".encode()


@pytest.mark.parametrize("name", ["", "/etc/passwd", "../up", "a/../b", "a//b", ".hidden", "Big", "a/b/"])
def test_document_names_are_checked(storage: Storage, name: str) -> None:
    with pytest.raises(ValueError, match="name of a document"):
        storage.publish_document(name, b"")
    with pytest.raises(ValueError, match="name of a document"):
        storage.read_document(name)
    with pytest.raises(ValueError, match="name of a document"):
        storage.remove_document(name)


def test_parallel_uploads_of_the_same_content(storage: Storage) -> None:
    data = noise(MIB)
    blobs: list[Blob] = []
    threads = [threading.Thread(target=lambda: blobs.append(put(storage, data, 4096))) for _ in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert blobs == [Blob(digest(data), MIB)] * 6
    assert b"".join(storage.read(digest(data))) == data


def test_storage_tree_round_trips(storage: Storage, tmp_path: Path) -> None:
    folder = tmp_path / "results"
    (folder / "renders").mkdir(parents=True)
    (folder / "scene.ply").write_bytes(noise(100_000))
    (folder / "renders" / "a.png").write_bytes(b"a")
    (folder / "renders" / "b.png").write_bytes(b"a")
    sizes: list[int] = []
    manifest = store_tree(storage, folder, metadata={"attempt": 2}, on_stored=sizes.append)
    assert [file.path for file in manifest.files] == ["renders/a.png", "renders/b.png", "scene.ply"]
    assert sizes == [1, 1, 100_000] and manifest.size_bytes == 100_002
    assert len(list(storage.list_blobs())) == 2
    assert read_manifest(storage, "results/j1") is None
    assert publish_manifest(storage, "results/j1", manifest)
    assert not publish_manifest(storage, "results/j1", manifest.model_copy(update={"about": {"attempt": 3}}))

    found = read_manifest(storage, "results/j1")
    assert found == manifest
    fetch_tree(storage, found.files, tmp_path / "copy", writable=True)
    assert (tmp_path / "copy" / "scene.ply").read_bytes() == noise(100_000)
    assert (tmp_path / "copy" / "renders" / "b.png").read_bytes() == b"a"


def test_storage_damaged_manifest_is_refused(storage: Storage) -> None:
    storage.publish_document("results/j1", b'{"files": 3}')
    with pytest.raises(StorageError, match="results/j1"):
        read_manifest(storage, "results/j1")


def test_trees_lead_nowhere_else(storage: Storage, tmp_path: Path) -> None:
    sha256 = put(storage, b"evil").sha256
    hostile = Manifest(files=(TreeFile(path="../evil", sha256=sha256, size_bytes=4),))
    with pytest.raises(FileNameError, match="elsewhere"):
        fetch_tree(storage, hostile.files, tmp_path / "inside")
    assert not (tmp_path / "evil").exists()
    folder = tmp_path / "results"
    folder.mkdir()
    (folder / "link").symlink_to("/etc/passwd")
    with pytest.raises(StorageError, match="not a regular file"):
        store_tree(storage, folder)


MEMORY = """
import pathlib, resource, sys
from octasplat.workers.storage import open_storage, store_tree

storage = open_storage(sys.argv[1], floor_bytes=0)
folder = pathlib.Path(sys.argv[3])

def put(megabytes, start):
    with (folder / "large.bin").open("wb") as file:
        for number in range(megabytes):
            file.write((start + number).to_bytes(8, "big") * (1 << 17))
    return store_tree(storage, folder).files[0]

def take(blob):
    return sum(len(piece) for piece in storage.read(blob.sha256))

take(put(24, 0))
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
blob = put(int(sys.argv[2]), 1000)
assert take(blob) == blob.size_bytes == int(sys.argv[2]) << 20
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
"""


@pytest.mark.exhaustive
def test_memory_does_not_grow_with_the_content(
    storage: Storage, s3_address: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """In a process of its own, as the S3 server of the tests lives in this one."""
    if isinstance(storage, S3Storage):
        address = f"s3://{storage.bucket}/p?endpoint_url={s3_address}"
    else:
        path = storage.local_path(put(storage, b"x").sha256)
        assert path is not None
        address = str(path.parents[2])
    done = subprocess.run(
        [sys.executable, "-c", MEMORY, address, "160", str(tmp_path_factory.mktemp("results"))],
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) < 24 << 10  # KiB


def test_storage_delete_older_spares_recent_content(storage: Storage) -> None:
    blob = put(storage, b"x")
    written = next(storage.list_blobs()).modified_unix
    assert not storage.delete_older(blob.sha256, written - 5)
    assert b"".join(storage.read(blob.sha256)) == b"x"
    assert storage.delete_older(blob.sha256, written + 5)
    assert list(storage.list_blobs()) == [] and not storage.delete_older(blob.sha256, written + 5)
    put(storage, b"x")
    assert b"".join(storage.read(blob.sha256)) == b"x"

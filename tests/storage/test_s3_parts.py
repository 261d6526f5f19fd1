"""Lengths of the parts in which content goes into a bucket."""

from pathlib import Path
from typing import Any

import pytest

from octasplat.workers.storage import ContentTooLargeError, s3_transfers, store_tree
from octasplat.workers.storage.protocol import Storage
from octasplat.workers.storage.s3 import S3Storage

MIB = 1 << 20
MOST_PARTS = 10_000


class RecordingClient:
    """Takes parts as S3 does, and keeps how long they were."""

    def __init__(self) -> None:
        self.lengths: list[int] = []

    def create_multipart_upload(self, **_of: Any) -> dict[str, Any]:
        return {"UploadId": "u"}

    def upload_part(self, *, Body: bytes, **_of: Any) -> dict[str, Any]:  # noqa: N803 - S3's name
        self.lengths.append(len(Body))
        return {"ETag": str(len(self.lengths))}

    def abort_multipart_upload(self, **_of: Any) -> None:
        pass

    def put_object(self, *, Body: bytes, **_of: Any) -> None:  # noqa: N803 - S3's name
        self.lengths.append(len(Body))

    def upload_part_copy(self, **_of: Any) -> dict[str, Any]:
        return {"CopyPartResult": {"ETag": "copy"}}

    def complete_multipart_upload(self, **_of: Any) -> None:
        pass

    def delete_object(self, **_of: Any) -> None:
        pass


@pytest.mark.parametrize(
    ("limits", "most_bytes"),
    [
        ({"size_bytes": 4 << 30}, 4 << 30), ({"size_bytes": 300 << 30, "max_bytes": 1 << 40}, 300 << 30),
        ({"max_bytes": 4 << 30}, 4 << 30), ({"max_bytes": 400 << 30}, 400 << 30), ({}, 600 << 30),
    ],
)  # fmt: skip
def test_parts_of_one_length_hold_the_longest_content(limits: dict[str, int], most_bytes: int) -> None:
    client: Any = RecordingClient()
    writer = S3Storage("bucket", client=client).open_writer(**limits)
    for _ in range(135):
        writer.write(bytes(MIB))
    writer.abort()
    (length,) = set(client.lengths)
    assert length * MOST_PARTS >= most_bytes
    assert 5 * MIB <= length <= 64 * MIB  # which are in memory


def test_files_of_a_tree_go_in_parts_by_their_length(tmp_path: Path) -> None:
    for name, length in (("a", 20 * MIB), ("b", 1000), ("c", 0)):
        with (tmp_path / name).open("wb") as file:
            file.truncate(length)
    client: Any = RecordingClient()
    manifest = store_tree(S3Storage("bucket", client=client), tmp_path)
    assert [file.size_bytes for file in manifest.files] == [20 * MIB, 1000, 0]
    assert client.lengths == [8 * MIB, 8 * MIB, 4 * MIB, 1000, 0]


@pytest.mark.parametrize("change", [3 * MIB, -3 * MIB])
def test_file_that_is_written_meanwhile_is_stored_as_far_as_it_was(
    storage: Storage, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch, change: int
) -> None:
    folder = tmp_path_factory.mktemp("results")
    (folder / "events.jsonl").write_bytes(bytes(5 * MIB))
    opened = storage.open_writer

    def open_writer(**limits: Any) -> Any:
        with (folder / "events.jsonl").open("r+b") as file:
            file.truncate(5 * MIB + change)
        return opened(**limits)

    monkeypatch.setattr(storage, "open_writer", open_writer)
    (file,) = store_tree(storage, folder).files
    assert file.size_bytes == min(5 * MIB, 5 * MIB + change)
    assert b"".join(storage.read(file.sha256)) == bytes(file.size_bytes)


def test_content_of_more_parts_than_s3_takes_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(s3_transfers, "MAX_PARTS", 2)
    client: Any = RecordingClient()
    writer = S3Storage("bucket", client=client).open_writer()
    with pytest.raises(ContentTooLargeError, match=f"than the {128 * MIB} bytes"):
        for _ in range(192):
            writer.write(bytes(MIB))

"""Lengths of the parts in which content goes into a bucket."""

from typing import Any

import pytest

from octasplat.workers.storage import ContentTooLargeError, s3_transfers
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


def test_content_of_more_parts_than_s3_takes_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(s3_transfers, "MAX_PARTS", 2)
    client: Any = RecordingClient()
    writer = S3Storage("bucket", client=client).open_writer()
    with pytest.raises(ContentTooLargeError, match=f"than the {128 * MIB} bytes"):
        for _ in range(192):
            writer.write(bytes(MIB))

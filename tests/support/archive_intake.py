"""Archives given to the intake: what comes out of them, or the code that refuses them."""

import io
import json
import struct

import pytest

from octasplat.service.intake.archive import ArchiveFile, ArchiveLimits, list_archive, unpack_archive
from octasplat.service.intake.faults import IntakeError
from octasplat.workers.storage.local import LocalStorage
from octasplat.workers.storage.protocol import Blob
from tests.support.zip_builder import ZipMember

PHOTO = b"\xff\xd8\xff\xe0 not much of a photograph " * 40
MODEL = struct.pack("<Q", 0x088B1F) + bytes(300)  # a count that looks like gzip
LIMITS = ArchiveLimits()


def good(name: str = "images/a.jpg") -> ZipMember:
    return ZipMember(name, PHOTO)


def take(data: bytes, storage: LocalStorage, limits: ArchiveLimits = LIMITS) -> dict[str, bytes]:
    listing = list_archive(io.BytesIO(data), limits)
    found: dict[str, str] = {}

    def on_file(file: ArchiveFile, blob: Blob) -> None:
        found[file.name] = blob.sha256

    unpack_archive(
        io.BytesIO(data), listing, lambda file: storage.open_writer(max_bytes=file.size_bytes), on_file
    )
    return {name: b"".join(storage.read(sha256)) for name, sha256 in found.items()}


def refusal(data: bytes, storage: LocalStorage, limits: ArchiveLimits = LIMITS) -> str:
    with pytest.raises(IntakeError) as caught:
        take(data, storage, limits)
    assert str(caught.value).endswith(".")
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 400
    json.dumps([fault.as_dict() for fault in caught.value.faults], ensure_ascii=False).encode()  # can be told
    assert storage.remove_stale_uploads(-60) == 0  # nothing half-written is left
    return caught.value.code

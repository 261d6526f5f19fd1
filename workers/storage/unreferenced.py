"""Search and removal of unreferenced contents; the caller knows all references."""

import math
from collections.abc import Iterable, Sequence, Set
from dataclasses import dataclass

from octasplat.workers.storage.protocol import Storage, StoredBlob


@dataclass(frozen=True)
class RemovedContents:
    """Contents that were removed: their number and their length together."""

    blobs: int = 0
    size_bytes: int = 0

    def __add__(self, other: "RemovedContents") -> "RemovedContents":
        return RemovedContents(self.blobs + other.blobs, self.size_bytes + other.size_bytes)


@dataclass(frozen=True)
class UnusedContent:
    """Content that may be removed unless it is written once more: from ``before_unix`` on it stays, s."""

    sha256: str
    size_bytes: int
    before_unix: float


def find_unused(
    storage: Storage,
    referenced: Set[str],
    replaced: Set[str],
    *,
    unused_before_unix: float,
    replaced_before_unix: float,
) -> list[UnusedContent]:
    """Return contents that are not referenced and were not written lately.

    Content is stored first and named afterwards, and storing it once more makes it young, so what is old and
    not named is not about to be named either.

    Args:
        storage: the store.
        referenced: digests that must stay; all that was named when the call was prepared.
        replaced: digests that were named once and have been replaced since.
        unused_before_unix: what was written before this time goes, s.
        replaced_before_unix: the same for what is in ``replaced``, s.

    Raises:
        StorageError: the store cannot be listed.
    """
    found = []
    for entry in storage.list_blobs():
        sha256 = entry.blob.sha256
        limit = max(unused_before_unix, replaced_before_unix) if sha256 in replaced else unused_before_unix
        if sha256 not in referenced and entry.modified_unix < limit:
            found.append(UnusedContent(sha256, entry.blob.size_bytes, limit))
    return found


def list_unreferenced(storage: Storage, referenced: Set[str]) -> list[StoredBlob]:
    """Return contents that are not referenced, as they are now.

    Raises:
        StorageError: the store cannot be listed.
    """
    return [entry for entry in storage.list_blobs() if entry.blob.sha256 not in referenced]


def still_unreferenced(
    listed: Sequence[StoredBlob], referenced: Set[str], *, before_unix: float
) -> list[UnusedContent]:
    """Return those of the listed contents that are still unreferenced and unchanged.

    Args:
        listed: what :func:`list_unreferenced` listed before ``referenced`` was gathered.
        referenced: digests that must stay.
        before_unix: only what was written before this time goes, s.
    """
    return [
        # Just above the listed time: it stays if it was written again since.
        UnusedContent(entry.blob.sha256, entry.blob.size_bytes, math.nextafter(entry.modified_unix, math.inf))
        for entry in listed
        if entry.blob.sha256 not in referenced and entry.modified_unix < before_unix
    ]


def remove_contents(storage: Storage, contents: Iterable[UnusedContent]) -> RemovedContents:
    """Remove contents that were not written again.

    Raises:
        StorageError: the store cannot be changed.
    """
    removed = RemovedContents()
    for content in contents:
        if storage.delete_older(content.sha256, content.before_unix):
            removed += RemovedContents(1, content.size_bytes)
    return removed

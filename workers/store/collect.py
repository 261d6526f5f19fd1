"""Contents that nothing names, found and removed. Whoever calls this knows all that is named."""

import math
from collections.abc import Iterable, Sequence, Set
from dataclasses import dataclass

from octasplat.workers.store.protocol import Storage, StoredBlob


@dataclass(frozen=True)
class Collected:
    """Contents that were removed: their number and their length together."""

    blobs: int = 0
    size_bytes: int = 0

    def __add__(self, other: "Collected") -> "Collected":
        return Collected(self.blobs + other.blobs, self.size_bytes + other.size_bytes)


@dataclass(frozen=True)
class Unused:
    """Content that may be removed unless it is written once more: from ``before_unix`` on it stays, s."""

    sha256: str
    size_bytes: int
    before_unix: float


def unused(
    storage: Storage,
    named: Set[str],
    replaced: Set[str],
    *,
    unused_before_unix: float,
    replaced_before_unix: float,
) -> list[Unused]:
    """Contents that are not named and were not written lately.

    Content is stored first and named afterwards, and storing it once more makes it young, so what is old and
    not named is not about to be named either.

    Args:
        storage: the store.
        named: digests that must stay; all that was named when the call was prepared.
        replaced: digests that were named once and have been replaced since.
        unused_before_unix: what was written before this time goes, s.
        replaced_before_unix: the same for what is in ``replaced``, s.

    Raises:
        StorageError: the store cannot be listed.
    """
    found = []
    for entry in storage.blobs():
        sha256 = entry.blob.sha256
        limit = max(unused_before_unix, replaced_before_unix) if sha256 in replaced else unused_before_unix
        if sha256 not in named and entry.modified_unix < limit:
            found.append(Unused(sha256, entry.blob.size_bytes, limit))
    return found


def unnamed(storage: Storage, named: Set[str]) -> list[StoredBlob]:
    """Contents that are not named, as they are now.

    Raises:
        StorageError: the store cannot be listed.
    """
    return [entry for entry in storage.blobs() if entry.blob.sha256 not in named]


def unchanged(found: Sequence[StoredBlob], named: Set[str], *, before_unix: float) -> list[Unused]:
    """Of contents that were listed those that are still not named, as long as they are as they were listed.

    Args:
        found: what :func:`unnamed` listed before ``named`` was gathered.
        named: digests that must stay.
        before_unix: only what was written before this time goes, s.
    """
    return [
        Unused(entry.blob.sha256, entry.blob.size_bytes, math.nextafter(entry.modified_unix, math.inf))
        for entry in found
        if entry.blob.sha256 not in named and entry.modified_unix < before_unix
    ]


def remove(storage: Storage, contents: Iterable[Unused]) -> Collected:
    """Remove contents that were not written once more.

    Raises:
        StorageError: the store cannot be changed.
    """
    removed = Collected()
    for content in contents:
        if storage.delete_older(content.sha256, content.before_unix):
            removed += Collected(1, content.size_bytes)
    return removed

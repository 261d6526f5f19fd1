"""Removing contents that nothing names. Whoever calls this knows all that is named."""

import math
from collections.abc import Sequence, Set
from dataclasses import dataclass

from workers.store.protocol import Storage, StoredBlob


@dataclass(frozen=True)
class Collected:
    """Contents that were removed: their number and their length together."""

    blobs: int = 0
    size_bytes: int = 0


def collect_unused(
    storage: Storage,
    named: Set[str],
    replaced: Set[str],
    *,
    unused_before_unix: float,
    replaced_before_unix: float,
) -> Collected:
    """Remove contents that are not named and were not written lately.

    Content is stored first and named afterwards, and storing it once more makes it young, so what is old and
    not named is not about to be named either.

    Args:
        storage: the store.
        named: digests that must stay; all that was named when the call was prepared.
        replaced: digests that were named once and have been replaced since.
        unused_before_unix: what was written before this time goes, s.
        replaced_before_unix: the same for what is in ``replaced``, s.

    Raises:
        StorageError: the store cannot be listed or changed.
    """
    count = size_bytes = 0
    for entry in storage.blobs():
        sha256 = entry.blob.sha256
        limit = max(unused_before_unix, replaced_before_unix) if sha256 in replaced else unused_before_unix
        if sha256 in named or entry.modified_unix >= limit:
            continue
        if storage.delete_older(sha256, limit):
            count += 1
            size_bytes += entry.blob.size_bytes
    return Collected(count, size_bytes)


def unnamed(storage: Storage, named: Set[str]) -> list[StoredBlob]:
    """Contents that are not named, as they are now.

    Raises:
        StorageError: the store cannot be listed.
    """
    return [entry for entry in storage.blobs() if entry.blob.sha256 not in named]


def remove_unchanged(
    storage: Storage, found: Sequence[StoredBlob], named: Set[str], *, before_unix: float
) -> Collected:
    """Remove contents that are still not named and were not stored once more since they were listed.

    Args:
        storage: the store.
        found: what :func:`unnamed` listed before ``named`` was gathered.
        named: digests that must stay.
        before_unix: only what was written before this time goes, s.

    Raises:
        StorageError: the store cannot be changed.
    """
    count = size_bytes = 0
    for entry in found:
        if entry.blob.sha256 in named or entry.modified_unix >= before_unix:
            continue
        if storage.delete_older(entry.blob.sha256, math.nextafter(entry.modified_unix, math.inf)):
            count += 1
            size_bytes += entry.blob.size_bytes
    return Collected(count, size_bytes)

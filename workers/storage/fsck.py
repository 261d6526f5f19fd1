"""Comparison of the tables with the storage; reports and changes nothing."""

import hashlib
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

from octasplat.workers.storage.errors import StorageError
from octasplat.workers.storage.protocol import Storage

MIN_UNUSED_AGE_SECONDS = 3600.0
"""Blobs younger than this may belong to an upload that is not entered yet."""


@dataclass(frozen=True)
class Reference:
    """A place in the tables that names content.

    Attributes:
        where: for people, e.g. ``dataset 0190... images/a.jpg``.
        sha256: digest of the content.
        size_bytes: its length, None where the table does not say.
    """

    where: str
    sha256: str
    size_bytes: int | None = None


@dataclass(frozen=True)
class Finding:
    """A mismatch: ``missing``, ``damaged``, ``size`` or ``unreadable``."""

    kind: str
    where: str
    sha256: str
    detail: str


@dataclass
class Report:
    """Result of comparing the tables with the storage.

    Attributes:
        references: places in the tables.
        blobs: contents in the store.
        blob_bytes: their length together.
        findings: content that is needed and not sound.
        unused: digests of contents that nothing names and that are not young.
        unused_bytes: their length together.
        young: contents that nothing names yet.
        verified: contents that were read whole.
    """

    references: int = 0
    blobs: int = 0
    blob_bytes: int = 0
    findings: list[Finding] = field(default_factory=list)
    unused: list[str] = field(default_factory=list)
    unused_bytes: int = 0
    young: int = 0
    verified: int = 0

    @property
    def is_sound(self) -> bool:
        """Return whether everything that the tables reference exists."""
        return not self.findings


def compare_with_storage(
    storage: Storage,
    references: Iterable[Reference],
    *,
    verify: bool = False,
    on_blob: Callable[[int, int], None] | None = None,
) -> Report:
    """Compare references with the contents of a store.

    Args:
        storage: the store.
        references: everything that the tables name; read before the store is listed, as content is always
            stored before it is named.
        verify: read every content that is named and compare its digest.
        on_blob: told (contents verified, contents to verify).

    Raises:
        StorageError: the store cannot be listed.
    """
    report = Report()
    named: dict[str, list[Reference]] = {}
    for reference in references:
        report.references += 1
        named.setdefault(reference.sha256, []).append(reference)
    sizes: dict[str, int] = {}
    latest = time.time() - MIN_UNUSED_AGE_SECONDS
    for entry in storage.list_blobs():
        blob = entry.blob
        report.blobs += 1
        report.blob_bytes += blob.size_bytes
        sizes[blob.sha256] = blob.size_bytes
        if blob.sha256 not in named:
            if entry.modified_unix > latest:
                report.young += 1
            else:
                report.unused.append(blob.sha256)
                report.unused_bytes += blob.size_bytes
    for places in named.values():
        report.findings += [
            finding for place in places if (finding := _check_reference(place, sizes)) is not None
        ]
    if verify:
        # What is missing is told already, so that only what is there is read.
        _verify(storage, {sha256: named[sha256] for sha256 in named if sha256 in sizes}, report, on_blob)
    return report


def _check_reference(reference: Reference, sizes: dict[str, int]) -> Finding | None:
    size = sizes.get(reference.sha256)
    if size is None:
        return Finding("missing", reference.where, reference.sha256, "the store does not hold it")
    if reference.size_bytes is not None and reference.size_bytes != size:
        detail = f"the store holds {size} bytes where {reference.size_bytes} are expected"
        return Finding("size", reference.where, reference.sha256, detail)
    return None


def _verify(
    storage: Storage,
    named: dict[str, list[Reference]],
    report: Report,
    on_blob: Callable[[int, int], None] | None,
) -> None:
    for sha256, places in named.items():
        digest = hashlib.sha256()
        kind = detail = ""
        try:
            for piece in storage.read(sha256):
                digest.update(piece)
            if digest.hexdigest() != sha256:
                kind, detail = "damaged", f"its bytes have the SHA-256 {digest.hexdigest()}"
        except StorageError as error:
            kind, detail = "unreadable", str(error)
        if kind:
            report.findings += [Finding(kind, place.where, sha256, detail) for place in places]
        report.verified += 1
        if on_blob is not None:
            on_blob(report.verified, len(named))

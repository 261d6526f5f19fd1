"""Copy of content out of a storage that detects damage."""

import hashlib
import os
from collections.abc import Iterable
from pathlib import Path

from octasplat.workers.storage.errors import DigestMismatchError
from octasplat.workers.storage.protocol import Blob


def check_content(chunks: Iterable[bytes], sha256: str) -> None:
    """Check content without a copy.

    Raises:
        DigestMismatchError: the pieces are not the content of that digest.
    """
    digest = hashlib.sha256()
    for piece in chunks:
        digest.update(piece)
    if digest.hexdigest() != sha256:
        raise DigestMismatchError(f"The stored content {sha256} is damaged; upload it again.")


def copy_verified(chunks: Iterable[bytes], blob: Blob, target: Path) -> None:
    """Write ``chunks`` to the new file ``target`` and compare them with ``blob``.

    Raises:
        FileExistsError: ``target`` is there already.
        DigestMismatchError: the pieces are not the content of ``blob``; ``target`` is removed.
    """
    digest = hashlib.sha256()
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
    fd = os.open(target, flags, 0o600)
    try:
        with os.fdopen(fd, "wb") as handle:
            for piece in chunks:
                digest.update(piece)
                handle.write(piece)
            handle.flush()
            os.fsync(fd)
        if digest.hexdigest() != blob.sha256:
            raise DigestMismatchError(f"The stored content {blob.sha256} is damaged; upload it again.")
    except BaseException:
        target.unlink(missing_ok=True)
        raise

"""Spool space on this machine for archives while they are read."""

import os
import threading
from collections import Counter
from pathlib import Path

from octasplat.workers.storage.errors import StorageFullError
from octasplat.workers.storage.os_errors import translate_os_errors


class SpoolSpace:
    """Limits the total size of the archives that are being read, and that of one owner's.

    What arrived counts, not what was announced.

    Args:
        folder: where they lie; made when the first one comes.
        max_bytes: of all together; None sets no limit.
        owner_share: the part of ``max_bytes`` that one owner may take.
        floor_bytes: room that its disk keeps free.
    """

    def __init__(
        self, folder: Path, *, max_bytes: int | None = None, owner_share: float = 1.0, floor_bytes: int = 0
    ) -> None:
        self.folder = folder
        self._max_bytes = max_bytes
        self._max_owner_bytes = None if max_bytes is None else int(owner_share * max_bytes)
        self._floor_bytes = floor_bytes
        self._taken_bytes: Counter[str] = Counter()
        self._lock = threading.Lock()

    def ensure(self, owner: str, size_bytes: int) -> None:
        """Check that an owner may take so much more now; nothing is taken.

        Raises:
            StorageFullError: there is not as much.
        """
        with self._lock:
            self._check(owner, size_bytes)

    def take(self, owner: str, size_bytes: int) -> None:
        """Take space for an owner until it is released.

        Raises:
            StorageFullError: there is not as much.
        """
        with self._lock:
            self._check(owner, size_bytes)
            self._taken_bytes[owner] += size_bytes

    def release(self, owner: str, size_bytes: int) -> None:
        """Release space that was taken."""
        with self._lock:
            self._taken_bytes[owner] -= size_bytes
            if not self._taken_bytes[owner]:
                del self._taken_bytes[owner]

    def _check(self, owner: str, size_bytes: int) -> None:
        mine, taken = self._taken_bytes[owner], self._taken_bytes.total()
        if self._max_owner_bytes is not None and mine + size_bytes > self._max_owner_bytes:
            raise StorageFullError(
                f"Your archives that are being read have {self._max_owner_bytes} bytes together, of which "
                f"{mine} are taken; send this one later, or the files one by one."
            )
        if self._max_bytes is not None and taken + size_bytes > self._max_bytes:
            raise StorageFullError(
                f"Archives that are being read have {self._max_bytes} bytes together, of which "
                f"{taken} are taken; send this one later, or the files one by one."
            )
        with translate_os_errors(self.folder):
            facts = os.statvfs(self.folder)
        if size_bytes > (free := facts.f_bavail * facts.f_frsize - self._floor_bytes):
            raise StorageFullError(
                f"The disk for archives has {max(0, free)} bytes left but {size_bytes} are needed; "
                "send this one later, or the files one by one."
            )

"""Spool space on this machine for archives while they are read."""

import os
import threading
from pathlib import Path

from octasplat.workers.storage.errors import StorageFullError
from octasplat.workers.storage.os_errors import translate_os_errors


class SpoolSpace:
    """Limits the total size of the archives that are being read.

    Args:
        folder: where they lie; made when the first one comes.
        max_bytes: of all together; None sets no limit.
        floor_bytes: room that its disk keeps free.
    """

    def __init__(self, folder: Path, *, max_bytes: int | None = None, floor_bytes: int = 0) -> None:
        self.folder = folder
        self._max_bytes = max_bytes
        self._floor_bytes = floor_bytes
        self._reserved_bytes = 0
        self._lock = threading.Lock()

    def reserve(self, size_bytes: int) -> None:
        """Reserve space until it is released.

        Raises:
            StorageFullError: there is not as much.
        """
        with self._lock:
            if self._max_bytes is not None and self._reserved_bytes + size_bytes > self._max_bytes:
                raise StorageFullError(
                    f"Archives that are being read have {self._max_bytes} bytes together, of which "
                    f"{self._reserved_bytes} are taken; send this one later, or the files one by one."
                )
            with translate_os_errors(self.folder):
                facts = os.statvfs(self.folder)
            if size_bytes > (free := facts.f_bavail * facts.f_frsize - self._floor_bytes):
                raise StorageFullError(
                    f"The disk for archives has {max(0, free)} bytes left but {size_bytes} are needed; "
                    "send this one later, or the files one by one."
                )
            self._reserved_bytes += size_bytes

    def release(self, size_bytes: int) -> None:
        """Release reserved space."""
        with self._lock:
            self._reserved_bytes -= size_bytes

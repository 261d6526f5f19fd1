"""Room on this machine for archives while they are read, whatever store their contents go to."""

import os
import threading
from pathlib import Path

from octasplat.workers.store.errors import StorageFull
from octasplat.workers.store.os_errors import told


class Spool:
    """Bounds what all archives take that are being read.

    Args:
        folder: where they lie; made when the first one comes.
        max_bytes: of all together; None sets no limit.
        floor_bytes: room that its disk keeps free.
    """

    def __init__(self, folder: Path, *, max_bytes: int | None = None, floor_bytes: int = 0) -> None:
        self.folder = folder
        self._max_bytes = max_bytes
        self._floor_bytes = floor_bytes
        self._taken_bytes = 0
        self._lock = threading.Lock()

    def take(self, size_bytes: int) -> None:
        """Set so much aside, until it is given back.

        Raises:
            StorageFull: there is not as much.
        """
        with self._lock:
            if self._max_bytes is not None and self._taken_bytes + size_bytes > self._max_bytes:
                raise StorageFull(
                    f"Archives that are being read have {self._max_bytes} bytes together, of which "
                    f"{self._taken_bytes} are taken; send this one later, or the files one by one."
                )
            with told(self.folder):
                facts = os.statvfs(self.folder)
            if size_bytes > (free := facts.f_bavail * facts.f_frsize - self._floor_bytes):
                raise StorageFull(
                    f"The disk for archives has {max(0, free)} bytes left but {size_bytes} are needed; "
                    "send this one later, or the files one by one."
                )
            self._taken_bytes += size_bytes

    def give_back(self, size_bytes: int) -> None:
        """So much is taken no more."""
        with self._lock:
            self._taken_bytes -= size_bytes

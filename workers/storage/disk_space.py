"""Free space of the storage and of the disk for work in progress."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from octasplat.workers.storage.errors import StorageFullError
from octasplat.workers.storage.os_errors import FREE_SPACE_HINT, translate_os_errors
from octasplat.workers.storage.protocol import Storage

MIN_FREE_BYTES = 1 << 20
"""With less than this a disk is full, also where nothing is to be kept free."""


@dataclass(frozen=True)
class SpaceUsage:
    """Space that a job needs on the work disk and in the storage."""

    work_bytes: int = 0
    store_bytes: int = 0


NO_USAGE = SpaceUsage()


@dataclass(frozen=True)
class DiskSpace:
    """Monitors the disks that jobs fill.

    Attributes:
        storage: the store, which keeps a floor of its own.
        work: folder of the work under way, or its nearest parent that exists.
        floor_bytes: room on the disk of ``work`` below which no job is begun.
        store_margin_bytes: room in the store, above its own floor, below which no job is begun; what is
            between the two is left to the running jobs.
        reserve_bytes: room on the disk of ``work`` that no job takes, not even one under way: that of the
            database, which is often on the same.
        store_folder: where the store is a folder.
    """

    storage: Storage
    work: Path
    floor_bytes: int
    store_margin_bytes: int = 0
    reserve_bytes: int = 0
    store_folder: Path | None = None

    def shortage(self, excluding: SpaceUsage = NO_USAGE) -> str | None:
        """Return a sentence on which disk is short of space, or None.

        Args:
            excluding: as if this were not there.

        Raises:
            StorageUnavailableError: a disk does not answer.
        """
        # On a disk for both, what either of them would give up is room for each.
        if self._shares_disk():
            excluding = SpaceUsage(
                excluding.work_bytes + excluding.store_bytes, excluding.work_bytes + excluding.store_bytes
            )
        stored, least = self.storage.free_bytes(), max(self.store_margin_bytes, MIN_FREE_BYTES)
        if stored is not None and stored + excluding.store_bytes < least:
            return f"The store lacks {least - stored} bytes of the room that is kept free; {FREE_SPACE_HINT}."
        free, least = self._free_work_bytes() + excluding.work_bytes, max(self.floor_bytes, MIN_FREE_BYTES)
        if free < least:
            return (
                f"The disk of {self.work} has {free} bytes free where {least} are kept; "
                f"if the store is on it, {FREE_SPACE_HINT}."
            )
        return None

    def free_bytes(self) -> int:
        """Return the space for jobs on the fuller of the disks.

        Raises:
            StorageUnavailableError: a disk does not answer.
        """
        stored, free = self.storage.free_bytes(), self._free_work_bytes()
        return free if stored is None else min(free, stored)

    def capacity_bytes(self) -> int:
        """Return the capacity of the disk of ``work`` above the floor, with only the system on it.

        Raises:
            StorageUnavailableError: the disk does not answer.
        """
        facts = self._work_statvfs()
        return max(0, facts.f_blocks * facts.f_frsize - self.floor_bytes)

    def facts(self) -> dict[str, Any]:
        """Return the facts on the disk of ``work`` that a worker publishes.

        Raises:
            StorageUnavailableError: the disk does not answer.
        """
        return {
            "disk_bytes": self.capacity_bytes(),
            "disk_free_bytes": self.free_bytes(),
            "shares_store_disk": self._shares_disk(),
        }

    def ensure_workspace(self, size_bytes: int) -> None:
        """Refuse a size that would use the reserve on the disk of ``work``.

        Raises:
            StorageFullError: it would.
            StorageUnavailableError: the disk does not answer.
        """
        if size_bytes > (left := self._free_work_bytes() - self.reserve_bytes):
            raise StorageFullError(
                f"The disk of {self.work} has {max(0, left)} bytes for jobs but {size_bytes} are needed; "
                f"if the store is on it, {FREE_SPACE_HINT}."
            )

    def _free_work_bytes(self) -> int:
        facts = self._work_statvfs()
        return facts.f_bavail * facts.f_frsize

    def _work_statvfs(self) -> os.statvfs_result:
        with translate_os_errors(self.work):
            return os.statvfs(_nearest_existing(self.work))

    def _shares_disk(self) -> bool:
        if self.store_folder is None:
            return False
        with translate_os_errors(self.work):
            return (
                _nearest_existing(self.work).stat().st_dev
                == _nearest_existing(self.store_folder).stat().st_dev
            )


def _nearest_existing(folder: Path) -> Path:
    """Return the folder or its nearest parent that exists."""
    place = folder.absolute()
    while not place.exists():
        place = place.parent
    return place

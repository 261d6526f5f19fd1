"""Whether there is room to work: in the store, and on the disk of the work under way."""

import os
from dataclasses import dataclass
from pathlib import Path

from octasplat.workers.store.errors import StorageFull
from octasplat.workers.store.os_errors import MAKE_ROOM, told
from octasplat.workers.store.protocol import Storage

LEAST_BYTES = 1 << 20
"""With less than this a disk is full, also where nothing is to be kept free."""


@dataclass(frozen=True)
class Taken:
    """What a job takes on the disk of the work, and in the store."""

    work_bytes: int = 0
    store_bytes: int = 0


NOTHING = Taken()


@dataclass(frozen=True)
class Room:
    """Watches the disks that jobs fill.

    Attributes:
        storage: the store, which keeps a floor of its own.
        work: folder of the work under way, or its nearest parent that exists.
        floor_bytes: room on the disk of ``work`` below which no job is begun.
        above_bytes: room in the store, above the floor of its own, below which no job is begun; what is
            between the two is left to the jobs under way.
        reserve_bytes: room on the disk of ``work`` that no job takes, not even one under way: that of the
            database, which is often on the same.
        store_folder: where the store is a folder.
    """

    storage: Storage
    work: Path
    floor_bytes: int
    above_bytes: int = 0
    reserve_bytes: int = 0
    store_folder: Path | None = None

    def lacking(self, without: Taken = NOTHING) -> str | None:
        """One sentence on what lacks room, or None.

        Args:
            without: as if this were not there.

        Raises:
            StorageUnavailable: a disk does not answer.
        """
        if self._is_one_disk():
            without = Taken(
                without.work_bytes + without.store_bytes, without.work_bytes + without.store_bytes
            )
        stored, least = self.storage.free_bytes(), max(self.above_bytes, LEAST_BYTES)
        if stored is not None and stored + without.store_bytes < least:
            return f"The store lacks {least - stored} bytes of the room that is kept free; {MAKE_ROOM}."
        free, least = self._free_for_work() + without.work_bytes, max(self.floor_bytes, LEAST_BYTES)
        if free < least:
            return (
                f"The disk of {self.work} has {free} bytes free where {least} are kept; "
                f"if the store is on it, {MAKE_ROOM}."
            )
        return None

    def free_bytes(self) -> int:
        """Room for jobs on the fuller of the disks.

        Raises:
            StorageUnavailable: a disk does not answer.
        """
        stored, free = self.storage.free_bytes(), self._free_for_work()
        return free if stored is None else min(free, stored)

    def capacity_bytes(self) -> int:
        """What the disk of ``work`` has above the floor when nothing but the system is on it.

        Raises:
            StorageUnavailable: the disk does not answer.
        """
        facts = self._work_facts()
        return max(0, facts.f_blocks * facts.f_frsize - self.floor_bytes)

    def ensure_for_work(self, size_bytes: int) -> None:
        """Refuse what would take from the reserve on the disk of ``work``.

        Raises:
            StorageFull: it would.
            StorageUnavailable: the disk does not answer.
        """
        if size_bytes > (left := self._free_for_work() - self.reserve_bytes):
            raise StorageFull(
                f"The disk of {self.work} has {max(0, left)} bytes for jobs but {size_bytes} are needed; "
                f"if the store is on it, {MAKE_ROOM}."
            )

    def _free_for_work(self) -> int:
        facts = self._work_facts()
        return facts.f_bavail * facts.f_frsize

    def _work_facts(self) -> os.statvfs_result:
        with told(self.work):
            return os.statvfs(_there(self.work))

    def _is_one_disk(self) -> bool:
        if self.store_folder is None:
            return False
        with told(self.work):
            return _there(self.work).stat().st_dev == _there(self.store_folder).stat().st_dev


def _there(folder: Path) -> Path:
    """The folder or its nearest parent that exists."""
    place = folder.absolute()
    while not place.exists():
        place = place.parent
    return place

"""Whether there is room to work: in the store, and on the disk of the work under way."""

import os
from dataclasses import dataclass
from pathlib import Path

from workers.store.os_errors import MAKE_ROOM, told
from workers.store.protocol import Storage

LEAST_BYTES = 1 << 20
"""With less than this a disk is full, also where nothing is to be kept free."""


@dataclass(frozen=True)
class Room:
    """Watches the disks that jobs fill.

    Attributes:
        storage: the store, which keeps a floor of its own.
        work: folder of the work under way, or its nearest parent that exists.
        floor_bytes: room on the disk of ``work`` below which no job is begun.
        above_bytes: room in the store, above the floor of its own, below which no job is begun; what is
            between the two is left to the jobs under way.
    """

    storage: Storage
    work: Path
    floor_bytes: int
    above_bytes: int = 0

    def lacking(self) -> str | None:
        """One sentence on what lacks room, or None.

        Raises:
            StorageUnavailable: a disk does not answer.
        """
        stored, least = self.storage.free_bytes(), max(self.above_bytes, LEAST_BYTES)
        if stored is not None and stored < least:
            return f"The store lacks {least - stored} bytes of the room that is kept free; {MAKE_ROOM}."
        free, least = self._free_for_work(), max(self.floor_bytes, LEAST_BYTES)
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

    def _free_for_work(self) -> int:
        with told(self.work):
            place = self.work.absolute()
            while not place.exists():
                place = place.parent
            facts = os.statvfs(place)
        return facts.f_bavail * facts.f_frsize

"""Whether there is room to work: in the store, and on the disk of the work under way."""

import os
from dataclasses import dataclass
from pathlib import Path

from workers.store.os_errors import told
from workers.store.protocol import Storage


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
        stored = self.storage.free_bytes()
        if stored is not None and stored < self.above_bytes:
            lacking = self.above_bytes - stored
            return f"The store lacks {lacking} bytes of the room that is kept free; delete datasets or jobs."
        with told(self.work):
            place = self.work.absolute()
            while not place.exists():
                place = place.parent
            facts = os.statvfs(place)
        free = facts.f_bavail * facts.f_frsize
        if free < self.floor_bytes:
            return (
                f"The disk of {self.work} has {free} bytes free where {self.floor_bytes} are kept; make room."
            )
        return None

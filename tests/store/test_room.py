"""Room is looked for in the store and on the disk of the work."""

import os
from pathlib import Path

from octasplat.workers.store.local import LocalStorage
from octasplat.workers.store.room import Room


def test_room(local_storage: LocalStorage, tmp_path: Path) -> None:
    assert Room(local_storage, tmp_path / "not" / "yet", 0).lacking() is None
    lacking = Room(local_storage, tmp_path / "not" / "yet", 1 << 60).lacking()
    assert lacking is not None and "not/yet" in lacking
    local_storage.floor_bytes = 1 << 60
    lacking = Room(local_storage, tmp_path, 0).lacking()
    assert lacking is not None and lacking.startswith("The store lacks")


def test_a_store_without_end_has_room(s3_storage: object, tmp_path: Path) -> None:
    facts = os.statvfs(tmp_path)
    room = Room(s3_storage, tmp_path, facts.f_bavail * facts.f_frsize // 2)  # type: ignore[arg-type]
    assert room.lacking() is None

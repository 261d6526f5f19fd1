"""Room is looked for in the store and on the disk of the work."""

import os
from pathlib import Path

from octasplat.workers.storage.disk_space import DiskSpace
from octasplat.workers.storage.local import LocalStorage


def test_disk_space_shortage_is_described(local_storage: LocalStorage, tmp_path: Path) -> None:
    assert DiskSpace(local_storage, tmp_path / "not" / "yet", 0).shortage() is None
    lacking = DiskSpace(local_storage, tmp_path / "not" / "yet", 1 << 60).shortage()
    assert lacking is not None and "not/yet" in lacking
    local_storage.floor_bytes = 1 << 60
    lacking = DiskSpace(local_storage, tmp_path, 0).shortage()
    assert lacking is not None and lacking.startswith("The store lacks")


def test_disk_space_of_unbounded_store_is_sufficient(s3_storage: object, tmp_path: Path) -> None:
    facts = os.statvfs(tmp_path)
    room = DiskSpace(s3_storage, tmp_path, facts.f_bavail * facts.f_frsize // 2)  # type: ignore[arg-type]
    assert room.shortage() is None

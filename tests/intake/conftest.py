from collections.abc import Iterator
from pathlib import Path

import pytest

from octasplat.workers.storage.local import LocalStorage


@pytest.fixture
def local_storage(tmp_path: Path) -> Iterator[LocalStorage]:
    storage = LocalStorage(tmp_path / "store", floor_bytes=0)
    yield storage
    storage.close()
